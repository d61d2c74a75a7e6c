"""Path errors on hand-made cases, on a real recording's paths, and against evo."""

import numpy as np
import pytest

from snh.datasets.poses import read_tum
from snh.datasets.tum import associate
from snh.errors import DataError, OutputError
from snh.eval import align, ate, rpe, write_tum
from snh.geometry import inverse, se3_exp


def random_path(n: int, seed: int = 0) -> np.ndarray:
    """A smooth path [n, 4, 4] of random twists."""
    T = [se3_exp(np.random.default_rng(seed).normal(size=6))]
    for twist in np.random.default_rng(seed + 1).normal(scale=0.05, size=(n - 1, 6)):
        T.append(T[-1] @ se3_exp(twist))
    return np.array(T)


def test_rigid_motion_costs_nothing_and_is_found():
    T_ref = random_path(50)
    T_ref_est = se3_exp(np.array([3.0, -2, 1, 0.5, 2, -1]))
    error = ate(inverse(T_ref_est) @ T_ref, T_ref)
    assert error.rmse_cm < 1e-10 and np.allclose(error.T_ref_est, T_ref_est)
    assert rpe(inverse(T_ref_est) @ T_ref, T_ref).translation_cm < 1e-10


def test_error_by_hand():
    """A square of 2 m with one corner lifted by h: least squares takes a plane of residuals h/4 with signs + - + -."""
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    h = 1e-4  # small, so that the rotation is linear
    T_ref = np.tile(np.eye(4), (4, 1, 1))
    T_ref[:, :3, 3] = square
    T_est = T_ref.copy()
    T_est[0, 2, 3] += h
    error = ate(T_est, T_ref)
    assert error.errors_cm == pytest.approx([100 * h / 4] * 4, rel=1e-3)
    assert error.rmse_cm == pytest.approx(100 * h / 4, rel=1e-3)
    assert error.mean_cm == pytest.approx(error.rmse_cm, rel=1e-3) and error.max_cm >= error.rmse_cm


def test_scale_is_not_aligned():
    """Points at +-1 m against +-1.1 m on a line: 10 cm are left at each end."""
    points = np.array([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0]])
    T_est, T_ref = np.tile(np.eye(4), (2, 3, 1, 1))
    T_est[:, :3, 3], T_ref[:, :3, 3] = points, 1.1 * points
    assert ate(T_est, T_ref).errors_cm == pytest.approx([10, 0, 10], abs=1e-9)


def test_mirrored_points_are_not_mirrored_back():
    points = np.random.default_rng(1).normal(size=(30, 3))
    T = align(points * [1, 1, -1], points)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1)
    assert np.allclose(T[:3, :3].T @ T[:3, :3], np.eye(3))


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_invalid_reference_poses_are_left_out_and_counted(broken):
    T_ref = random_path(40)
    T_est = T_ref @ se3_exp(np.random.default_rng(5).normal(scale=0.01, size=(40, 6)))
    expected = ate(T_est[5:], T_ref[5:])
    T_ref[:5, 0, 3] = broken
    error = ate(T_est, T_ref)
    assert error.rmse_cm == pytest.approx(expected.rmse_cm) and error.n_evaluated == 35
    assert np.isnan(error.errors_cm[:5]).all() and np.allclose(error.errors_cm[5:], expected.errors_cm)
    assert "35 of 40 frames (5 without a valid reference pose)" in str(error)
    assert rpe(T_est, T_ref).n_pairs == 34


@pytest.mark.parametrize(("n_est", "n_ref"), [(40, 30), (30, 40)])
def test_another_length_is_evaluated_on_the_common_frames(n_est, n_ref):
    T_ref = random_path(40)
    T_est = T_ref @ se3_exp(np.random.default_rng(5).normal(scale=0.01, size=(40, 6)))
    error = ate(T_est[:n_est], T_ref[:n_ref])
    assert error.rmse_cm == pytest.approx(ate(T_est[:30], T_ref[:30]).rmse_cm)
    assert error.n_evaluated == 30 and len(error.errors_cm) == n_est
    assert f"30 of {n_est} frames" in str(error) and f"the reference has {n_ref} poses" in str(error)


