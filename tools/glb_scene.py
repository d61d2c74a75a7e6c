"""A textured GLB scene, ray cast and shaded: exact z-depth and colour along any ray."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import trimesh

from snh.errors import DataError
from snh.frame import Camera

BACKGROUND = np.float32([205, 220, 235])  # colour of a ray that hits nothing
INVALID = o3d.t.geometry.RaycastingScene.INVALID_ID


class MipTextures:
    """All textures of a scene and their mip levels in one flat buffer, sampled trilinearly, wrapping around.

    A material without a texture is a texture of one pixel, so that sampling has no cases.
    """

    def __init__(self, images: list[np.ndarray]):  # each [H, W, 3] uint8, row 0 at the top (v = 1)
        chains = [mip_chain(image) for image in images]
        self.n_levels = max(len(chain) for chain in chains)
        padded = [[chain[min(k, len(chain) - 1)] for k in range(self.n_levels)] for chain in chains]
        self.height = np.array([[level.shape[0] for level in chain] for chain in padded], np.int32)
        self.width = np.array([[level.shape[1] for level in chain] for chain in padded], np.int32)
        starts = np.cumsum([0] + [level.shape[0] * level.shape[1] for chain in chains for level in chain])
        first = np.cumsum([0] + [len(chain) for chain in chains])
        self.start = np.array(
            [[starts[first[t] + min(k, len(c) - 1)] for k in range(self.n_levels)] for t, c in enumerate(chains)],
            np.int64,
        )
        self.texels = np.concatenate([level.reshape(-1, 3) for chain in chains for level in chain])

    def sample(self, texture: np.ndarray, uv: np.ndarray, footprint: np.ndarray) -> np.ndarray:
        """Colour [N, 3] float32 at uv [N, 2] of texture [N]; footprint [N] is the pixel's width in texels."""
        level = np.clip(np.log2(np.maximum(footprint, 1)), 0, self.n_levels - 1).astype(np.float32)
        lower = level.astype(np.int32)
        blend = (level - lower)[:, None]
        color = self._bilinear(texture, lower, uv) * (1 - blend)
        between = np.flatnonzero(blend[:, 0])
        upper = np.minimum(lower[between] + 1, self.n_levels - 1)
        color[between] += self._bilinear(texture[between], upper, uv[between]) * blend[between]
        return color

    def _bilinear(self, texture: np.ndarray, level: np.ndarray, uv: np.ndarray) -> np.ndarray:
        width, height = self.width[texture, level], self.height[texture, level]
        x, y = uv[:, 0] * width - np.float32(0.5), (1 - uv[:, 1]) * height - np.float32(0.5)
        x0, y0 = np.floor(x), np.floor(y)
        fx, fy = (x - x0)[:, None], (y - y0)[:, None]
        x0, y0 = x0.astype(np.int32) % width, y0.astype(np.int32) % height
        x1, y1 = (x0 + 1) % width, (y0 + 1) % height
        start = self.start[texture, level]
        row0, row1 = start + y0.astype(np.int64) * width, start + y1.astype(np.int64) * width
        top = self.texels[row0 + x0] * (1 - fx) + self.texels[row0 + x1] * fx
        bottom = self.texels[row1 + x0] * (1 - fx) + self.texels[row1 + x1] * fx
        return top * (1 - fy) + bottom * fy


