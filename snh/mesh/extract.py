"""Blockwise marching cubes on a field that can be asked at any point.

The lattice is global: corner (i, j, k) lies at (i, j, k) * voxel. Blocks are cubes of `block` cells at multiples of
`block`, so memory is that of one block plus the mesh, and neighbours share the corners between them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from snh.errors import SNHError
from snh.mesh.mesh import Mesh

# query(points [N, 3] float32 m, with_color) -> tsdf [N], color [N, 3] in 0..1 or None, valid [N] bool; arrays or
# CPU tensors.
Query = Callable[[np.ndarray, bool], tuple[Any, Any, Any]]

_QUERY_POINTS = 1 << 18  # points per call of the query
_MAX_SLOPE = 2.0  # the field may rise this many times faster than a true distance before a thin surface can be skipped
_KEY_BITS = 20  # bits per axis of a lattice corner in the key of an edge
_SNAP = 1e-3  # cells; vertices nearer to a lattice corner are put there, so that no slivers surround a zero corner


def extract_mesh(
    query: Query,
    blocks: np.ndarray,
    voxel: float,
    truncation: float,
    block: int = 64,
    observed: Callable[[np.ndarray], np.ndarray] | None = None,
    min_faces: int = 0,
) -> Mesh:
    """Zero level of a field as a coloured mesh whose triangles face positive values (free space).

    query: the field, see `Query`; tsdf in units of `truncation` (m). A cell with an invalid corner gives no surface.
    blocks: [B, 3] integer block coordinates, from `candidate_blocks` or `box_blocks`. voxel: edge of a cell, m.
    block: cells along the edge of a block. observed: points [N, 3] -> [N] bool; faces without an observed vertex
    are dropped. min_faces: connected pieces with fewer triangles are dropped.

    Coarse corners are asked first; their cells are refined unless the field there is too far from zero to come back
    within the cell, for any field whose slope is below twice that of a true distance (|d tsdf| <= 2 d / truncation).
    """
    pieces = [_block_surface(query, origin, voxel, truncation, block) for origin in blocks * block]
    mesh = _weld([p for p in pieces if len(p[1])], voxel)
    if observed is not None:
        mesh = mesh.select_faces(np.asarray(observed(mesh.vertices))[mesh.faces].any(axis=1))
    if min_faces > 0:
        mesh = mesh.without_small_components(min_faces)
    return Mesh(mesh.vertices, mesh.faces, _vertex_colors(query, mesh.vertices))


def box_blocks(low: np.ndarray, high: np.ndarray, voxel: float, block: int = 64) -> np.ndarray:
    """Blocks [B, 3] int64 that cover the box from `low` to `high` ([3] m)."""
    size = voxel * block
    first = np.floor(np.asarray(low) / size).astype(np.int64)
    last = np.ceil(np.asarray(high) / size).astype(np.int64)
    axes = [np.arange(a, max(b, a + 1)) for a, b in zip(first, last, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def candidate_blocks(brick_keys: np.ndarray, finest_cell: float, voxel: float, block: int = 64) -> np.ndarray:
    """Blocks [B, 3] int64 where a map can be valid: their projections on all three planes meet a brick of level 0.

    brick_keys: [N] int64 as packed in csrc/common/key.h. finest_cell: cell size of level 0, m.
    """
    level, plane, bricks = unpack_keys(brick_keys)
    finest = [bricks[(level == 0) & (plane == k)] for k in range(3)]
    xy, yz, zx = (_blocks_of_bricks(of_plane, 8 * finest_cell, voxel * block) for of_plane in finest)
    x, y, z = np.intersect1d(xy[:, 0], zx[:, 1]), np.intersect1d(xy[:, 1], yz[:, 0]), np.intersect1d(yz[:, 1], zx[:, 0])
    occupied = _raster(xy, x, y)[:, :, None] & _raster(yz, y, z)[None] & _raster(zx, z, x).T[:, None, :]
    i, j, k = np.nonzero(occupied)
    return np.stack([x[i], y[j], z[k]], axis=-1)


def unpack_keys(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(level [N], plane [N], brick coordinates [N, 2]) of 64-bit keys, as unpack_key in csrc/common/key.h."""
    keys = np.asarray(keys, dtype=np.int64)
    low = (1 << 28) - 1
    bricks = np.stack([(keys >> 28) & low, keys & low], axis=-1) - (1 << 27)
    return keys >> 58, (keys >> 56) & 3, bricks


