"""Points as features on hashed planes that grow with what the camera sees."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor, nn

from snh.ops import HashTable, hull_cells, plane_lookup
from snh.ops.field import FEATURE_STRIDE
from snh.ops.hash_table import BRICK_VERTICES

AnyOptimizer = TypeVar("AnyOptimizer", bound=torch.optim.Optimizer)


class PlaneHashEncoding(nn.Module):
    """Multi-level features of points, interpolated on three planes that exist only where they were allocated.

    Paper, section III-A, eq. 1 to 4. Nothing needs bounds: call `allocate_hull` with each frame, or `allocate_box`.
    Vertices are never moved or dropped. `features` [64 B, 4] stays the same Parameter while it grows, so an optimiser
    keeps working after `follow_growth(optimizer)`; losses computed before a growth cannot be differentiated after it.

    Args:
        cell_sizes  side of a cell per level, m, at most 16; the paper has 6, from 0.02 to 0.32 (eq. 3)
        n_features  F per level, at most 4
        reduce      of the three planes: "sum" (eq. 4), "prod" or "cat"
        init_std    standard deviation of new features. They depend on the vertex and the seed alone, not on the order
                    of allocations nor on the device
        seed        of these values

    A new frame, then features of its points:

    >>> import torch
    >>> encoding = PlaneHashEncoding(cell_sizes=[0.1, 0.4])
    >>> points = torch.rand(100, 3)
    >>> encoding.allocate_hull(points, origin=torch.zeros(3)) > 0
    True
    >>> encoding(points).shape
    torch.Size([100, 6])
    >>> encoded, valid = encoding(torch.tensor([[0.1, 0.1, 0.1], [9, 9, 9]]), return_valid=True)
    >>> valid
    tensor([ True, False])
    """

    features: nn.Parameter

    def __init__(
        self,
        cell_sizes: Sequence[float],
        n_features: int = 3,
        reduce: str = "sum",
        init_std: float = 0.0,
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        super().__init__()
        self.cell_sizes = tuple(cell_sizes)
        self.n_features = n_features
        self.reduce = reduce
        self.init_std = init_std
        self.seed = seed
        self.table = HashTable()
        self._storage = torch.zeros(0, FEATURE_STRIDE, dtype=dtype)  # `features` is a view of its first rows
        self.features = nn.Parameter(self._storage[:0])

    @property
    def width(self) -> int:
        """Length of an encoded point."""
        return len(self.cell_sizes) * self.n_features * (3 if self.reduce == "cat" else 1)

    @property
    def n_vertices(self) -> int:
        """Vertices that exist, all planes and levels."""
        return self.table.n_vertices

    def memory_bytes(self, occupied: bool = False) -> int:
        """Bytes held by features and table; or, `occupied`, of the F features of the vertices that exist alone."""
        if occupied:
            return self.n_vertices * self.n_features * self.features.element_size()
        return self._storage.nbytes + self.table.n_bytes

    def allocate_hull(self, points: Tensor, origin: Tensor, hull_scale: float = 1.1) -> int:
        """Makes every vertex of the cells that the scaled hull of a frame touches. Returns how many bricks are new.

        Eq. 1 and 2: points [N, 3] m, world, and the camera centre origin [3]; see `snh.ops.hull_cells` for errors.
        """
        return self._allocate(*hull_cells(points, origin, self.cell_sizes, hull_scale))

    def allocate_box(self, low: Sequence[float], high: Sequence[float]) -> int:
        """Makes every vertex of the cells that the box between two opposite corners, m, touches."""
        corners = torch.tensor(list(itertools.product(*zip(low, high, strict=True))), dtype=self.features.dtype)
        return self.allocate_hull(corners, corners[0], hull_scale=1.0)

    def forward(self, points: Tensor, return_valid: bool = False) -> Tensor | tuple[Tensor, Tensor]:
        """Features [..., width] of points [..., 3] m; differentiable twice. See `snh.ops.plane_lookup`.

        With `return_valid` also [...] bool: all corners exist on all planes and levels. Others count as zero.
        """
        encoded, valid = plane_lookup(
            points.reshape(-1, 3), self.features, self.table, self.cell_sizes, self.n_features, self.reduce
        )
        encoded = encoded.reshape(*points.shape[:-1], self.width)
        return (encoded, valid.all(-1).all(-1).reshape(points.shape[:-1])) if return_valid else encoded

    def extra_repr(self) -> str:
        return f"cell_sizes={self.cell_sizes}, n_features={self.n_features}, reduce={self.reduce!r}"

    # --- growth -------------------------------------------------------------------------------------------------------

    def _allocate(self, keys: Tensor, masks: Tensor) -> int:
        table = self.table
        before = table.masks.clone()
        n_new = table.insert(keys.to(table.device), masks.to(table.device))
        if n_new:
            self._resize(BRICK_VERTICES * table.n_bricks)
        if self.init_std:
            self._initialise(table.masks & ~_with_rows(before, table.n_bricks))
        return n_new

    def _resize(self, n_rows: int) -> None:
        """Appends zero rows to `features` and its gradient; storage doubles, so that this is rarely a copy."""
        self._own_features()
        if n_rows > len(self._storage):
            self._storage = _with_rows(self.features.data, max(n_rows, 2 * len(self._storage)))
        grad = self.features.grad
        self._set_features(self._storage[:n_rows])
        self.features.grad = None if grad is None else _with_rows(grad, n_rows)

    def _set_features(self, rows: Tensor) -> None:
        self.features.grad = None
        # Autograd remembers the shape in a node that lives as long as any old loss; data of another type drops it.
        other = torch.float64 if self.features.dtype == torch.float32 else torch.float32
        self.features.data = torch.empty(0, dtype=other, device=rows.device)
        self.features.data = rows

    def _own_features(self) -> None:
        """Takes over data that somebody else, such as Module.to, gave to `features`."""
        if self._storage.data_ptr() != self.features.data_ptr():
            self._storage = self.features.data

    def _initialise(self, new_masks: Tensor) -> None:
        """Random features for the vertices that new_masks [B] names."""
        numbers = new_masks.nonzero()[:, 0]
        places = torch.arange(BRICK_VERTICES, device=new_masks.device)
        exists = new_masks[numbers, None] >> places & 1
        values = _normal(self.table.brick_keys[numbers], self.n_features, self.seed)  # [K, 64, F] float64
        rows = self.features.data.view(-1, BRICK_VERTICES, FEATURE_STRIDE)
        rows[numbers, :, : self.n_features] += (self.init_std * values * exists[..., None]).to(rows.dtype)

    # --- nn.Module ----------------------------------------------------------------------------------------------------

    def _apply(self, fn, recurse=True):
        super()._apply(fn, recurse)
        self.table = self.table.to(self.features.device)
        self._own_features()
        return self

    def _save_to_state_dict(self, destination, prefix, keep_vars):
        destination[prefix + "features"] = (
            self.features if keep_vars else self.features.detach().clone()
        )  # not the room
        destination[prefix + "brick_keys"] = self.table.brick_keys.clone()
        destination[prefix + "masks"] = self.table.masks.clone()

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, errors):
        names = [prefix + name for name in ("features", "brick_keys", "masks")]
        absent = [name for name in names if name not in state_dict]
        if absent:
            missing_keys.extend(absent)
            return
        features, brick_keys, masks = (state_dict[name].to(self.features.device) for name in names)
        if features.shape != (BRICK_VERTICES * len(brick_keys), FEATURE_STRIDE) or masks.shape != brick_keys.shape:
            errors.append(
                f"{names[0]} {list(features.shape)} does not fit {len(brick_keys)} bricks of {BRICK_VERTICES}"
            )
            return
        self.table = HashTable.from_bricks(brick_keys, masks)
        self._storage = features.to(self.features.dtype, copy=True)
        self._set_features(self._storage)


def follow_growth(optimizer: AnyOptimizer) -> AnyOptimizer:
    """Lets an optimiser of torch.optim work on parameters that grow: its moments get zero rows before each step.

    Rows that exist keep their moments. Adam's count of steps is one per parameter, so a new row has no warm-up: its
    first update is (1 - beta1) / sqrt(1 - beta2) x lr. Call once; returns the optimiser.

    >>> encoding = PlaneHashEncoding([0.1])
    >>> optimizer = follow_growth(torch.optim.Adam(encoding.parameters(), lr=0.01))
    """
    optimizer.register_step_pre_hook(_grow_moments)
    return optimizer


def _grow_moments(optimizer: torch.optim.Optimizer, *_) -> None:
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if isinstance(value, Tensor) and value.dim() and value.shape[1:] == parameter.shape[1:]:
                state[name] = _with_rows(value, len(parameter))


def _with_rows(tensor: Tensor, n_rows: int) -> Tensor:
    """The tensor with zero rows appended up to n_rows; itself where it has them."""
    if n_rows <= len(tensor):
        return tensor
    longer = tensor.new_zeros(n_rows, *tensor.shape[1:])
    longer[: len(tensor)] = tensor
    return longer


def _normal(keys: Tensor, n_features: int, seed: int) -> Tensor:
    """Nearly normal numbers [K, 64, F] float64 for every vertex of bricks, the same on every device.

    The sum of four 16-bit uniforms from an integer hash (variance one after scaling): no rounded function such as a
    logarithm takes part.
    """
    places = torch.arange(BRICK_VERTICES * n_features, device=keys.device) + 1
    bits = _mix(_mix(keys + _int64(seed * _GOLDEN))[:, None] + places * _int64(_GOLDEN))
    lanes = bits[..., None] >> torch.tensor([0, 16, 32, 48], device=keys.device) & 0xFFFF
    normal = (lanes.sum(-1) - 2 * 0xFFFF).double() / ((2**32 - 1) / 3) ** 0.5
    return normal.view(len(keys), BRICK_VERTICES, n_features)


_GOLDEN = 0x9E3779B97F4A7C15


def _int64(number: int) -> int:
    """The number modulo 2^64, as int64 holds it."""
    return (number + 2**63) % 2**64 - 2**63


def _mix(x: Tensor) -> Tensor:
    """Finaliser of splitmix64 on int64, which wraps around; its shifts are logical ones."""
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ (x >> shift & 2 ** (64 - shift) - 1)) * _int64(factor)
    return x ^ (x >> 31 & 2**33 - 1)