def test_no_valid_frame_is_an_error():
    T = random_path(5)
    with pytest.raises(DataError, match="No frame has a valid reference pose"):
        ate(T, np.full((5, 4, 4), np.nan))
    with pytest.raises(DataError, match="9 apart"):
        rpe(T, T, delta=9)


def test_relative_error_by_hand():
    """Each step of the estimate is 1 cm too long and turns 0.1 degrees too far."""
    step = np.array([0.1, 0, 0, 0, 0, 0.02])
    too_far = np.array([0, 0, 0, 0, 0, np.radians(0.1)])
    T_ref, T_est = [np.eye(4)], [np.eye(4)]
    for _ in range(10):
        T_ref.append(T_ref[-1] @ se3_exp(step))
        T_est.append(T_est[-1] @ se3_exp(step) @ se3_exp(np.array([0.01, 0, 0, 0, 0, 0])) @ se3_exp(too_far))
    error = rpe(np.array(T_est), np.array(T_ref))
    assert error.translation_cm == pytest.approx(1.0) and error.rotation_deg == pytest.approx(0.1)
    assert error.n_pairs == 10


def test_tum_file_gives_back_the_path(tmp_path):
    T, times = random_path(20), 1305031102.175304 + np.arange(20) / 30
    write_tum(tmp_path / "trajectory.txt", times, T)
    times_read, T_read = read_tum(tmp_path / "trajectory.txt")
    # Nine decimals of metres and of unit quaternions; six of seconds.
    assert np.allclose(times_read, times, rtol=0, atol=5e-7) and np.allclose(T_read, T, rtol=0, atol=5e-9)
    assert [path.name for path in tmp_path.iterdir()] == ["trajectory.txt"]


def test_tum_file_that_cannot_be_written_is_refused(tmp_path):
    with pytest.raises(OutputError, match="No such file"):
        write_tum(tmp_path / "missing" / "a.txt", np.zeros(1), np.eye(4)[None])


def test_agrees_with_evo_on_a_real_path(shared_data, tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))  # evo writes its settings there
    pytest.importorskip("evo", reason="evo is not installed; it only judges these tests (pip install evo)")
    from evo.core import metrics, sync
    from evo.tools import file_interface

    files = [shared_data / "trajectories" / f"freiburg1_xyz-{name}.txt" for name in ("groundtruth", "rgbdslam")]
    reference, estimate = (file_interface.read_tum_trajectory_file(str(file)) for file in files)
    reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.02)
    estimate.align(reference)
    oracle = []
    for metric in (
        metrics.APE(metrics.PoseRelation.translation_part),
        metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames),
        metrics.RPE(metrics.PoseRelation.rotation_angle_deg, 1, metrics.Unit.frames),
    ):
        metric.process_data((reference, estimate))
        oracle.append(metric.get_all_statistics())

    (times_ref, T_ref), (times, T_est) = (read_tum(file) for file in files)
    i, j = np.array(associate(times, times_ref, 0.02)).T
    assert len(i) == reference.num_poses == 786
    absolute, relative = ate(T_est[i], T_ref[j]), rpe(T_est[i], T_ref[j])
    for ours, theirs in (
        (absolute.rmse_cm, 100 * oracle[0]["rmse"]),
        (absolute.mean_cm, 100 * oracle[0]["mean"]),
        (absolute.max_cm, 100 * oracle[0]["max"]),
        (relative.translation_cm, 100 * oracle[1]["rmse"]),
        (relative.rotation_deg, oracle[2]["rmse"]),
    ):
        assert ours == pytest.approx(theirs, rel=1e-9)
    assert absolute.rmse_cm == pytest.approx(1.34734677, rel=1e-8)