def _blocks_of_bricks(bricks: np.ndarray, brick_size: float, block_size: float) -> np.ndarray:
    """Unique plane blocks [M, 2] that meet the bricks [N, 2]; a brick spans [i, i + 1] * brick_size."""
    first = np.floor(bricks * brick_size / block_size).astype(np.int64)
    last = np.floor((bricks + 1) * brick_size / block_size).astype(np.int64)
    reach = np.arange(int(np.ceil(brick_size / block_size)) + 1)
    steps = np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1).reshape(1, -1, 2)
    spanned = first[:, None] + steps
    inside = (spanned <= last[:, None]).all(axis=-1)
    return np.unique(spanned[inside], axis=0)


def _raster(pairs: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Which pairs (u, v) of the sorted coordinates u [A], v [B] occur in `pairs` [M, 2]; bool [A, B]."""
    image = np.zeros((len(u), len(v)), dtype=bool)
    known = pairs[np.isin(pairs[:, 0], u) & np.isin(pairs[:, 1], v)]
    image[np.searchsorted(u, known[:, 0]), np.searchsorted(v, known[:, 1])] = True
    return image


def _block_surface(
    query: Query, origin: np.ndarray, voxel: float, truncation: float, block: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(origin [3], vertices [V, 3] float32 in cells from the origin, faces [F, 3]) of one block's surface."""
    tsdf, known = _sample_block(query, origin, voxel, truncation, block)
    if not (known.any() and (tsdf[known] < 0).any() and (tsdf[known] >= 0).any()):
        return origin, np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)
    import open3d as o3d

    # Open3D's volume is [z, y, x] and its triangles face falling values; hence the turns.
    volume = np.ascontiguousarray(np.where(known, tsdf, 1).transpose(2, 1, 0))
    surface = o3d.t.geometry.TriangleMesh.create_isosurfaces(o3d.core.Tensor.from_numpy(volume), [0.0])
    vertices = surface.vertex.positions.numpy()
    faces = surface.triangle.indices.numpy()[:, ::-1]
    cell = np.clip(np.floor(vertices[faces].mean(axis=1)).astype(np.int64), 0, block - 1)
    complete = _all_corners(known)[tuple(cell.T)]
    corner = np.round(vertices)
    return origin, np.where(np.abs(vertices - corner) < _SNAP, corner, vertices), faces[complete]


def _sample_block(
    query: Query, origin: np.ndarray, voxel: float, truncation: float, block: int
) -> tuple[np.ndarray, np.ndarray]:
    """(tsdf [n, n, n] float32, known [n, n, n] bool) at the n = block + 1 corners; not known: invalid or skipped."""
    stride = _skip_stride(voxel, truncation, block)
    n = block + 1
    tsdf = np.zeros((n, n, n), dtype=np.float32)
    known = np.zeros((n, n, n), dtype=bool)
    coarse = np.zeros((n, n, n), dtype=bool)
    coarse[::stride, ::stride, ::stride] = True
    _ask(query, coarse, origin, voxel, tsdf, known)
    if stride > 1 and known.any():
        margin = _margin(stride, voxel, truncation)
        near = _may_hold_surface(tsdf[::stride, ::stride, ::stride], known[::stride, ::stride, ::stride], margin)
        fine = _any_cell(np.kron(near, np.ones((stride,) * 3, dtype=bool))) & ~coarse
        _ask(query, fine, origin, voxel, tsdf, known)
    return tsdf, known


def _margin(stride: int, voxel: float, truncation: float) -> float:
    """Largest |tsdf| at the nearest corner of a coarse cell through which the surface may pass."""
    return _MAX_SLOPE * (np.sqrt(3) / 2) * stride * voxel / truncation


