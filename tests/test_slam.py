"""The pipeline: its parts by hand, and the whole on a tiny recording of the built-in room."""

import dataclasses

import numpy as np
import pytest

from snh.config import Config, InputConfig, KeyframeConfig, load_config
from snh.datasets import open_sequence
from snh.errors import DataError
from snh.eval.trajectory import ate
from snh.frame import Camera, Frame
from snh.geometry import inverse, se3_exp
from snh.slam import SLAM
from snh.slam.alignment import main_directions
from snh.slam.keyframes import KeyframeLibrary
from snh.slam.mapper import PoseOptimizer, twist_gradient
from snh.slam.pyramid import Pyramid
from snh.slam.rays import clean_depth, make_rays, pick_pixels

SMALL = Camera(16, 12, 20.0, 20.0, 7.5, 5.5)


def small_frame(index: int, depth: float = 2.0) -> Frame:
    rgb = np.arange(16 * 12 * 3, dtype=np.uint8).reshape(12, 16, 3)
    return Frame(index, index / 30, rgb, np.full((12, 16), depth, np.float32), SMALL)


# --- rays -------------------------------------------------------------------------------------------------------


def test_depth_outside_the_range_is_no_reading():
    depth = np.array([[0.05, 0.1, 5.0], [10.0, 10.1, np.nan]], np.float32)
    np.testing.assert_array_equal(clean_depth(depth, InputConfig()), np.array([[0, 0.1, 5], [10, 0, 0]], np.float32))


def test_picked_pixels_have_depth_and_keep_away_from_borders_and_edges():
    depth = np.full((40, 60), 2.0, np.float32)
    depth[:, 30:] = 3.0
    depth[10:20, 5:15] = 0
    pixels = pick_pixels(depth, 300, np.random.default_rng(0), border=4, edge_depth=0.1)
    v, u = pixels // 60, pixels % 60
    assert 100 < len(pixels) <= 300
    assert u.min() >= 4 and u.max() < 56 and v.min() >= 4 and v.max() < 36
    assert not ((u >= 28) & (u < 32)).any(), "two pixels on each side of the step"
    near_rows, near_columns = (v >= 8) & (v < 22) & (u >= 5) & (u < 15), (v >= 10) & (v < 20) & (u >= 3) & (u < 17)
    assert not (near_rows | near_columns).any(), "the hole and two pixels beside it"


def test_rays_pass_through_their_pixels():
    rays = make_rays(small_frame(0), small_frame(0).depth, np.array([0, 17]))
    np.testing.assert_allclose(rays.dirs_c.numpy(), [[-7.5 / 20, -5.5 / 20, 1], [-6.5 / 20, -4.5 / 20, 1]], rtol=1e-6)
    np.testing.assert_allclose(rays.color[1].numpy(), np.array([51, 52, 53]) / 255, rtol=1e-6)


def test_every_pyramid_level_shows_the_same_colour_along_a_ray():
    """On a ramp the mean of pixels is the colour at their centre, whatever the level: a camera off by half a pixel
    of level 3 would be off by 4 x 2 grey values."""
    camera = Camera(96, 80, 70.0, 70.0, 47.5, 39.5)
    v, u = np.mgrid[:80, :96]
    pyramid = Pyramid(np.stack([2 * u, 2 * v, u + v], axis=-1).astype(np.uint8), camera)
    directions = camera.rays(stride=9)[2:-2, 2:-2].reshape(-1, 3)
    assert [level[0].shape[:2] for level in pyramid.levels] == [(80, 96), (40, 48), (20, 24), (10, 12)]
    for level in range(4):
        colors = 255 * pyramid.sample(level, directions)
        np.testing.assert_allclose(colors, 255 * pyramid.sample(0, directions), atol=0.51, err_msg=f"level {level}")


# --- keyframes --------------------------------------------------------------------------------------------------


def library(n: int, **settings) -> KeyframeLibrary:
    settings = {"pixel_share": 0.5} | settings
    keyframes = KeyframeLibrary(KeyframeConfig(**settings), SMALL, np.random.default_rng(0))
    for k in range(n):
        keyframes.add(small_frame(5 * k, 1.0 + k), small_frame(0, 1.0 + k).depth, np.eye(4), 0.0)
    return keyframes


def test_the_window_is_a_fifth_neighbours_and_otherwise_drawn():
    keyframes = library(50)
    windows = [keyframes.window() for _ in range(30)]
    for window in windows:
        assert len(window) == 10 and len(np.unique(window)) == 10
        assert (np.diff(window) > 0).all()
        assert {48, 49} <= set(window) and not {47} <= set(window[-3:]) - set(window[:-2])
    assert len(np.unique(np.concatenate(windows))) > 45, "earlier keyframes are drawn from all"


def test_the_window_grows_to_a_tenth_and_holds_everything_at_first():
    assert list(library(7).window()) == list(range(7))
    assert len(library(150).window()) == 15


def test_policies_of_table_vi():
    assert list(library(30, policy="local").window()) == list(range(20, 30))
    window = library(30, policy="random").window()
    assert len(window) == 10 and window[-1] == 29
    assert len(library(30, policy="all_rays").window()) == 30


def test_rays_are_shared_equally_and_carry_their_keyframe():
    keyframes = library(4)
    rays, owner = keyframes.draw(np.array([1, 2, 3]), 100)
    assert list(np.bincount(owner)) == [34, 33, 33]
    np.testing.assert_array_equal(rays.depth.numpy(), 2.0 + owner)


# --- poses ------------------------------------------------------------------------------------------------------


