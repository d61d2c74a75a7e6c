"""Errors of a camera path against a reference, and the TUM file of a path (read by snh.datasets.poses.read_tum)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snh.errors import DataError
from snh.files import write_atomically
from snh.geometry import inverse, quaternion_from_rotation


@dataclass(frozen=True)
class AbsoluteError:
    """Absolute trajectory error after rigid alignment: distance of camera centres.

    errors_cm [N], NaN where a frame was not evaluated. T_ref_est [4, 4]: alignment, reference from estimate.
    n_reference: poses that the reference has, valid or not.
    """

    rmse_cm: float
    mean_cm: float
    max_cm: float
    errors_cm: np.ndarray
    T_ref_est: np.ndarray
    n_reference: int

    @property
    def n_evaluated(self) -> int:
        return int(np.isfinite(self.errors_cm).sum())

    def __str__(self) -> str:
        n = len(self.errors_cm)
        text = f"ATE RMSE {self.rmse_cm:.2f} cm over {self.n_evaluated} of {n} frames"
        if self.n_evaluated < n:
            text += f" ({n - self.n_evaluated} without a valid reference pose)"
        if self.n_reference != n:
            text += f"; the reference has {self.n_reference} poses"
        return text


@dataclass(frozen=True)
class RelativeError:
    """Relative pose error over `delta` frames: RMSE of translation and of rotation angle over n_pairs pairs."""

    translation_cm: float
    rotation_deg: float
    n_pairs: int


def align(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Rigid motion [4, 4] that brings `points` [N, 3] nearest to `reference` [N, 3] in least squares.

    Umeyama 1991 without scale.
    """
    center, center_reference = points.mean(axis=0), reference.mean(axis=0)
    U, _, Vt = np.linalg.svd((reference - center_reference).T @ (points - center))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1, 1, np.linalg.det(U) * np.linalg.det(Vt)]) @ Vt
    T[:3, 3] = center_reference - T[:3, :3] @ center
    return T


def ate(T_est: np.ndarray, T_ref: np.ndarray) -> AbsoluteError:
    """Absolute trajectory error of the estimate [N, 4, 4] against the reference [M, 4, 4], both camera to world.

    Pose n of both belongs to frame n. Frames that one of them lacks or where it is not finite are left out.
    Raises DataError when no frame has both.
    """
    both = _valid_in_both(T_est, T_ref)
    if not both.any():
        raise DataError(f"No frame has a valid reference pose: {len(T_est)} estimated, {len(T_ref)} in the reference.")
    p_est, p_ref = T_est[: len(both), :3, 3][both], T_ref[: len(both), :3, 3][both]
    T = align(p_est, p_ref)
    errors = np.full(len(T_est), np.nan)
    errors[: len(both)][both] = 100 * np.linalg.norm(p_est @ T[:3, :3].T + T[:3, 3] - p_ref, axis=-1)
    used = errors[np.isfinite(errors)]
    return AbsoluteError(float(np.sqrt(np.mean(used**2))), float(used.mean()), float(used.max()), errors, T, len(T_ref))


def rpe(T_est: np.ndarray, T_ref: np.ndarray, delta: int = 1) -> RelativeError:
    """Relative pose error: the motion over `delta` frames against the reference's, over all pairs valid in both.

    Raises DataError when there is no such pair.
    """
    both = _valid_in_both(T_est, T_ref)
    first = np.nonzero(both[:-delta] & both[delta:])[0]
    if len(first) == 0:
        raise DataError(f"No two frames {delta} apart have valid reference poses.")
    motion_est = inverse(T_est[first]) @ T_est[first + delta]
    motion_ref = inverse(T_ref[first]) @ T_ref[first + delta]
    error = inverse(motion_ref) @ motion_est
    translation = np.linalg.norm(error[:, :3, 3], axis=-1)
    angle = _rotation_angle(error[:, :3, :3])
    return RelativeError(
        float(100 * np.sqrt(np.mean(translation**2))), float(np.degrees(np.sqrt(np.mean(angle**2)))), len(first)
    )


def _valid_in_both(T_est: np.ndarray, T_ref: np.ndarray) -> np.ndarray:
    """Which of the frames that both have are finite in both, [min(N, M)] bool."""
    n = min(len(T_est), len(T_ref))
    return np.isfinite(T_est[:n]).all(axis=(1, 2)) & np.isfinite(T_ref[:n]).all(axis=(1, 2))


def _rotation_angle(R: np.ndarray) -> np.ndarray:
    """Angles of rotation matrices [N, 3, 3], rad; exact near zero, where the arc cosine of the trace is not."""
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=-1)
    return np.arctan2(np.linalg.norm(axis, axis=-1), np.trace(R, axis1=1, axis2=2) - 1)


def write_tum(path: str | Path, timestamps: np.ndarray, T_wc: np.ndarray) -> None:
    """Write poses [N, 4, 4] at `timestamps` [N] s as lines `timestamp tx ty tz qx qy qz qw`, atomically.

    Raises OutputError when the file cannot be written.
    """
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for timestamp, T in zip(timestamps, T_wc, strict=True):
        numbers = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        lines.append(f"{timestamp:.6f} " + " ".join(f"{value:.9f}" for value in numbers))
    write_atomically(path, ("\n".join(lines) + "\n").encode())
