"""The one hash table of a map: which vertices exist, and which feature row each has."""

from __future__ import annotations

import torch
from torch import Tensor

from snh.ops._library import native

BRICK_VERTICES = 64  # vertices of a brick (8 x 8) and bits of its mask
_SMALLEST = 64  # bricks for which an empty table has room
_BITS = torch.tensor([bin(byte).count("1") for byte in range(256)])


class HashTable:
    """Vertices of all planes and levels, in bricks of 8 x 8 with a 64-bit mask of those that exist.

    Paper, section III-A: a single hash table, with keys that are one-to-one where the paper's tag is not. Keys and
    masks come from `hull_cells`; a vertex (level, plane, i, j) lies at (i, j) x cell_size on its plane. Its slot, 64 x
    brick number + place in the brick, is its row of the feature table and never changes. New bricks are numbered in
    ascending key order per insertion, so the same insertions give the same slots on every device.

    Attributes, exact in size and valid until the next insertion:
        probe       [capacity] int32    brick number or -1; at most half of it is used
        brick_keys  [B] int64           key of each brick
        masks       [B] int64           vertices of each brick that exist

    >>> import torch
    >>> table = HashTable()
    >>> keys, masks = torch.tensor([2**55 + 2**27, 2**55 + 2**28 + 2**27]), torch.tensor([0b11, 0b1])
    >>> table.insert(keys, masks)
    2
    >>> table.find(torch.tensor([[0, 0, 0, 0], [0, 0, 1, 0], [0, 0, 2, 0], [0, 0, 8, 0]]))
    tensor([ 0,  1, -1, 64])
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self.n_bricks = 0
        self._brick_keys = torch.zeros(_SMALLEST, dtype=torch.int64, device=device)
        self._masks = torch.zeros(_SMALLEST, dtype=torch.int64, device=device)
        self.probe = native.hash_table_build(self.brick_keys, 2 * _SMALLEST)

    @classmethod
    def from_bricks(cls, brick_keys: Tensor, masks: Tensor) -> HashTable:
        """The table with these bricks, numbered as given: [B] int64 each, no key twice. On their device."""
        table = cls(brick_keys.device)
        table._reserve(len(brick_keys))
        table.n_bricks = len(brick_keys)
        table.brick_keys.copy_(brick_keys)
        table.masks.copy_(masks)
        table.probe = native.hash_table_build(table.brick_keys, len(table.probe))
        return table

    @property
    def brick_keys(self) -> Tensor:
        return self._brick_keys[: self.n_bricks]

    @property
    def masks(self) -> Tensor:
        return self._masks[: self.n_bricks]

    @property
    def device(self) -> torch.device:
        return self.probe.device

    @property
    def n_vertices(self) -> int:
        """Vertices that exist."""
        return int(_BITS.to(self.device)[self.masks.view(torch.uint8).long()].sum())

    @property
    def n_bytes(self) -> int:
        """Memory held, also for bricks to come."""
        return sum(t.numel() * t.element_size() for t in (self.probe, self._brick_keys, self._masks))

    def insert(self, keys: Tensor, masks: Tensor) -> int:
        """Adds the vertices `masks` [M] int64 of the bricks `keys` [M] int64, strictly ascending.

        Returns how many bricks are new. What exists already stays as it is.
        Raises RuntimeError when shapes or dtypes do not fit or keys do not ascend; then nothing is changed.
        """
        missing = native.hash_table_numbers(self.probe, self.brick_keys, keys) < 0
        n_new = int(missing.sum())
        self._reserve(self.n_bricks + n_new)
        native.hash_table_insert_(self.probe, self._brick_keys, self._masks, self.n_bricks, keys, masks)
        self.n_bricks += n_new
        return n_new

    def find(self, vertices: Tensor) -> Tensor:
        """Slots [N] int64 of the vertices (level, plane, i, j) [N, 4] int64, -1 where no such vertex exists."""
        return native.hash_table_find(self.probe, self.brick_keys, self.masks, vertices)

    def to(self, device: torch.device | str) -> HashTable:
        """The same table, slots included, on another device; this one where it is there already."""
        if torch.device(device) == self.device:
            return self
        return HashTable.from_bricks(self.brick_keys.to(device), self.masks.to(device))

    def _reserve(self, n_bricks: int) -> None:
        """Makes room for n_bricks by doubling, which keeps the cost per brick constant."""
        room = len(self._masks)
        if n_bricks <= room:
            return
        while room < n_bricks:
            room *= 2
        for name in ("_brick_keys", "_masks"):
            longer = torch.zeros(room, dtype=torch.int64, device=self.device)
            longer[: self.n_bricks] = getattr(self, name)[: self.n_bricks]
            setattr(self, name, longer)
        self.probe = native.hash_table_build(self.brick_keys, 2 * room)


@torch.library.register_fake("snh::hash_table_build")
def _(brick_keys, capacity):
    return brick_keys.new_empty(capacity, dtype=torch.int32)


@torch.library.register_fake("snh::hash_table_numbers")
def _(probe, brick_keys, keys):
    return keys.new_empty(keys.shape[0], dtype=torch.int32)


@torch.library.register_fake("snh::hash_table_insert_")
def _(probe, brick_keys, masks, n_bricks, keys, new_masks):
    return None


@torch.library.register_fake("snh::hash_table_find")
def _(probe, brick_keys, masks, vertices):
    return vertices.new_empty(vertices.shape[0])
