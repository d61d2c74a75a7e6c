"""hull_cells: integers equal to the oracle; corners within the rounding of their type."""

import math
from fractions import Fraction

import pytest
import reference
import torch

from snh.ops import HashTable, hull_cells, plane_hulls

SIZES = [0, 1, 31, 32, 33]
CELLS = [0.5, 0.7, 1.0]  # m
FAR = 100_000.0  # m


def as_dict(keys: torch.Tensor, masks: torch.Tensor) -> dict[int, int]:
    assert torch.equal(keys, keys.unique())  # ascending, no key twice
    return {key: mask % 2**64 for key, mask in zip(keys.tolist(), masks.tolist(), strict=True)}


def vertices_of(keys: torch.Tensor, masks: torch.Tensor, plane: int, level: int = 0) -> set[tuple[int, int]]:
    """Vertices (i, j) near the origin, by look-up."""
    table = HashTable()
    table.insert(keys, masks)
    near = [(i, j) for i in range(-20, 21) for j in range(-20, 21)]
    slots = table.find(torch.tensor([(level, plane, i, j) for i, j in near]))
    return {vertex for vertex, slot in zip(near, slots.tolist(), strict=True) if slot >= 0}


def corners_of(*cells: tuple[int, int]) -> set[tuple[int, int]]:
    return {(i + di, j + dj) for i, j in cells for di in (0, 1) for dj in (0, 1)}


def cells_from_corners(hulls: list[torch.Tensor], size: float) -> list:
    """The hulls of the op in cells, as the contract says: the rounded product of a look-up, cut to 2^-32 cells."""
    inv_cell = torch.tensor(1 / size, dtype=hulls[0].dtype)
    return [
        [
            tuple(Fraction(math.floor(Fraction(x) * 2**32), 2**32) for x in corner)
            for corner in (hull * inv_cell).tolist()
        ]
        for hull in hulls
    ]


def oracle_from_corners(points, origin, scale) -> dict[int, int]:
    """Bricks by the oracle, starting from the op's own corners: judges every integer decision in any type."""
    hulls = plane_hulls(points, origin, scale)
    vertices = [
        (level, plane, i, j)
        for level, size in enumerate(CELLS)
        for plane, polygon in enumerate(cells_from_corners(hulls, size))
        for i, j in reference.polygon_vertices(polygon)
    ]
    return reference.brick_masks(vertices)


@pytest.mark.parametrize(
    ("corners", "cells"),
    [
        ([(0.5, 0.5)], [(0, 0)]),
        ([(1.0, -1.0)], [(1, -1)]),  # a cell owns its lower sides
        ([(-1e-9, 0.5)], [(-1, 0)]),
        ([(0.0, 0.0), (2.0, 0.0)], [(0, 0), (1, 0), (2, 0)]),  # two points
        ([(0.0, 0.0), (2.0, 2.0), (1.0, 1.0)], [(0, 0), (1, 1), (2, 2)]),  # on a line, through vertices
        ([(0.0, 2.0), (2.0, 0.0)], [(0, 2), (0, 1), (1, 1), (1, 0), (2, 0)]),  # falling through a vertex
        ([(0.5, 0.0), (0.5, 1.5)], [(0, 0), (0, 1)]),  # upright
        ([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0)], [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (0, 2)]),
        ([(2.0, 2.0), (2.0, 0.0), (0.0, 2.0)], [(1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (0, 2), (1, 2), (2, 2)]),
        ([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], [(0, 0), (1, 0), (0, 1), (1, 1)]),
        ([(0.5, 0.5), (1.5, 2.5)], [(0, 0), (0, 1), (1, 1), (1, 2)]),  # crosses u = 1 inside a side
    ],
)
def test_by_hand(dtype, corners, cells):
    """Cells of 1 m on the plane xy, not scaled."""
    points = torch.tensor([(u, v, 0.5) for u, v in corners], dtype=dtype)
    keys, masks = hull_cells(points[1:], points[0], [1.0], hull_scale=1.0)
    assert vertices_of(keys, masks, plane=0) == corners_of(*cells)


def test_side_below_a_row_of_vertices_by_hand():
    """Falls by 2^-32 cells, the finest step, over three cells: it leaves the row of its left end at once."""
    points = torch.tensor([(0, 1, 0.5), (3, 1 - 2.0**-32, 0.5)], dtype=torch.float64)
    keys, masks = hull_cells(points[1:], points[0], [1.0], hull_scale=1.0)
    assert vertices_of(keys, masks, plane=0) == corners_of((0, 1), (0, 0), (1, 0), (2, 0), (3, 0))


def test_planes_and_levels_by_hand():
    """One point, three cells; the same point on a level of twice the size."""
    point = torch.tensor([0.5, 3.5, -1.5])
    keys, masks = hull_cells(point[None], point, [1.0, 2.0])
    seen = [vertices_of(keys, masks, plane, level) for level in (0, 1) for plane in (0, 1, 2)]
    assert seen == [corners_of(cell) for cell in [(0, 3), (3, -2), (-2, 0), (0, 1), (1, -1), (-1, 0)]]


