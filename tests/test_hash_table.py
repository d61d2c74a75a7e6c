"""hash_table: integers equal to the oracle, always."""

import pytest
import reference
import torch

from snh.ops import HashTable

SIZES = [0, 1, 31, 32, 33, 1000]
FAR = 5_000_000  # vertices: 100 km of the finest level, 2 cm


def random_vertices(n: int, seed: int, centre: int = 0) -> list[tuple[int, int, int, int]]:
    generator = torch.Generator().manual_seed(seed)
    level = torch.randint(0, 6, (n,), generator=generator)
    plane = torch.randint(0, 3, (n,), generator=generator)
    ij = torch.randint(-40, 40, (n, 2), generator=generator) + centre
    return [tuple(row) for row in torch.column_stack([level, plane, ij]).tolist()]


def as_tensors(masks: dict[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
    keys = torch.tensor(list(masks), dtype=torch.int64)
    return keys, torch.tensor([reference.signed(mask) for mask in masks.values()], dtype=torch.int64)


def table_of(*batches) -> HashTable:
    table = HashTable()
    for vertices in batches:
        table.insert(*as_tensors(reference.brick_masks(vertices)))
    return table


def test_by_hand():
    """Level 1 of plane 2; vertex (-1, 7) is the last column, last row of brick (-1, 0)."""
    key = (1 << 58) | (2 << 56) | ((2**27 - 1) << 28) | 2**27
    table = HashTable()
    assert table.insert(torch.tensor([key]), torch.tensor([-(2**63) + 1])) == 1  # bits 63 = (7, 7) and 0 = (0, 0)
    vertices = torch.tensor([[1, 2, -1, 7], [1, 2, -8, 0], [1, 2, -7, 0], [1, 2, 0, 0], [0, 2, -1, 7], [1, 1, -1, 7]])
    assert table.find(vertices).tolist() == [63, 0, -1, -1, -1, -1]
    assert (table.n_bricks, table.n_vertices) == (1, 2)
    assert table.insert(torch.tensor([key]), torch.tensor([2])) == 0
    assert table.find(vertices).tolist() == [63, 0, 1, -1, -1, -1]


@pytest.mark.parametrize("centre", [0, -FAR, FAR])
@pytest.mark.parametrize("n", SIZES)
def test_equals_oracle(n, centre):
    """Three insertions that overlap, then every vertex and as many absent ones."""
    table, oracle = HashTable(), reference.DictTable()
    for seed in range(3):
        masks = reference.brick_masks(random_vertices(n, seed, centre))
        assert table.insert(*as_tensors(masks)) == oracle.insert(masks)
    queries = [v for seed in range(6) for v in random_vertices(n, seed, centre)]
    slots = table.find(torch.tensor(queries, dtype=torch.int64).reshape(-1, 4))
    assert slots.tolist() == [oracle.find(v) for v in queries]
    assert table.n_vertices == sum(mask.bit_count() for _, mask in oracle.bricks.values())


def test_growth_keeps_slots():
    """From 64 bricks of room to thousands: what was found before is found in the same place."""
    first = random_vertices(50, 0)
    table = table_of(first)
    before = table.find(torch.tensor(first))
    room = len(table.probe)
    side = [(0, 0, 8 * i, 8 * j) for i in range(50) for j in range(60)]
    table.insert(*as_tensors(reference.brick_masks(side)))
    assert len(table.probe) > room
    assert len(table.probe) >= 2 * table.n_bricks
    assert torch.equal(table.find(torch.tensor(first)), before)
    assert (table.find(torch.tensor(side)) >= 0).all()
    probed = table.probe[table.probe >= 0]
    assert torch.equal(probed.sort().values, torch.arange(table.n_bricks, dtype=torch.int32))


def test_numbers_ascend_with_keys():
    table = table_of([(0, 0, 80, 0), (0, 0, 0, 0)], [(5, 2, 0, 0), (0, 0, 40, 0), (0, 0, 80, 0)])
    vertices = torch.tensor([[0, 0, 0, 0], [0, 0, 80, 0], [0, 0, 40, 0], [5, 2, 0, 0]])
    assert (table.find(vertices) // 64).tolist() == [0, 1, 2, 3]


def test_from_bricks_is_the_same_table():
    vertices = random_vertices(500, 1)
    table = table_of(vertices[:200], vertices[200:])
    copy = HashTable.from_bricks(table.brick_keys, table.masks)
    assert torch.equal(copy.find(torch.tensor(vertices)), table.find(torch.tensor(vertices)))
    assert copy.insert(*as_tensors(reference.brick_masks([(9, 1, 0, 0)]))) == 1
    assert copy.n_bricks == table.n_bricks + 1
    assert table.to("cpu") is table


def test_beyond_the_key_range_is_absent():
    """Also where the bits of a key would coincide: (0, 4) with (1, 0), and levels that exist nowhere."""
    table = table_of([(0, 0, 0, 0), (1, 0, 0, 0), (20, 0, 0, 0)])
    outside = [[-1, 0, 0, 0], [20, 0, 0, 0], [0, 3, 0, 0], [0, 4, 0, 0], [0, -1, 0, 0]]
    outside += [[0, 0, 2**32, 0], [0, 0, 0, 2**32], [0, 0, 0, -(2**40)]]
    assert table.find(torch.tensor(outside)).tolist() == [-1] * len(outside)


def test_edges_of_the_key_range():
    edges = [(15, 2, -(2**30), -(2**30)), (15, 2, 2**30 - 1, 2**30 - 1), (0, 0, -(2**30), 2**30 - 1)]
    table, oracle = table_of(edges), reference.DictTable()
    oracle.insert(reference.brick_masks(edges))
    assert table.find(torch.tensor(edges)).tolist() == [oracle.find(v) for v in edges]


def test_non_contiguous_input():
    vertices = random_vertices(64, 3)
    keys, masks = as_tensors(reference.brick_masks(vertices))
    strided = torch.stack([keys, masks], dim=1)
    table = HashTable()
    table.insert(strided[:, 0], strided[:, 1])
    wide = torch.zeros(64, 8, dtype=torch.int64)
    wide[:, ::2] = torch.tensor(vertices)
    assert torch.equal(table.find(wide[:, ::2]), table_of(vertices).find(torch.tensor(vertices)))


@pytest.mark.parametrize(
    ("keys", "masks", "sentence"),
    [
        (torch.tensor([2, 1]), torch.tensor([1, 1]), "strictly ascending, entry 1"),
        (torch.tensor([1, 1]), torch.tensor([1, 1]), "strictly ascending, entry 1"),
        (torch.tensor([-1, 1]), torch.tensor([1, 1]), "non-negative"),
        (torch.tensor([1, 2]), torch.tensor([1]), r"'new_masks' must have shape \[2\], got \[1\]"),
        (torch.tensor([1.0]), torch.tensor([1]), "'keys' must be Long, got Float"),
    ],
)
def test_bad_input_is_refused_and_nothing_changes(keys, masks, sentence):
    table = table_of([(0, 0, 0, 0)])
    with pytest.raises(RuntimeError, match=sentence):
        table.insert(keys, masks)
    assert (table.n_bricks, table.n_vertices) == (1, 1)


def test_repeated_brick_is_refused():
    with pytest.raises(RuntimeError, match="must not repeat a key, entry 1 does"):
        HashTable.from_bricks(torch.tensor([5, 5]), torch.tensor([1, 1]))


def test_opcheck():
    ops = torch.ops.snh
    vertices = torch.tensor(random_vertices(33, 0))
    table = table_of(vertices.tolist())
    keys, masks = as_tensors(reference.brick_masks(random_vertices(5, 9)))
    storage = [table.probe.clone(), table._brick_keys.clone(), table._masks.clone()]
    torch.library.opcheck(ops.hash_table_build.default, (table.brick_keys, len(table.probe)))
    torch.library.opcheck(ops.hash_table_numbers.default, (table.probe, table.brick_keys, keys))
    torch.library.opcheck(ops.hash_table_find.default, (table.probe, table.brick_keys, table.masks, vertices))
    torch.library.opcheck(ops.hash_table_insert_.default, (*storage, table.n_bricks, keys, masks))
