"""Where to look at a mesh from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from snh.frame import Camera
from snh.mesh.mesh import Mesh


@dataclass(frozen=True)
class ViewPoint:
    """A virtual camera and where it stands, [4, 4] camera to world."""

    camera: Camera
    T_wc: np.ndarray


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Pose [4, 4], camera to world, of a camera at `center` that looks at `target` with `up` ([3]) upwards."""
    forward = np.asarray(target, dtype=np.float64) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=-1)
    T[:3, 3] = center
    return T


def up_direction(mesh: Mesh, T_wc: np.ndarray) -> np.ndarray:
    """Unit vector [3] that points up: the mean of the cameras' up ([N, 4, 4], hand-held, so roughly upright), then
    settled on the mean normal of the surfaces within 30 degrees of it (floor, table tops)."""
    up = -T_wc[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a).astype(np.float64)
    area = np.linalg.norm(weighted, axis=-1)
    for angle in (30, 15, 8):
        level = weighted[weighted @ up > np.cos(np.radians(angle)) * area]
        if len(level) == 0:
            break
        up = level.sum(axis=0) / np.linalg.norm(level.sum(axis=0))
    return up


def dollhouse_view(mesh: Mesh, up: np.ndarray, width: int = 1280, height: int = 960) -> ViewPoint:
    """View from outside and above that holds the whole mesh and faces most of its surface; render with
    cull_back_faces=True. up [3]: unit vector."""
    elevation = np.radians(52)
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    forward = np.cross(side, up)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    weighted = np.cross(b - a, c - a)
    places = []
    for azimuth in np.radians(np.arange(22.5, 360, 45)):
        flat = np.cos(azimuth) * side + np.sin(azimuth) * forward
        places.append(np.cos(elevation) * flat + np.sin(elevation) * up)
    best = max(places, key=lambda place: float(np.maximum(weighted @ place, 0).sum()))
    focal = 1.6 * width  # a narrow view keeps the walls nearly parallel
    camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    return _fitted(mesh.vertices, camera, best, up)


def _fitted(points: np.ndarray, camera: Camera, direction: np.ndarray, up: np.ndarray) -> ViewPoint:
    """View from `direction` (unit, from the points to the camera) at the least distance that shows all points."""
    T = look_at(direction, np.zeros(3), up)
    local = points.astype(np.float64) @ T[:3, :3]
    bounds = []
    for axis, focal, size in ((0, camera.fx, camera.width), (1, camera.fy, camera.height)):
        slope = 0.94 * size / 2 / focal
        # |x - x0| <= slope (z + d) on both sides: the two tightest constraints fix x0 and d.
        right = (local[:, axis] - slope * local[:, 2]).max()
        left = (-local[:, axis] - slope * local[:, 2]).max()
        bounds.append(((right - left) / 2, (right + left) / 2 / slope))
    distance = max(bounds[0][1], bounds[1][1])
    T[:3, 3] = T[:3, :3] @ np.array([bounds[0][0], bounds[1][0], -distance])
    return ViewPoint(camera, T)
