"""World axes along the main directions of the scene.

Features live on axis-aligned planes, which represent a wall or a table top best when it is parallel to one of them.
Datasets arrange that with their ground-truth frames; without one, the first depth image tells how to turn the world.
"""

from __future__ import annotations

import itertools

import numpy as np

from snh.frame import Camera
from snh.geometry import se3_exp

NEAR = np.cos(np.deg2rad(12))  # a normal this close to an axis speaks for it
ENOUGH = 0.3  # share of the normals that must agree


def main_directions(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Rotation R_wc [3, 3] of the first camera that puts most surface normals of its depth image along world axes.

    depth [H, W] m, 0 = no reading. Of the 24 equivalent choices the one nearest to the camera's own axes; the identity
    when the scene has no main directions or too few readings.
    """
    normals = surface_normals(depth, camera)
    if len(normals) < 50:
        return np.eye(3)
    R = max(_starts(), key=lambda start: _agreement(start, normals))
    for _ in range(10):
        R = _refined(R, normals)
    return R if _agreement(R, normals) > ENOUGH else np.eye(3)


def surface_normals(depth: np.ndarray, camera: Camera, stride: int = 6) -> np.ndarray:
    """Unit normals [n, 3] in the camera frame at a lattice of pixels, away from depth edges."""
    points = camera.rays(stride) * depth[::stride, ::stride, None]
    z = points[..., 2]
    du = points[1:-1, 2:] - points[1:-1, :-2]
    dv = points[2:, 1:-1] - points[:-2, 1:-1]
    corners = (z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1])
    centre = z[1:-1, 1:-1]
    smooth = (centre > 0) & np.all([(c > 0) & (np.abs(c - centre) < 0.1 * centre) for c in corners], axis=0)
    normals = np.cross(du, dv)[smooth].astype(np.float64)
    length = np.linalg.norm(normals, axis=1)
    return normals[length > 0] / length[length > 0, None]


def _starts() -> list[np.ndarray]:
    """Rotations about the camera's x (pitch) and y (yaw) axes that leave no main direction further than ~10 degrees."""
    angles = np.deg2rad(np.arange(-45, 45, 15))
    rolls = np.deg2rad([-15, 0, 15])
    return [
        _rotation(0, pitch) @ _rotation(1, yaw) @ _rotation(2, roll)
        for pitch, yaw, roll in itertools.product(angles, angles, rolls)
    ]


def _rotation(axis: int, angle: float) -> np.ndarray:
    twist = np.zeros(6)
    twist[3 + axis] = angle
    return se3_exp(twist)[:3, :3]


def _agreement(R: np.ndarray, normals: np.ndarray) -> float:
    """Share of the normals that lie along an axis after turning them by R."""
    return float((np.abs(normals @ R.T).max(axis=1) > NEAR).mean())


def _refined(R: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Best rotation of the normals that are near an axis onto it (orthogonal Procrustes)."""
    turned = normals @ R.T
    axis = np.abs(turned).argmax(axis=1)
    along = turned[np.arange(len(turned)), axis]
    near = np.abs(along) > NEAR
    target = np.zeros_like(turned)
    target[np.arange(len(turned)), axis] = np.sign(along)
    U, _, Vt = np.linalg.svd(target[near].T @ normals[near])
    return U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