@pytest.mark.parametrize("scale", [1.0, 1.1, 1.7])
@pytest.mark.parametrize("n", SIZES)
def test_equals_oracle(n, scale):
    """The whole op in double against exact arithmetic, half of all coordinates negative."""
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    origin = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    hulls = reference.plane_hulls(points.tolist(), origin.tolist(), scale)
    assert as_dict(*hull_cells(points, origin, CELLS, scale)) == reference.hull_bricks(hulls, CELLS)


def test_ties_equal_oracle(dtype):
    """Corners and sides on vertices and on sides of cells, where floor() and the open sides of cells decide."""
    generator = torch.Generator().manual_seed(0)
    for n in range(1, 61):
        halves = torch.randint(-6, 7, (n % 6 + 1, 3), generator=generator)
        points = (halves / 2).to(dtype)
        hulls = reference.plane_hulls(points.tolist(), points[0].tolist(), 1)
        assert as_dict(*hull_cells(points, points[0], [1.0], 1.0)) == reference.hull_bricks(hulls, [1.0]), halves


@pytest.mark.parametrize("offset", [0.0, FAR, -FAR])
@pytest.mark.parametrize("n", SIZES)
def test_decisions_equal_oracle(dtype, n, offset):
    """From the corners on, in both types, near and far. float32 at 100 km: corners are 8 mm apart."""
    points = (torch.randn(n, 3, generator=torch.Generator().manual_seed(n), dtype=torch.float64) + offset).to(dtype)
    origin = torch.full((3,), offset, dtype=dtype)
    assert as_dict(*hull_cells(points, origin, CELLS)) == oracle_from_corners(points, origin, 1.1)