def mip_chain(image: np.ndarray) -> list[np.ndarray]:
    """The image and its halvings by area average, down to one pixel."""
    chain = [image]
    while max(chain[-1].shape[:2]) > 1:
        height, width = (max(1, n // 2) for n in chain[-1].shape[:2])
        chain.append(cv2.resize(chain[-1], (width, height), interpolation=cv2.INTER_AREA))
    return chain


def material_image(mesh: trimesh.Trimesh) -> np.ndarray:
    """Base colour of a mesh as an image [H, W, 3] uint8: its texture times its factor, or one pixel."""
    material = getattr(mesh.visual, "material", None)
    factor = getattr(material, "baseColorFactor", None)
    texture = getattr(material, "baseColorTexture", None)
    color = np.full(3, 255.0) if factor is None else np.asarray(factor, np.float64)[:3]
    if texture is None or getattr(mesh.visual, "uv", None) is None:
        return color.astype(np.uint8).reshape(1, 1, 3)
    return (np.asarray(texture.convert("RGB")) * (color / 255)).astype(np.uint8)


@dataclass(frozen=True)
class Hits:
    """Where rays end: hit [N] bool; of each ray that hits, in order: z [K], triangle [K], barycentric [K, 3]."""

    hit: np.ndarray
    z: np.ndarray
    triangle: np.ndarray
    barycentric: np.ndarray


class GlbScene:
    """Triangles of a GLB file in world coordinates (metres), `up` = 1 (y) or 2 (z).

    Light: a sky that is brighter than the ground, and one lamp in the middle below the ceiling, without shadows;
    faces are lit from the side that is seen, because the orientation of many files cannot be trusted.
    """

    def __init__(self, path: Path, up: str = "auto"):
        meshes = [m for m in load_meshes(path) if len(m.faces)]
        counts = [len(m.faces) for m in meshes]
        offsets = np.cumsum([0] + [len(m.vertices) for m in meshes])
        self.vertices = np.concatenate([m.vertices for m in meshes]).astype(np.float32)
        self.faces = np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=False)]).astype(np.uint32)
        self.normals = np.concatenate([m.vertex_normals for m in meshes]).astype(np.float32)
        self.uv = np.concatenate([vertex_uv(m) for m in meshes]).astype(np.float32)
        images = [material_image(m) for m in meshes]
        unique: dict[bytes, int] = {}
        ids = [unique.setdefault(image.tobytes() + bytes(str(image.shape), "ascii"), len(unique)) for image in images]
        self.textures = MipTextures([images[ids.index(k)] for k in range(len(unique))])
        self.texture_of = np.repeat(ids, counts)
        self.mesh_of = np.repeat(np.arange(len(meshes)), counts)
        self.texel_density = self._texel_density()
        self.low, self.high = self.vertices.min(0), self.vertices.max(0)
        extent = self.high - self.low
        self.up = {"y": 1, "z": 2, "auto": 1 if extent[1] <= extent[2] else 2}[up]
        self.lamp = (self.low + self.high) / 2
        self.lamp[self.up] = self.high[self.up] - 0.3
        self.caster = o3d.t.geometry.RaycastingScene(nthreads=1)
        self.caster.add_triangles(o3d.core.Tensor(self.vertices), o3d.core.Tensor(self.faces))

    def _texel_density(self) -> np.ndarray:
        """Texels per metre of each triangle, [T]."""
        a, b, c = self.vertices[self.faces].transpose(1, 0, 2)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        ua, ub, uc = self.uv[self.faces].transpose(1, 0, 2)
        (x1, y1), (x2, y2) = (ub - ua).T, (uc - ua).T
        texels = (
            np.abs(x1 * y2 - x2 * y1)
            * self.textures.width[self.texture_of, 0]
            * self.textures.height[self.texture_of, 0]
        )
        return np.sqrt(texels / np.maximum(area, 1e-12)).astype(np.float32)

    def cast(self, rays_o: np.ndarray, rays_d: np.ndarray) -> Hits:
        """First hits of rays [N, 3], z in units of the direction's length."""
        rays = np.concatenate([np.broadcast_to(rays_o, rays_d.shape), rays_d], axis=1).astype(np.float32)
        found = self.caster.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        triangle = found["primitive_ids"].numpy()
        hit = triangle != INVALID
        uv = found["primitive_uvs"].numpy()[hit]
        barycentric = np.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], axis=1)
        return Hits(hit, found["t_hit"].numpy()[hit], triangle[hit].astype(np.int64), barycentric)

    def shade(self, hits: Hits, rays_o: np.ndarray, rays_d: np.ndarray, pixel_angle: float) -> np.ndarray:
        """Colour [N, 3] float32 (0..255) of rays; pixel_angle is the pixel's width at depth 1."""
        corners = self.faces[hits.triangle]
        weights = hits.barycentric[:, :, None]
        uv = (self.uv[corners] * weights).sum(1)
        normal = (self.normals[corners] * weights).sum(1)
        direction = rays_d[hits.hit]
        toward = -direction / np.linalg.norm(direction, axis=1, keepdims=True)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True) + np.float32(1e-9)
        cosine = (normal * toward).sum(1)
        normal *= np.where(cosine < 0, -1, 1)[:, None]
        footprint = hits.z * pixel_angle * self.texel_density[hits.triangle] / np.sqrt(np.maximum(np.abs(cosine), 0.1))
        albedo = self.textures.sample(self.texture_of[hits.triangle], uv, footprint)
        color = np.tile(BACKGROUND, (len(hits.hit), 1))
        color[hits.hit] = albedo * self._light(rays_o + direction * hits.z[:, None], normal)[:, None]
        return color

    def _light(self, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
        to_lamp = self.lamp - point
        distance = np.linalg.norm(to_lamp, axis=1)
        lambert = np.maximum((normal * to_lamp).sum(1) / distance, 0)
        sky = np.float32(0.48) + np.float32(0.1) * normal[:, self.up] + np.float32(0.05) * normal[:, 0]
        return sky + np.float32(0.42) * lambert / (1 + (distance / 4) ** 2)

    def render(self, camera: Camera, T_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Image [H, W, 3] uint8 and exact z-depth [H, W] float32 (0 = nothing hit) from a pose.

        Pixels on the outline of a mesh or at a step in depth are the mean of four rays, all others are one ray.
        """
        R, origin = T_wc[:3, :3].astype(np.float32), T_wc[:3, 3].astype(np.float32)
        rays_c = camera.rays()
        rays_d = rays_c.reshape(-1, 3) @ R.T
        hits = self.cast(origin, rays_d)
        depth = np.zeros(len(rays_d), np.float32)
        depth[hits.hit] = hits.z
        color = self.shade(hits, origin, rays_d, 1 / camera.fx)
        outline = np.flatnonzero(self._outline(hits, depth.reshape(camera.height, camera.width)))
        offsets = np.float32([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]]) / (4 * np.float32(camera.fx))
        fine = ((rays_c.reshape(-1, 3)[outline, None] + offsets).reshape(-1, 3)) @ R.T
        color[outline] = self.shade(self.cast(origin, fine), origin, fine, 0.5 / camera.fx).reshape(-1, 4, 3).mean(1)
        rgb = np.clip(np.rint(color), 0, 255).astype(np.uint8)
        return rgb.reshape(camera.height, camera.width, 3), depth.reshape(camera.height, camera.width)

    def _outline(self, hits: Hits, depth: np.ndarray) -> np.ndarray:
        mesh = np.full(depth.size, -1)
        mesh[hits.hit] = self.mesh_of[hits.triangle]
        mesh = mesh.reshape(depth.shape)
        edge = np.zeros(depth.shape, bool)
        across = (mesh[:, 1:] != mesh[:, :-1]) | (np.abs(depth[:, 1:] - depth[:, :-1]) > 0.05 * depth[:, 1:])
        down = (mesh[1:] != mesh[:-1]) | (np.abs(depth[1:] - depth[:-1]) > 0.05 * depth[1:])
        edge[:, 1:] |= across
        edge[:, :-1] |= across
        edge[1:] |= down
        edge[:-1] |= down
        return edge.reshape(-1)

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] in metres from points [N, 3] to the nearest surface."""
        return self.caster.compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()


def load_meshes(path: Path) -> list[trimesh.Trimesh]:
    if not path.is_file():
        raise DataError(f"the scene {path} does not exist; give the path of a .glb file")
    try:
        meshes = trimesh.load(path, force="scene").dump()
    except Exception as error:  # trimesh raises many kinds, all of them mean that the file is no scene
        raise DataError(f"the scene {path} cannot be read as GLB: {error}") from error
    meshes = [m for m in meshes if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    if not meshes:
        raise DataError(f"the scene {path} holds no triangles")
    return meshes


def vertex_uv(mesh: trimesh.Trimesh) -> np.ndarray:
    uv = getattr(mesh.visual, "uv", None)
    return np.zeros((len(mesh.vertices), 2)) if uv is None else np.asarray(uv)
