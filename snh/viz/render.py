"""Pictures of a mesh by ray casting: no window, no graphics driver."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snh.files import write_atomically
from snh.frame import Camera
from snh.mesh.mesh import Mesh
from snh.mesh.raycast import RayScene, look_at

_OCCLUSION_RADIUS = 0.4  # m, reach of the contact shadows
_OCCLUSION_RAYS = 4  # per ray of the picture; with 2 x 2 rays per pixel, 16 per pixel
_OCCLUSION_DEPTH = 0.75  # how much of its light a fully closed corner loses


@dataclass(frozen=True)
class ViewPoint:
    """A virtual camera and where it stands, [4, 4] camera to world."""

    camera: Camera
    T_wc: np.ndarray


def render_mesh(
    mesh: Mesh,
    camera: Camera,
    T_wc: np.ndarray,
    cull_back_faces: bool = False,
    contact_shadows: bool = True,
    background: tuple[int, int, int] = (255, 255, 255),
    supersampling: int = 2,
) -> np.ndarray:
    """Picture [H, W, 3] uint8 RGB of a mesh from a virtual camera at T_wc [4, 4]; vertex colours, soft light.

    cull_back_faces: leave out triangles seen from behind, so that a room shows its inside from outside.
    contact_shadows: darken corners by casting rays (repeatable). supersampling: rays along each side of a pixel.
    """
    if cull_back_faces:
        to_camera = T_wc[:3, 3] - mesh.vertices[mesh.faces].mean(axis=1)
        mesh = mesh.select_faces(np.sum(mesh.face_normals() * to_camera, axis=-1) > 0)
    fine = camera.scaled(camera.width * supersampling, camera.height * supersampling)
    shaded = np.empty((fine.height, fine.width, 3), dtype=np.float32)
    shaded[:] = background
    if len(mesh.faces):
        _shade(mesh, fine, T_wc, contact_shadows, shaded)
    pixels = shaded.reshape(camera.height, supersampling, camera.width, supersampling, 3).mean(axis=(1, 3))
    return np.round(np.clip(pixels, 0, 255)).astype(np.uint8)


def _shade(mesh: Mesh, camera: Camera, T_wc: np.ndarray, contact_shadows: bool, image: np.ndarray) -> None:
    """Write the colour of every pixel that meets the mesh into `image` [H, W, 3] float32."""
    scene = RayScene(mesh)
    directions = (camera.rays() @ T_wc[:3, :3].T).astype(np.float32)
    hits = scene.cast(T_wc[:3, 3], directions)
    hit = hits.face >= 0
    corners, weights = mesh.faces[hits.face[hit]], hits.weights[hit][..., None]
    points = T_wc[:3, 3].astype(np.float32) + hits.t[hit, None] * directions[hit]
    color = (mesh.colors[corners] * weights).sum(axis=1)
    normal = (mesh.vertex_normals()[corners] * weights).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    view = -directions[hit] / np.linalg.norm(directions[hit], axis=-1, keepdims=True)
    cosine = np.sum(normal * view, axis=-1, keepdims=True)
    normal = np.where(cosine < 0, -normal, normal)
    light = 0.72 + 0.28 * np.abs(cosine)
    if contact_shadows:
        light = light * (1 - _OCCLUSION_DEPTH * _closedness(scene, points, normal))[:, None]
    image[hit] = color * light


def _closedness(scene: RayScene, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share [K] of the half space over each point that is closed within the occlusion radius; near counts more."""
    random = np.random.default_rng(0)
    closed = np.zeros(len(points), dtype=np.float32)
    for _ in range(_OCCLUSION_RAYS):
        # A point of the unit sphere around the tip of the normal: cosine-weighted over the half space.
        direction = random.normal(size=points.shape).astype(np.float32)
        direction = normals + direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        direction /= np.maximum(np.linalg.norm(direction, axis=-1, keepdims=True), 1e-6)
        reach = scene.cast(points + 0.01 * normals, direction).t
        closed += np.clip(1 - reach / _OCCLUSION_RADIUS, 0, 1)
    return closed / _OCCLUSION_RAYS


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


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write an RGB picture [H, W, 3] uint8 as PNG, atomically. Raises OutputError when it cannot be written."""
    import matplotlib.image

    data = io.BytesIO()
    matplotlib.image.imsave(data, np.ascontiguousarray(image), format="png")
    write_atomically(path, data.getvalue())
