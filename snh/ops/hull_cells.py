"""The vertices that a frame creates: every cell that touches the scaled convex hull of its points on each plane."""

from collections.abc import Sequence

import torch
from torch import Tensor

from snh.ops._library import native


def hull_cells(
    points: Tensor,  # [N, 3] m, world
    origin: Tensor,  # [3] m, world
    cell_sizes: Sequence[float],  # L sizes, m
    hull_scale: float = 1.1,
) -> tuple[Tensor, Tensor]:  # [M] int64, [M] int64
    """Keys (ascending) and 64-bit masks of all bricks with vertices to create, ready for `HashTable.insert`.

    Paper, eq. 1 and 2: points and camera centre `origin` are seen on the planes xy, yz and zx; their convex hull is
    scaled by `hull_scale` about the centroid of its area (a hull without area: about the mean of its corners). Level l
    has square cells of side cell_sizes[l]; a cell is touched when it holds, in the sense of floor(), a point of the
    closed scaled hull, and all its four corners are created. float32 or float64; N may be 0; not differentiable.

    Raises RuntimeError when shapes or dtypes do not fit, a coordinate is not finite, the hull reaches beyond 2^29
    cells from the world's origin, or its bounding box would need more than 2^24 bricks on one plane.

    >>> import torch
    >>> from snh.ops import HashTable
    >>> keys, masks = hull_cells(torch.tensor([[0.03, 0.01, 0.01]]), torch.full((3,), 0.01), [0.02])
    >>> table = HashTable()
    >>> table.insert(keys, masks), table.n_vertices  # on xy cells (0, 0), (1, 0), on yz (0, 0), on zx (0, 0), (0, 1)
    (3, 16)
    """
    return native.hull_cells(points, origin, cell_sizes, hull_scale)


def plane_hulls(
    points: Tensor,  # [N, 3] m, world
    origin: Tensor,  # [3] m, world
    hull_scale: float = 1.1,
) -> list[Tensor]:  # 3 x [M, 2] m
    """The scaled hulls themselves, for pictures: hull_corners (u, v) on the planes xy, yz and zx, counter-clockwise.

    Arguments and errors as in `hull_cells`. Points on a line give two corners, a single point one.

    >>> import torch
    >>> square = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]])
    >>> plane_hulls(square, torch.ones(3), hull_scale=2.0)[0]
    tensor([[-1., -1.],
            [ 3., -1.],
            [ 3.,  3.],
            [-1.,  3.]])
    """
    return [native.plane_hull(points, origin, plane, hull_scale) for plane in range(3)]


@torch.library.register_fake("snh::hull_cells")
def _(points, origin, cell_sizes, hull_scale):
    n_bricks = torch.library.get_ctx().new_dynamic_size()
    return points.new_empty(n_bricks, dtype=torch.int64), points.new_empty(n_bricks, dtype=torch.int64)


@torch.library.register_fake("snh::plane_hull")
def _(points, origin, plane, hull_scale):
    return points.new_empty(torch.library.get_ctx().new_dynamic_size(), 2)
