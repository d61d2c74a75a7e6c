"""Features of points, interpolated on the three planes of every level."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from snh.ops._library import native
from snh.ops.hash_table import HashTable


def plane_lookup(
    points: Tensor,  # [N, 3] m, world
    features: Tensor,  # [V, C], V >= 64 B
    table: HashTable,
    cell_sizes: Sequence[float],  # L, m; level 0 = finest
    n_features: int = 3,  # F <= C
    reduce: str = "sum",
) -> tuple[Tensor, Tensor]:  # [N, L*F], [N, L, 3] bool
    """Multi-level bilinear features (paper, eq. 4) and whether all four corners exist on each level and plane.

    Per level the three planes are summed, or multiplied (`reduce="prod"`), or concatenated (`"cat"`: [N, L*3*F]). A
    corner without a vertex counts as zero. Differentiable twice in `points` and `features` (surface normals and eikonal
    losses), which must have one dtype, float32 or float64. `features` may be wider than `n_features`; the further
    columns are not read and get zero gradient. The result does not depend on the number of threads.

    Raises RuntimeError when shapes, dtypes or sizes do not fit.

    One cell of 1 m on each plane, with the feature 1 at the corner (0, 0) of the xy plane alone:

    >>> import torch
    >>> from snh.ops import HashTable, plane_lookup
    >>> table = HashTable()
    >>> _ = table.insert(torch.tensor([1 << 55 | 1 << 27]), torch.tensor([0b11_00000011]))  # brick 0 of plane 0
    >>> features = torch.zeros(64 * table.n_bricks, 4)
    >>> features[0, :3] = 1
    >>> encoded, valid = plane_lookup(torch.tensor([[0.25, 0.5, 0.5]]), features, table, cell_sizes=[1.0])
    >>> encoded
    tensor([[0.3750, 0.3750, 0.3750]])
    >>> valid
    tensor([[[ True, False, False]]])
    """
    return native.plane_lookup(
        points, features, table.probe, table.brick_keys, table.masks, list(cell_sizes), n_features, reduce
    )


def _width(cell_sizes: Sequence[float], n_features: int, reduce: str) -> int:
    return len(cell_sizes) * n_features * (3 if reduce == "cat" else 1)


@torch.library.register_fake("snh::plane_lookup")
def _(points, features, probe, brick_keys, masks, cell_sizes, n_features, reduce):
    encoded = points.new_empty(points.shape[0], _width(cell_sizes, n_features, reduce))
    return encoded, points.new_empty(points.shape[0], len(cell_sizes), 3, dtype=torch.bool)


@torch.library.register_fake("snh::plane_lookup_backward")
def _(grad, points, features, probe, brick_keys, masks, cell_sizes, n_features, reduce, need_points, need_features):
    grad_points = points.new_empty(points.shape[0] if need_points else 0, 3)
    return grad_points, features.new_empty(features.shape[0] if need_features else 0, features.shape[1])


@torch.library.register_fake("snh::plane_lookup_double_backward")
def _(v_p, v_f, grad, points, features, probe, brick_keys, masks, cell_sizes, n_features, reduce, need_features):
    grad_features = features.new_empty(features.shape[0] if need_features else 0, features.shape[1])
    return grad.new_empty(grad.shape), points.new_empty(points.shape), grad_features


def _save(ctx, inputs, output):
    points, features, *table, ctx.cell_sizes, ctx.n_features, ctx.reduce = inputs
    ctx.save_for_backward(points, features, *table)


def _backward(ctx, grad_encoded, _grad_valid):
    need_points, need_features = ctx.needs_input_grad[:2]
    grad_points, grad_features = native.plane_lookup_backward(
        grad_encoded, *ctx.saved_tensors, ctx.cell_sizes, ctx.n_features, ctx.reduce, need_points, need_features
    )
    return (grad_points if need_points else None, grad_features if need_features else None, *[None] * 6)


def _save_backward(ctx, inputs, output):
    *tensors, ctx.cell_sizes, ctx.n_features, ctx.reduce, ctx.need_points, ctx.need_features = inputs
    ctx.save_for_backward(*tensors)


def _double_backward(ctx, v_points, v_features):
    need_grad, need_points, need_features = ctx.needs_input_grad[:3]
    grads = native.plane_lookup_double_backward(
        v_points if ctx.need_points else None, v_features if ctx.need_features else None,
        *ctx.saved_tensors, ctx.cell_sizes, ctx.n_features, ctx.reduce, need_features,
    )  # fmt: skip
    wanted = (need_grad, need_points, need_features)
    return (*[grad if want else None for grad, want in zip(grads, wanted, strict=True)], *[None] * 8)


def _no_third(ctx, *grads):
    raise NotImplementedError("snh::plane_lookup: third derivatives do not exist; use create_graph only once")


torch.library.register_autograd("snh::plane_lookup", _backward, setup_context=_save)
torch.library.register_autograd("snh::plane_lookup_backward", _double_backward, setup_context=_save_backward)
torch.library.register_autograd("snh::plane_lookup_double_backward", _no_third)