def test_twist_gradient_is_the_derivative_along_a_right_twist():
    rng = np.random.default_rng(3)
    T = se3_exp(rng.normal(size=(4, 6)))
    weights = rng.normal(size=(4, 3, 4))  # loss = sum of weights * entries

    def loss(twist):
        return (weights * (T @ se3_exp(twist))[:, :3]).sum(axis=(1, 2))

    step = 1e-6
    numeric = np.stack([(loss(step * e) - loss(-step * e)) / (2 * step) for e in np.eye(6)], axis=-1)
    np.testing.assert_allclose(twist_gradient(T, weights), numeric, atol=1e-8)


def test_the_fixed_pose_stays_and_the_others_go_downhill():
    T = se3_exp(np.random.default_rng(4).normal(size=(3, 6)))
    poses = PoseOptimizer(T, np.array([True, False, False]), Config())
    target = np.zeros((3, 3, 4))
    target[:, :, 3] = 1
    for _ in range(2000):
        gradient = np.zeros((3, 3, 4))
        gradient[:, :, 3] = 2 * (poses.T_wc[:, :3, 3] - target[:, :, 3])
        poses.step(gradient, 0.005)
    np.testing.assert_array_equal(poses.T_wc[0], T[0])
    np.testing.assert_allclose(poses.T_wc[1:, :3, 3], 1, atol=0.02)


# --- world axes -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("twist", [(0, 0, 0), (0.4, 0, 0), (-0.3, 0.5, 0.1), (0.1, -0.6, 0)])
def test_a_tilted_camera_in_a_box_finds_its_axes(twist):
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    R_box_c = se3_exp(np.array([0, 0, 0, *twist]))[:3, :3]
    rays = camera.rays() @ R_box_c.T  # from the middle of a box of 4 x 3 x 5 m
    depth = (np.array([2.0, 1.5, 2.5]) / np.maximum(np.abs(rays), 1e-9)).min(axis=-1).astype(np.float32)
    R = main_directions(depth, camera)
    turned = R @ R_box_c.T
    np.testing.assert_allclose(np.abs(turned).max(axis=1), 1, atol=1e-3)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-9)


def test_no_main_directions_leave_the_camera_axes():
    camera = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
    depth = 2 / np.linalg.norm(camera.rays(), axis=-1)  # inside a sphere
    np.testing.assert_array_equal(main_directions(depth.astype(np.float32), camera), np.eye(3))
    np.testing.assert_array_equal(main_directions(np.zeros((120, 160), np.float32), camera), np.eye(3))


# --- the whole --------------------------------------------------------------------------------------------------

QUICK = ["mapping.n_rays=512", "mapping.first_iterations=60", "tracking.n_rays=512", "mapping.iterations=6"]
N = 21


@pytest.fixture(scope="module")
def room():
    sequence = open_sequence("builtin", resize=(160, 120), frames=N)
    return [sequence[i] for i in range(len(sequence))]


def tracked(frames, presets=("fast",), overrides=(), seed=0) -> SLAM:
    slam = SLAM(frames[0].camera, load_config(list(presets), QUICK + list(overrides)), seed)
    for frame in frames:
        slam.step(frame)
    return slam


def error_cm(slam: SLAM, frames) -> float:
    return ate(slam.trajectory(), np.stack([f.T_wc_ref for f in frames])).rmse_cm


@pytest.mark.parametrize(
    "overrides",
    [(), ("tracking.tracker=adam", "tracking.density=0.5", "tracking.iterations=20")],
    ids=["gauss_newton", "adam"],
)
def test_the_room_is_tracked(room, overrides):
    slam = tracked(room, overrides=overrides)
    assert [r.status for r in slam.results] == ["first"] + ["ok"] * (N - 1)
    assert [r.index for r in slam.results if r.is_keyframe] == [0, 5, 10, 15, 20]
    still = np.broadcast_to(np.eye(4), (N, 4, 4))
    assert error_cm(slam, room) < 0.25 * ate(still, np.stack([f.T_wc_ref for f in room])).rmse_cm
    assert error_cm(slam, room) < 1.5


def test_equal_seeds_give_equal_runs_and_others_do_not(room):
    first, second, other = (tracked(room[:7], seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.trajectory(), second.trajectory())
    assert (first.field.features == second.field.features).all()
    assert not np.array_equal(first.trajectory(), other.trajectory())


def test_frames_without_depth_or_colour_are_said_and_passed(room):
    frames = list(room)
    frames[8] = dataclasses.replace(frames[8], depth=np.zeros_like(frames[8].depth))
    for i in range(12, 17):
        frames[i] = dataclasses.replace(frames[i], rgb=np.zeros_like(frames[i].rgb))
    slam = tracked(frames)
    statuses = [r.status for r in slam.results]
    assert statuses[8] == "no depth" and statuses[12:17] == ["no colour"] * 5
    assert statuses.count("ok") == N - 7
    assert [r.index for r in slam.results if r.is_keyframe] == [0, 5, 10, 17]
    assert error_cm(slam, room) < 1.5


def test_a_first_frame_without_depth_is_refused(room):
    slam = SLAM(room[0].camera)
    with pytest.raises(DataError, match="first"):
        slam.step(dataclasses.replace(room[0], depth=np.zeros_like(room[0].depth)))


def test_frames_between_keyframes_follow_their_corrected_keyframe(room):
    slam = tracked(room[:8])
    before = slam.trajectory()
    moved = se3_exp(np.array([0.1, 0, 0, 0, 0.2, 0]))
    slam.keyframes.T_wc[1] = moved @ slam.keyframes.T_wc[1]
    after = slam.trajectory()
    np.testing.assert_array_equal(after[:5], before[:5])
    np.testing.assert_allclose(after[5:] @ inverse(before[5:]), np.broadcast_to(moved, (3, 4, 4)), atol=1e-12)
