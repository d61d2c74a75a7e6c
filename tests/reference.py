"""The dumb oracle: each op again in plain Python, with no structure in common with csrc/. Slow on purpose."""

# --- hash_table -------------------------------------------------------------------------------------------------------


def vertex_key(level: int, plane: int, i: int, j: int) -> tuple[int, int]:
    """(key of the brick, bit of the vertex in its mask), by division with remainder instead of shifts."""
    brick_i, local_i = divmod(i, 8)
    brick_j, local_j = divmod(j, 8)
    key = ((level * 4 + plane) * 2**28 + brick_i + 2**27) * 2**28 + brick_j + 2**27
    return key, local_i + 8 * local_j


def brick_masks(vertices) -> dict[int, int]:
    """Mask (an unsigned number) of each brick that holds one of the vertices (level, plane, i, j), keys ascending."""
    masks: dict[int, int] = {}
    for vertex in vertices:
        key, bit = vertex_key(*vertex)
        masks[key] = masks.get(key, 0) | 1 << bit
    return dict(sorted(masks.items()))


def signed(mask: int) -> int:
    """The same 64 bits as a signed number, as tensors hold them."""
    return mask - 2**64 if mask >= 2**63 else mask


class DictTable:
    """Hash table by a dict from brick key to [number, mask]."""

    def __init__(self):
        self.bricks: dict[int, list[int]] = {}

    def insert(self, masks: dict[int, int]) -> int:
        before = len(self.bricks)
        for key in sorted(masks):
            self.bricks.setdefault(key, [len(self.bricks), 0])[1] |= masks[key]
        return len(self.bricks) - before

    def find(self, vertex) -> int:
        key, bit = vertex_key(*vertex)
        number, mask = self.bricks.get(key, (0, 0))
        return number * 64 + bit if mask >> bit & 1 else -1
