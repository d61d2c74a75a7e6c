"""Pictures of a mesh by ray casting: no window, no graphics driver."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from snh.files import write_atomically
from snh.frame import Camera
from snh.mesh.mesh import Mesh
from snh.mesh.raycast import RayScene

_OCCLUSION_RADIUS = 0.4  # m, reach of the contact shadows
_OCCLUSION_RAYS = 4  # per ray of the picture; their mean over a window of rays on the same surface is smooth
_OCCLUSION_WINDOW = 3  # rays to each side
_BAND = 96  # rows shaded at a time, which bounds the memory
_OCCLUSION_DEPTH = 0.75  # how much of its light a fully closed corner loses


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
    """Write the colour of every pixel that meets the mesh into `image` [H, W, 3] float32, a band of rows at a time."""
    scene, normals = mesh.scene, mesh.vertex_normals()
    directions = (camera.rays() @ T_wc[:3, :3].T).astype(np.float32)
    light, depth = np.ones(image.shape[:2], dtype=np.float32), np.zeros(image.shape[:2], dtype=np.float32)
    for first in range(0, camera.height, _BAND):
        rows = slice(first, first + _BAND)
        hits = scene.cast(T_wc[:3, 3], directions[rows])
        hit = hits.face >= 0
        corners, weights = mesh.faces[hits.face[hit]], hits.weights[hit][..., None]
        view = directions[rows][hit]
        points = T_wc[:3, 3].astype(np.float32) + hits.t[hit, None] * view
        normal = (normals[corners] * weights).sum(axis=1)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        cosine = -np.sum(normal * view, axis=-1, keepdims=True) / np.linalg.norm(view, axis=-1, keepdims=True)
        image[rows][hit] = (mesh.colors[corners] * weights).sum(axis=1) * (0.72 + 0.28 * np.abs(cosine))
        depth[rows][hit] = hits.t[hit]
        if contact_shadows:
            light[rows][hit] -= _OCCLUSION_DEPTH * _closedness(scene, points, np.where(cosine < 0, -normal, normal))
    if contact_shadows:
        light = np.where(depth > 0, _smooth(light, depth), 1)
    image *= light[..., None]


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


def _smooth(light: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Mean of `light` [H, W] over a window, along rows and then columns, within surfaces of like `depth` [H, W]."""
    reach = _OCCLUSION_WINDOW
    for axis in (0, 1):
        total, count = np.zeros_like(light), np.zeros_like(light)
        for step in range(-reach, reach + 1):
            other_depth = np.roll(depth, step, axis)
            same = np.abs(other_depth - depth) < 0.01 * depth
            total += np.where(same, np.roll(light, step, axis), 0)
            count += same
        light = total / np.maximum(count, 1)
    return light


def save_png(path: str | Path, image: np.ndarray) -> None:
    """Write an RGB picture [H, W, 3] uint8 as PNG, atomically. Raises OutputError when it cannot be written."""
    import matplotlib.image

    data = io.BytesIO()
    matplotlib.image.imsave(data, np.ascontiguousarray(image), format="png")
    write_atomically(path, data.getvalue())