@pytest.mark.parametrize("offset", [0.0, FAR])
def test_hull_corners(dtype, offset):
    """Corners in double, then one rounding to the type: one unit in the last place of the largest coordinate."""
    points = (torch.randn(33, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + offset).to(dtype)
    origin = torch.full((3,), offset, dtype=dtype)
    for hull, exact in zip(
        plane_hulls(points, origin, 1.1), reference.plane_hulls(points.tolist(), origin.tolist(), 1.1), strict=True
    ):
        bound = torch.finfo(dtype).eps * max(abs(x) for corner in exact for x in corner)
        assert hull.dtype == dtype
        assert hull.shape == (len(exact), 2)
        assert all(
            abs(Fraction(x) - y) <= bound
            for corner, expected in zip(hull.tolist(), exact, strict=True)
            for x, y in zip(corner, expected, strict=True)
        )


def test_hull_is_exact_where_rounding_misleads():
    """Points one unit in the last place beside a line: the rounded determinant is often 0 or has the wrong sign."""
    ulp = 2.0**-53
    points = [(0.5 + i * ulp, 0.5 + j * ulp, 0.0) for i in range(8) for j in range(8)] + [
        (12.0, 12.0, 0),
        (24.0, 24.0, 0),
    ]
    hull = plane_hulls(torch.tensor(points, dtype=torch.float64), torch.tensor(points[0], dtype=torch.float64), 1.0)[0]
    exact = reference.hull_corners([(Fraction(u), Fraction(v)) for u, v, _ in points])
    assert hull.tolist() == [[float(u), float(v)] for u, v in exact]


def large_sets() -> dict[str, torch.Tensor]:
    """More points than are sampled, as integers, so that the oracle is quick."""
    generator = torch.Generator().manual_seed(0)
    cube = torch.randint(-500, 500, (9000, 3), generator=generator)
    room = torch.randint(-5000, 5000, (9000, 3), generator=generator)
    room[torch.arange(9000), torch.randint(0, 3, (9000,), generator=generator)] = 5000  # walls: sides full of points
    slanted = torch.stack([cube[:, 0], 2 * cube[:, 0] + 7, cube[:, 2]], dim=1)  # upright wall: a line seen from above
    angle = torch.linspace(0, 2 * math.pi, 9000, dtype=torch.float64)
    circle = (torch.stack([angle.cos(), angle.sin(), 0 * angle], dim=1) * 2**20).round().long()
    spike = room.clone()
    spike[4321] = torch.tensor([9000, -9000, 9000])
    return {"cube": cube, "room": room, "slanted": slanted, "circle": circle, "spike": spike}


@pytest.mark.parametrize("name", ["cube", "room", "slanted", "spike"])
def test_sampling_loses_no_corner(dtype, name):
    points = large_sets()[name]
    hulls = plane_hulls(points.to(dtype), points[0].to(dtype), 1.0)
    for hull, (a, b) in zip(hulls, reference.AXES, strict=True):
        exact = reference.hull_corners([(p[a], p[b]) for p in points.tolist()])
        assert hull.tolist() == [list(map(float, corner)) for corner in exact]


def test_sampling_loses_no_corner_of_a_circle(dtype):
    """Every point may be a corner: the hull of all points is the hull of each half together."""
    points = large_sets()["circle"].to(dtype)
    whole = plane_hulls(points, points[0], 1.0)[0]
    halves = torch.cat([plane_hulls(half, points[0], 1.0)[0] for half in points.split(4500)])
    again = plane_hulls(torch.nn.functional.pad(halves, (0, 1)), points[0], 1.0)[0]
    assert len(whole) > 2048
    assert torch.equal(whole, again)


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_every_point_is_covered(dtype, scale):
    """A look-up of any point of the hull finds its cell: floor of the same product."""
    points = torch.randn(500, 3, generator=torch.Generator().manual_seed(1), dtype=dtype)
    table = HashTable()
    table.insert(*hull_cells(points, points[0], CELLS, scale))
    for level, size in enumerate(CELLS):
        cells = (points * torch.tensor(1 / size, dtype=dtype)).floor().long()
        for plane, (a, b) in enumerate(reference.AXES):
            head = torch.tensor([level, plane]).expand(500, 2)
            for corner in ((0, 0), (1, 0), (0, 1), (1, 1)):
                vertices = torch.cat([head, cells[:, [a, b]] + torch.tensor(corner)], dim=1)
                assert (table.find(vertices) >= 0).all()


def test_points_on_borders_take_the_cell_of_a_look_up(dtype):
    """k x 0.1 m rounds to either side of the border of cell k, and so does the product with 1 / 0.1."""
    product = torch.tensor(1 / 0.1, dtype=dtype)
    for k in range(-60, 61, 3):
        point = torch.tensor([k * 0.1, (k + 1) * 0.1, (k + 2) * 0.1], dtype=dtype)
        i, j, _ = (point * product).floor().long().tolist()
        table = HashTable()
        table.insert(*hull_cells(point[None], point, [0.1], hull_scale=1.0))
        cell = torch.tensor([(0, 0, i + di, j + dj) for di in (0, 1) for dj in (0, 1)])
        assert (table.find(cell) >= 0).all()


def test_degenerate_hulls_scale_about_the_mean_corner():
    points = torch.tensor([[0.0, 0, 0], [2, 2, 2], [1, 1, 1], [1, 1, 1]])
    assert plane_hulls(points, points[0], 2.0)[0].tolist() == [[-1, -1], [3, 3]]
    assert plane_hulls(points[2:], points[2], 2.0)[0].tolist() == [[1, 1]]


def test_duplicates_and_order_change_nothing(dtype):
    points = torch.randn(40, 3, generator=torch.Generator().manual_seed(2), dtype=dtype)
    shuffled = torch.cat([points, points])[torch.randperm(80, generator=torch.Generator().manual_seed(3))]
    for one, other in zip(hull_cells(points, points[0], CELLS), hull_cells(shuffled, points[7], CELLS), strict=True):
        assert torch.equal(one, other)


def test_non_contiguous_input(dtype):
    wide = torch.randn(33, 6, generator=torch.Generator().manual_seed(4), dtype=dtype)
    strided = wide[:, ::2]
    assert not strided.is_contiguous()
    for one, other in zip(
        hull_cells(strided, wide[0, ::2], CELLS), hull_cells(strided.contiguous(), strided[0], CELLS), strict=True
    ):
        assert torch.equal(one, other)


@pytest.mark.parametrize("n", [5, 9000])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_not_finite_is_refused(n, bad, axis):
    points = torch.randn(n, 3, generator=torch.Generator().manual_seed(5))
    points[3, axis] = bad
    with pytest.raises(RuntimeError, match="snh::hull_cells: point 3 is not finite"):
        hull_cells(points, torch.zeros(3), CELLS)
    with pytest.raises(RuntimeError, match="'origin' is not finite"):
        hull_cells(points[:3], points[3], CELLS)


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (
            lambda p, o: hull_cells(p + 2e9, o + 2e9, [1.0]),
            "the hull reaches 2e[+]09 m, but keys of cells of 1 m end at",
        ),
        (
            lambda p, o: hull_cells(torch.eye(3) * 1e5, o, [0.02]),
            "too large for cells of 0.02 m; check the depth scale",
        ),
        (lambda p, o: hull_cells(p, o, []), "'cell_sizes' must have 1 to 16 levels, got 0"),
        (lambda p, o: hull_cells(p, o, [0.1, -0.2]), "'cell_sizes' must be positive metres"),
        (lambda p, o: hull_cells(p, o, [0.1], 0.0), "'hull_scale' must be positive, got 0"),
        (lambda p, o: hull_cells(p[:, :2], o, [0.1]), r"'points' must have shape \[\*, 3\], got \[4, 2\]"),
        (lambda p, o: hull_cells(p, o.double(), [0.1]), "'origin' must be Float, got Double"),
    ],
)
def test_bad_input_is_refused(call, sentence):
    with pytest.raises(RuntimeError, match=sentence):
        call(torch.ones(4, 3), torch.zeros(3))


def test_opcheck(dtype):
    points = torch.randn(33, 3, generator=torch.Generator().manual_seed(6), dtype=dtype)
    torch.library.opcheck(torch.ops.snh.hull_cells.default, (points, points[0], CELLS, 1.1))
    torch.library.opcheck(torch.ops.snh.plane_hull.default, (points, points[0], 2, 1.1))