def _skip_stride(voxel: float, truncation: float, block: int) -> int:
    """Coarsest stride whose margin is clearly below 1, where the field of free space stays."""
    stride = 1
    while _margin(2 * stride, voxel, truncation) < 0.9 and block % (2 * stride) == 0:
        stride *= 2
    return stride


def _may_hold_surface(tsdf: np.ndarray, known: np.ndarray, margin: float) -> np.ndarray:
    """Coarse cells to refine, [m, m, m] bool of corners [m + 1, ...]: sign change, near zero, or partly invalid."""
    free = _all_corners(known & (tsdf > margin))
    solid = _all_corners(known & (tsdf < -margin))
    outside = _all_corners(~known)
    return ~(free | solid | outside)


def _ask(
    query: Query, which: np.ndarray, origin: np.ndarray, voxel: float, tsdf: np.ndarray, known: np.ndarray
) -> None:
    """Fill `tsdf` and `known` at the corners where `which` is true."""
    index = np.argwhere(which)
    for part in _parts(index):
        values, _, valid = query(((part + origin) * voxel).astype(np.float32), False)
        place = tuple(part.T)
        known[place] = np.asarray(valid) & np.isfinite(values)
        tsdf[place] = values


def _parts(rows: np.ndarray) -> Iterator[np.ndarray]:
    for start in range(0, len(rows), _QUERY_POINTS):
        yield rows[start : start + _QUERY_POINTS]


def _all_corners(corners: np.ndarray) -> np.ndarray:
    """Cells all of whose eight corners are true, [n, n, n] -> [n - 1, n - 1, n - 1]."""
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        corners = corners[tuple(low)] & corners[tuple(high)]
    return corners


def _any_cell(cells: np.ndarray) -> np.ndarray:
    """Corners that a true cell touches, [n, n, n] -> [n + 1, n + 1, n + 1]."""
    return ~_all_corners(np.pad(~cells, 1, constant_values=True))


def _weld(pieces: list[tuple[np.ndarray, np.ndarray, np.ndarray]], voxel: float) -> Mesh:
    """One mesh from the surfaces of blocks: a vertex lies on one lattice edge, and the edge is its identity."""
    if not pieces:
        return Mesh.empty()
    lowest = np.min([origin for origin, _, _ in pieces], axis=0)
    keys = np.concatenate([_edge_keys(vertices, origin - lowest) for origin, vertices, _ in pieces])
    _, first, index = np.unique(keys, return_index=True, return_inverse=True)
    positions = np.concatenate([(vertices + origin.astype(np.float64)) * voxel for origin, vertices, _ in pieces])
    counts = np.cumsum([0] + [len(vertices) for _, vertices, _ in pieces])
    faces = index[np.concatenate([faces + start for (_, _, faces), start in zip(pieces, counts, strict=False)])]
    a, b, c = faces.T
    mesh = Mesh(positions[first].astype(np.float32), faces.astype(np.int32), np.zeros((len(first), 3), dtype=np.uint8))
    return mesh.select_faces((a != b) & (b != c) & (c != a))


def _edge_keys(vertices: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Identity [V] int64 of the lattice edge on which each vertex lies: its lower corner and its axis (3 = at the
    corner itself). `offset` [3]: the block's origin from the lowest block, cells."""
    base = np.floor(vertices)
    along = vertices - base
    axis = np.where(along.max(axis=1) > 0, along.argmax(axis=1), 3)
    lattice = base.astype(np.int64) + offset
    if len(lattice) and lattice.max() >= 1 << _KEY_BITS:
        raise SNHError(f"The map spans more than {1 << _KEY_BITS} voxels; extract the mesh with a larger voxel.")
    i, j, k = lattice.T
    return ((i << _KEY_BITS | j) << _KEY_BITS | k) << 2 | axis


def _vertex_colors(query: Query, vertices: np.ndarray) -> np.ndarray:
    """Colours of the field at the vertices, [V, 3] uint8."""
    colors = [np.asarray(query(part, True)[1]) for part in _parts(vertices)]
    if not colors:
        return np.zeros((0, 3), dtype=np.uint8)
    return np.round(np.clip(np.concatenate(colors), 0, 1) * 255).astype(np.uint8)
