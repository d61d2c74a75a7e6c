"""Mesh extraction on fields with a known surface, and mesh files."""

import dataclasses
import errno
import os

import numpy as np
import pytest
import trimesh

from snh.errors import DataError, OutputError, SNHError
from snh.mesh import Mesh, box_blocks, candidate_blocks, extract_mesh, load_mesh, save_mesh

TRUNCATION = 0.06
BALL = np.array([0.213, 0.107, 0.009])
LOW, HIGH = np.array([-1.03, -0.71, -0.52]), np.array([0.97, 0.67, 0.55])


def room_distance(points: np.ndarray) -> np.ndarray:
    """Signed distance, m, to a room from LOW to HIGH with a ball in it; positive in the air."""
    points = points.astype(np.float64)
    walls = np.minimum(points - LOW, HIGH - points).min(axis=-1)
    ball = np.linalg.norm(points - BALL, axis=-1) - 0.3
    return np.minimum(walls, ball)


class Room:
    """The room as a field; counts the points it is asked for."""

    def __init__(self, valid=lambda points: np.ones(len(points), dtype=bool), distance=room_distance):
        self.valid, self.distance, self.n_points = valid, distance, 0

    def __call__(self, points: np.ndarray, with_color: bool):
        assert points.dtype == np.float32 and points.shape[1:] == (3,)
        self.n_points += len(points)
        tsdf = np.clip(self.distance(points) / TRUNCATION, -1, 1)
        return tsdf, (points - LOW) / (HIGH - LOW) if with_color else None, self.valid(points)


def extract(query, voxel=0.02, block=32, **options) -> Mesh:
    return extract_mesh(query, box_blocks(LOW - 0.1, HIGH + 0.1, voxel, block), voxel, TRUNCATION, block, **options)


