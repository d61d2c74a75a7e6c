"""Rays against a mesh, on the CPU and without a window."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hits:
    """First hits of rays, shape [...] of the rays: t along the direction (inf = none), face index (-1 = none),
    weights [..., 3] of the face's corners."""

    t: np.ndarray
    face: np.ndarray
    weights: np.ndarray


class RayScene:
    """Triangles (vertices [V, 3] m, faces [F, 3]) made ready for ray casting and distance queries."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        import open3d as o3d

        self._tensor = o3d.core.Tensor.from_numpy
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(np.ascontiguousarray(vertices, dtype=np.float32)),
            self._tensor(np.ascontiguousarray(faces, dtype=np.uint32)),
        )

    def cast(self, rays_o: np.ndarray, rays_d: np.ndarray) -> Hits:
        """First hits of the rays from rays_o ([..., 3] or [3]) along rays_d [..., 3], float32."""
        rays = np.empty((*rays_d.shape[:-1], 6), dtype=np.float32)
        rays[..., :3], rays[..., 3:] = rays_o, rays_d
        answer = self._scene.cast_rays(self._tensor(rays))
        uv = answer["primitive_uvs"].numpy()
        t = answer["t_hit"].numpy()
        face = np.where(np.isfinite(t), answer["primitive_ids"].numpy().astype(np.int64), -1)
        return Hits(t, face, np.concatenate([1 - uv.sum(axis=-1, keepdims=True), uv], axis=-1))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Exact distance of points [N, 3] to the nearest point of the surface, [N] float32 m."""
        return self._scene.compute_distance(self._tensor(np.ascontiguousarray(points, dtype=np.float32))).numpy()
