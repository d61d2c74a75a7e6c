"""Rigid motions against matrix exponentials, and cameras."""

import numpy as np
import pytest
import torch

from snh.frame import Camera
from snh.geometry import (
    inverse,
    orthonormal,
    quaternion_from_rotation,
    rotation_from_quaternion,
    se3_exp,
    skew,
)


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e-6, 1e-4, 0.1, 1.0, 3.1])
def test_exp_equals_the_matrix_exponential(scale):
    rng = np.random.default_rng(0)
    for _ in range(5):
        twist = rng.normal(size=6)
        twist[3:] *= scale / np.linalg.norm(twist[3:])
        generator = np.zeros((4, 4))
        generator[:3, :3] = skew(twist[3:])
        generator[:3, 3] = twist[:3]
        expected = torch.matrix_exp(torch.from_numpy(generator)).numpy()
        np.testing.assert_allclose(se3_exp(twist), expected, atol=1e-10)


def test_exp_and_inverse_work_on_batches():
    twists = np.random.default_rng(1).normal(size=(4, 5, 6))
    T = se3_exp(twists)
    np.testing.assert_allclose(inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=1e-12)
    np.testing.assert_allclose(T[2, 3], se3_exp(twists[2, 3]), atol=0)


def test_quaternions_there_and_back():
    rng = np.random.default_rng(2)
    for axis in (*np.eye(3), *rng.normal(size=(20, 3))):
        for angle in (0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi):
            R = se3_exp(np.concatenate([np.zeros(3), angle * axis / np.linalg.norm(axis)]))[:3, :3]
            q = quaternion_from_rotation(R)
            assert q[3] >= 0
            np.testing.assert_allclose(rotation_from_quaternion(q), R, atol=1e-7)


def test_orthonormal_repairs_rounding():
    T = se3_exp(np.array([1.0, 2, 3, 0.1, -0.2, 0.3]))
    repaired = orthonormal(T + 1e-4)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(repaired[:3, :3]) > 0


def test_camera_rays_project_to_their_pixels():
    camera = Camera(64, 48, 50.0, 55.0, 30.0, 20.0)
    points = camera.rays(stride=5) * 2.5
    v, u = np.mgrid[0:48:5, 0:64:5]
    np.testing.assert_allclose(camera.project(points), np.stack([u, v], axis=-1), atol=1e-4)


def test_scaled_and_cropped_cameras_see_the_same_direction():
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    half = camera.scaled(320, 240)
    # The centre of the half image's first pixel is the corner between the first four full-size pixels.
    expected = (np.array([0.5, 0.5]) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    np.testing.assert_allclose((0 - np.array([half.cx, half.cy])) / [half.fx, half.fy], expected)
    cut = camera.cropped(10)
    assert (cut.width, cut.height, cut.cx, cut.cy) == (620, 460, 309.5, 229.5)