def as_trimesh(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def same_surface(a: Mesh, b: Mesh) -> bool:
    """Equal triangles; vertices are ordered by their lattice edges, so only faces may come in another order."""

    def canonical(faces: np.ndarray) -> np.ndarray:
        first = faces.argmin(axis=1)[:, None]
        turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
        return turned[np.lexsort(turned.T)]

    return (
        a.vertices.shape == b.vertices.shape
        and np.allclose(a.vertices, b.vertices, rtol=0, atol=1e-6)
        and np.array_equal(canonical(a.faces), canonical(b.faces))
    )


def test_surface_is_closed_exact_and_faces_free_space():
    mesh = extract(Room())
    shape = as_trimesh(mesh)
    assert shape.is_watertight and shape.is_winding_consistent
    assert shape.euler_number == 4  # two closed surfaces: walls and ball
    # Linear interpolation cuts edges and corners of the room by up to a voxel / sqrt(12); planes and ball are finer.
    distance = np.abs(room_distance(mesh.vertices))
    assert distance.max() < 0.006 and np.quantile(distance, 0.9) < 5e-4
    center, normal = mesh.vertices[mesh.faces].mean(axis=1), mesh.face_normals()
    free = room_distance(center + 0.005 * normal) > room_distance(center - 0.005 * normal)
    assert free[shape.area_faces > 1e-8].all()
    assert mesh.area() == pytest.approx(2 * (2.0 * 1.38 + 1.38 * 1.07 + 2.0 * 1.07) + 4 * np.pi * 0.3**2, rel=0.01)


@pytest.mark.parametrize("block", [8, 20, 31])
def test_blocks_are_welded_without_seam(block):
    mesh, other_seams = extract(Room(), block=block), extract(Room(), block=64)
    assert len(mesh.vertices) == len(np.unique(mesh.vertices, axis=0))
    assert as_trimesh(mesh).is_watertight
    assert same_surface(mesh, other_seams)


def test_skipping_free_space_loses_nothing():
    """Balls that hold one lattice corner each, at every place of a coarse cell, in a field whose slope is twice that
    of a true distance; the dense lattice is the oracle."""
    voxel = 0.01
    places = np.stack(np.meshgrid(*[[11, 52]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

    def steep(points):
        distance = np.linalg.norm(points - [0.31, 0.33, 0.29], axis=-1) - 0.15
        for center in places * voxel:
            distance = np.minimum(distance, np.linalg.norm(points - center, axis=-1) - 0.6 * voxel)
        return 2 * distance

    sparse, dense = Room(distance=steep), Room(distance=steep)
    skipping = extract_mesh(sparse, np.zeros((1, 3), int), voxel, TRUNCATION, block=64)
    not_skipping = extract_mesh(dense, np.zeros((1, 3), int), voxel, TRUNCATION, block=63)  # odd: cannot be halved
    assert sparse.n_points < 0.5 * dense.n_points
    assert as_trimesh(skipping).body_count == 9
    assert same_surface(skipping, not_skipping)


@pytest.mark.parametrize(("voxel", "last"), [(0.02, 0.40), (0.01, 0.41)])  # without and with a coarse pass
def test_cells_with_an_invalid_corner_give_no_surface(voxel, last):
    mesh = extract(Room(valid=lambda points: points[:, 0] < 0.415), voxel)
    assert mesh.vertices[:, 0].max() == pytest.approx(last, abs=1e-6)
    whole = extract(Room(), voxel)
    assert same_surface(mesh, whole.select_faces((whole.vertices[whole.faces][..., 0] <= last + 1e-6).all(axis=1)))


def test_not_finite_values_are_invalid():
    def broken(points):
        return np.where(points[:, 0] < 0.415, room_distance(points), np.nan)

    assert same_surface(extract(Room(distance=broken)), extract(Room(valid=lambda points: points[:, 0] < 0.415)))


def test_zero_exactly_on_corners():
    """A wall through lattice corners: one sheet, no triangle without area left by welding."""
    mesh = extract(Room(distance=lambda points: np.round(points[:, 2].astype(np.float64), 6)))
    assert len(mesh.faces) == len(np.unique(np.sort(mesh.faces, axis=1), axis=0))
    assert np.allclose(mesh.vertices[:, 2], 0) and np.allclose(mesh.face_normals(), [0, 0, 1])


def test_colors_are_those_of_the_field_at_the_vertices():
    mesh = extract(Room())
    expected = np.clip((mesh.vertices - LOW) / (HIGH - LOW), 0, 1) * 255
    assert np.abs(mesh.colors - expected).max() <= 0.51


def test_field_without_surface_gives_an_empty_mesh():
    for field in (Room(distance=lambda p: np.ones(len(p))), Room(valid=lambda p: np.zeros(len(p), dtype=bool))):
        mesh = extract(field, observed=lambda points: np.ones(len(points), dtype=bool), min_faces=5)
        assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3) and mesh.colors.shape == (0, 3)


def test_observed_keeps_faces_with_an_observed_vertex():
    mesh, whole = extract(Room(), observed=lambda points: points[:, 0] < 0), extract(Room())
    assert same_surface(mesh, whole.select_faces((whole.vertices[whole.faces][..., 0] < 0).any(axis=1)))


def test_small_components_are_removed():
    whole = extract(Room())
    ball_faces = int((np.linalg.norm(whole.vertices[whole.faces].mean(axis=1) - BALL, axis=1) < 0.4).sum())
    assert same_surface(extract(Room(), min_faces=ball_faces), whole)
    walls_only = extract(Room(), min_faces=ball_faces + 1)
    assert len(walls_only.faces) == len(whole.faces) - ball_faces
    assert as_trimesh(walls_only).euler_number == 2


def test_too_wide_a_map_is_refused():
    blocks = np.array([[0, 0, 0], [1 << 16, 0, 0]])
    with pytest.raises(SNHError, match="larger voxel"):
        extract_mesh(Room(distance=lambda p: p[:, 1] - 0.1), blocks, 0.02, TRUNCATION, 32)


def test_far_from_the_origin():
    """100 km away float32 resolves 8 mm; the lattice still closes."""
    offset = np.array([1e5, -1e5, 0.0])
    low, high = LOW + offset, HIGH + offset
    query = Room(distance=lambda points: room_distance(np.round(points - offset, 2)))
    mesh = extract_mesh(query, box_blocks(low - 0.1, high + 0.1, 0.05, 16), 0.05, TRUNCATION, 16)
    assert len(mesh.faces) > 1000


def pack_key(level: int, plane: int, i: int, j: int) -> int:
    return ((level << 2 | plane) << 56) | ((i + (1 << 27)) << 28) | (j + (1 << 27))


def test_candidate_blocks_by_hand():
    """Cells of 2 cm: a brick is 0.16 m. Blocks of 0.32 m hold two bricks along each axis."""
    one_brick_each = [pack_key(0, plane, 0, 0) for plane in range(3)]
    coarse_only = [pack_key(1, plane, 40, 40) for plane in range(3)]
    blocks = candidate_blocks(np.array(one_brick_each + coarse_only), 0.02, 0.01, block=32)
    assert blocks.tolist() == [[0, 0, 0]]
    # x in brick -3 (block -2), y in brick 2 (block 1), z in brick 5 (block 2); a lone xy brick has no partner.
    keys = [pack_key(0, 0, -3, 2), pack_key(0, 1, 2, 5), pack_key(0, 2, 5, -3), pack_key(0, 0, 9, 9)]
    blocks = candidate_blocks(np.array(keys), 0.02, 0.01, block=32)
    assert [-2, 1, 2] in blocks.tolist() and all(abs(b[0] + 2) <= 1 for b in blocks.tolist())


def test_candidate_blocks_need_all_three_planes():
    """Without plane zx, (0, 0, 4) and (4, 0, 0) would be candidates too; bricks and blocks are of one size."""
    places = {0: [(0, 0), (4, 0)], 1: [(0, 0), (0, 4)], 2: [(0, 0), (4, 4)]}
    keys = np.array([pack_key(0, plane, i, j) for plane in places for i, j in places[plane]])
    blocks = candidate_blocks(keys, 0.02, 0.01, block=16).tolist()
    assert [0, 0, 0] in blocks and [4, 0, 4] in blocks
    assert [0, 0, 4] not in blocks and [4, 0, 0] not in blocks


def test_candidate_blocks_cover_all_points_of_the_bricks():
    random = np.random.default_rng(3)
    points = random.uniform([-3, -1, 10], [2, 1.5, 14], (500, 3))
    keys = set()
    for point in np.floor(points / 0.16).astype(int):
        keys |= {pack_key(0, k, point[k], point[(k + 1) % 3]) for k in range(3)}
    for block in (8, 16, 37, 64):
        blocks = {tuple(b) for b in candidate_blocks(np.array(sorted(keys)), 0.02, 0.01, block).tolist()}
        assert {tuple(b) for b in np.floor(points / (0.01 * block)).astype(int).tolist()} <= blocks


def test_no_bricks_give_no_blocks():
    assert candidate_blocks(np.zeros(0, dtype=np.int64), 0.02, 0.01).shape == (0, 3)


@pytest.mark.parametrize("suffix", [".ply", ".glb"])
def test_files_give_back_the_mesh(tmp_path, suffix):
    mesh = extract(Room(), voxel=0.05, block=16)
    save_mesh(mesh, tmp_path / f"mesh{suffix}")
    loaded = load_mesh(tmp_path / f"mesh{suffix}")
    axes = [1, -1, -1] if suffix == ".glb" else [1, 1, 1]  # glTF is y up
    assert np.array_equal(loaded.vertices * np.float32(axes), mesh.vertices)
    assert np.array_equal(loaded.faces, mesh.faces) and np.array_equal(loaded.colors, mesh.colors)
    assert [path.name for path in tmp_path.iterdir()] == [f"mesh{suffix}"]


def test_saving_refuses_in_one_sentence_and_leaves_nothing(tmp_path, monkeypatch):
    mesh = extract(Room(), voxel=0.05, block=16)
    with pytest.raises(OutputError, match=r"\.ply or \.glb"):
        save_mesh(mesh, tmp_path / "mesh.stl")
    with pytest.raises(OutputError, match="No such file"):
        save_mesh(mesh, tmp_path / "missing" / "mesh.ply")

    save_mesh(dataclasses.replace(mesh, colors=mesh.colors * 0), tmp_path / "mesh.ply")
    before = (tmp_path / "mesh.ply").read_bytes()

    def full_disk(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for step in ("fsync", "replace"):
        with monkeypatch.context() as patch, pytest.raises(OutputError, match="No space left"):
            patch.setattr(os, step, full_disk)
            save_mesh(mesh, tmp_path / "mesh.ply")
        assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]
        assert (tmp_path / "mesh.ply").read_bytes() == before


def test_loading_refuses_in_one_sentence(tmp_path):
    with pytest.raises(DataError, match="no mesh at"):
        load_mesh(tmp_path / "missing.ply")
    (tmp_path / "broken.ply").write_bytes(b"ply\nnonsense\n")
    with pytest.raises(DataError, match=r"broken\.ply"):
        load_mesh(tmp_path / "broken.ply")
