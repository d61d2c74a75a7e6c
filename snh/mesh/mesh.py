"""A coloured triangle mesh and its files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from snh.errors import DataError, OutputError
from snh.files import write_atomically
from snh.mesh.raycast import RayScene

# glTF is y up and looks along -z; our cameras are y down and look along +z.
_GLTF_AXES = np.array([1, -1, -1], dtype=np.float32)


@dataclass(frozen=True)
class Mesh:
    """Triangles whose counter-clockwise side faces free space.

    vertices [V, 3] float32 m, faces [F, 3] int32, colors [V, 3] uint8.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray

    @staticmethod
    def empty() -> Mesh:
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))

    def face_normals(self) -> np.ndarray:
        """Unit normals [F, 3] float32; zero for a triangle without area."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return _normalized(np.cross(b - a, c - a))

    def vertex_normals(self) -> np.ndarray:
        """Area-weighted mean normals of the triangles around each vertex, unit, [V, 3] float32."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        weighted = np.cross(b - a, c - a)
        corners = self.faces.ravel()
        sums = [np.bincount(corners, np.repeat(weighted[:, k], 3), len(self.vertices)) for k in range(3)]
        return _normalized(np.stack(sums, axis=-1).astype(np.float32))

    def area(self) -> float:
        """Area of all triangles, m^2."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=-1).sum())

    @cached_property
    def scene(self) -> RayScene:
        """The mesh made ready for ray casting, once."""
        return RayScene(self.vertices, self.faces)

    def select_faces(self, keep: np.ndarray) -> Mesh:
        """The mesh of the faces where `keep` [F] bool is true, without the vertices that no face uses."""
        faces = self.faces[keep]
        used = np.zeros(len(self.vertices), dtype=bool)
        used[faces] = True
        new_index = np.cumsum(used, dtype=np.int32) - 1
        return Mesh(self.vertices[used], new_index[faces], self.colors[used])

    def without_small_components(self, min_faces: int) -> Mesh:
        """The mesh without connected pieces of fewer than `min_faces` triangles."""
        import open3d as o3d

        if len(self.faces) == 0:
            return self
        legacy = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(self.vertices.astype(np.float64)), o3d.utility.Vector3iVector(self.faces)
        )
        piece_of_face, n_faces, _ = legacy.cluster_connected_triangles()
        return self.select_faces(np.asarray(n_faces)[np.asarray(piece_of_face)] >= min_faces)

    def transformed(self, T: np.ndarray) -> Mesh:
        """The mesh after a rigid motion [4, 4]."""
        vertices = self.vertices.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        return Mesh(vertices.astype(np.float32), self.faces, self.colors)


def _normalized(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(length > 0, length, 1)


def save_mesh(mesh: Mesh, path: str | Path) -> None:
    """Write a .ply (world coordinates) or a .glb (turned to glTF's axes: x right, y up, -z forward), atomically.

    Raises OutputError for another suffix, a path that cannot be written, a full disk; nothing half-written is left.
    """
    import trimesh

    path = Path(path)
    kind = path.suffix.lower()
    if kind not in (".ply", ".glb"):
        raise OutputError(f"Cannot write a mesh to {path}: the name must end in .ply or .glb.")
    vertices = mesh.vertices * _GLTF_AXES if kind == ".glb" else mesh.vertices
    shape = trimesh.Trimesh(vertices, mesh.faces, vertex_colors=mesh.colors, process=False)
    write_atomically(path, bytes(shape.export(file_type=kind[1:])))  # type: ignore[arg-type]


def load_mesh(path: str | Path) -> Mesh:
    """Read a mesh that trimesh knows (.ply, .glb, .obj, ...), in the coordinates of the file, pieces merged.

    Textures become vertex colours; a mesh without colour is grey. Raises DataError when it cannot be read or holds
    no triangle.
    """
    import trimesh

    path = Path(path)
    if not path.is_file():
        raise DataError(f"There is no mesh at {path}.")
    try:
        shape = trimesh.load(path, force="mesh", process=False)
    except Exception as error:  # each of trimesh's format readers raises its own types
        raise DataError(f"Cannot read the mesh {path}: {error}.") from error
    if len(getattr(shape, "faces", ())) == 0:
        raise DataError(f"The mesh {path} holds no triangle.")
    return from_trimesh(shape)


def from_trimesh(shape) -> Mesh:
    """A trimesh.Trimesh with its colours taken to the vertices."""
    textured = hasattr(shape.visual, "to_color")
    colors = np.asarray((shape.visual.to_color() if textured else shape.visual).vertex_colors)[:, :3]
    return Mesh(
        np.asarray(shape.vertices, dtype=np.float32), np.asarray(shape.faces, dtype=np.int32), colors.astype(np.uint8)
    )
