"""plane_lookup against numbers worked by hand, the dumb oracle, finite differences and torch's own checks."""

import itertools
import math

import pytest
import reference_rays as reference
import torch

from snh.ops import plane_lookup
from snh.ops._library import native

SIZES = [0, 1, 31, 32, 33]
CELL_SIZES = [0.02, 0.07, 0.32]
REDUCES = ["sum", "cat", "prod"]
UNIT = 2.0**-24  # float32 rounding


def scene(n_points, dtype=torch.float64, centre=(0.0, 0.0, 0.0), n_columns=4, share=0.9, seed=0):
    """Points in a box of 1 m about `centre`, a table that holds `share` of the corners around them, its features."""
    g = torch.Generator().manual_seed(seed)
    points = (torch.rand(n_points, 3, generator=g, dtype=torch.float64) - 0.5 + torch.tensor(centre)).to(dtype)
    corners = set()
    for point, (level, size) in itertools.product(points, enumerate(CELL_SIZES)):
        cells = point * torch.tensor(1.0 / size, dtype=dtype)
        for plane, (u, v) in enumerate([(0, 1), (1, 2), (2, 0)]):
            i, j = math.floor(cells[u].item()), math.floor(cells[v].item())
            corners |= {(level, plane, i + di, j + dj) for di in (0, 1) for dj in (0, 1)}
    corners = sorted(corners)
    kept = (torch.rand(len(corners), generator=g) < share).tolist()
    table, rows = reference.dumb_table([c for c, keep in zip(corners, kept, strict=True) if keep])
    features = torch.zeros(64 * len(table.masks), n_columns, dtype=dtype)
    index = sorted(rows.values())
    features[index] = torch.rand(len(index), n_columns, generator=g, dtype=torch.float64).to(dtype) * 2 - 1
    return points, features, table, rows


# --- by hand ------------------------------------------------------------------------------------------------------

# Cells of 0.5 m. On the xy plane the cell (-1, 0) has the features 1, 2, 4, 8 at (-1, 0), (0, 0), (-1, 1), (0, 1);
# on yz the vertex (0, 0) has 16; on zx there is nothing.
HAND = {(0, 0, -1, 0): 1.0, (0, 0, 0, 0): 2.0, (0, 0, -1, 1): 4.0, (0, 0, 0, 1): 8.0, (0, 1, 0, 0): 16.0}


@pytest.mark.parametrize(
    "point, xy, yz, valid_xy",
    [
        ((-0.5, 0.0, -0.25), 1.0, 8.0, True),  # on the first corner; yz: cell (0, -1), half way to (0, 0)
        ((-0.25, 0.25, -9.0), 3.75, 0.0, True),  # middle of the cell
        ((-0.375, 0.125, 0.0), 0.5625 + 0.375 + 0.75 + 0.5, 12.0, True),  # weights 9, 3, 3, 1 sixteenths
        ((0.0, 0.25, 0.25), 0.5 * 2 + 0.5 * 8, 4.0, False),  # on the border: cell (0, 0), only its left corners exist
        ((-0.75, 0.0, 0.0), 0.5, 16.0, False),  # cell (-2, 0): only its right corners exist
        ((7.0, 7.0, 7.0), 0.0, 0.0, False),
    ],
)
def test_hand_worked(point, xy, yz, valid_xy):
    table, rows = reference.dumb_table(HAND)
    features = torch.zeros(64 * len(table.masks), 1, dtype=torch.float64)
    for vertex, value in HAND.items():
        features[rows[vertex]] = value
    points = torch.tensor([point], dtype=torch.float64)
    for reduce, want in {"sum": [xy + yz], "cat": [xy, yz, 0.0], "prod": [0.0]}.items():
        encoded, valid = plane_lookup(points, features, table, [0.5], n_features=1, reduce=reduce)
        assert encoded.tolist() == [want]
        assert valid.tolist() == [[[valid_xy, False, False]]]


def test_levels_do_not_share_vertices():
    table, rows = reference.dumb_table({(1, 2, 0, 0)})
    features = torch.zeros(64, 1, dtype=torch.float64)
    features[rows[1, 2, 0, 0]] = 1
    encoded, _ = plane_lookup(torch.zeros(1, 3, dtype=torch.float64), features, table, [0.5, 1.0, 2.0], 1)
    assert encoded.tolist() == [[0.0, 1.0, 0.0]]


# --- against the oracle -------------------------------------------------------------------------------------------

PLACES = [(0.0, 0.0, 0.0), (-3.0, -4.0, -5.0), (1e5, -1e5, 1e5)]  # the last: 100 km away


@pytest.mark.parametrize("n_points", SIZES)
@pytest.mark.parametrize("reduce", REDUCES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle(n_points, reduce, dtype):
    for centre, n_features in zip(PLACES, [3, 4, 1], strict=True):
        points, features, table, rows = scene(n_points, dtype, centre)
        encoded, valid = plane_lookup(points, features, table, CELL_SIZES, n_features, reduce)
        want, want_valid = reference.plane_lookup(points, features, rows, CELL_SIZES, n_features, reduce)
        # |features| <= 1. float32: 3 roundings in a weight, 4 in the sum over corners, 2 in that over planes; 3 planes
        tolerance = 1e-10 if dtype == torch.float64 else 3 * 9 * UNIT
        assert encoded.dtype == dtype
        torch.testing.assert_close(encoded.double(), want, rtol=0, atol=tolerance)
        assert torch.equal(valid, want_valid)


@pytest.mark.parametrize("n_points", SIZES)
@pytest.mark.parametrize("reduce", REDUCES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle_gradients(n_points, reduce, dtype):
    """First derivatives, and second ones through a loss on both gradients."""
    results = []
    points, features, table, rows = scene(n_points, dtype, (-3.0, 2.0, 1.0))
    g = torch.Generator().manual_seed(1)
    width = len(CELL_SIZES) * 3 * (3 if reduce == "cat" else 1)
    upstream, v_points, v_features = (
        torch.rand(shape, generator=g, dtype=torch.float64) * 2 - 1
        for shape in [(n_points, width), points.shape, features.shape]
    )
    for lookup in [
        lambda p, f: plane_lookup(p, f, table, CELL_SIZES, 3, reduce)[0],
        lambda p, f: reference.plane_lookup(p, f, rows, CELL_SIZES, 3, reduce)[0],
    ]:
        p, f = points.clone().requires_grad_(), features.clone().requires_grad_()
        up = upstream.clone().requires_grad_()
        encoded = lookup(p, f) + 0 * p.sum() + 0 * f.sum()  # the oracle's empty result is a constant
        first = torch.autograd.grad((encoded.double() * up).sum(), [p, f], create_graph=True)
        phi = (first[0].double() * v_points).sum() + (first[1].double() * v_features).sum()
        second = torch.autograd.grad(phi + 0 * (p.sum() + f.sum() + up.sum()), [up, p, f])
        results.append([*first, *second])
    # Every term is at most (2 / cell)^order; a row sums over up to all points, a point over 3 levels x 3 planes x 3
    # features. float32: 9 roundings per plane, of which up to three multiply, and as many again in these sums.
    for order, native_grad, oracle_grad in zip([1, 0, 1, 2, 1], *results, strict=True):
        size = max(27, n_points) * (2 / min(CELL_SIZES)) ** order
        tolerance = 1e-10 if dtype == torch.float64 else 50 * UNIT * size
        torch.testing.assert_close(native_grad.double(), oracle_grad.double(), rtol=0, atol=tolerance)


def test_not_contiguous():
    points, features, table, _ = scene(33)
    want = plane_lookup(points, features, table, CELL_SIZES)
    wide = torch.stack([points, points + 1], dim=-1)[..., 0]
    twice = reference.SimpleNamespace(**{k: torch.stack([t, t], 1)[:, 0] for k, t in vars(table).items()})
    got = plane_lookup(wide, features.T.contiguous().T, twice, CELL_SIZES)
    assert not wide.is_contiguous() and torch.equal(got[0], want[0]) and torch.equal(got[1], want[1])


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e30, -1e30])
def test_points_without_place_are_zero(value):
    points, features, table, _ = scene(4)
    points[1] = value
    points.requires_grad_()
    encoded, valid = plane_lookup(points, features.requires_grad_(), table, CELL_SIZES)
    encoded.sum().backward()
    assert (encoded[1] == 0).all() and not valid[1].any() and (points.grad[1] == 0).all()
    assert torch.isfinite(features.grad).all()


def test_columns_beyond_n_features_are_not_read():
    points, features, table, _ = scene(33)
    features[:, 3] = math.nan
    features.requires_grad_()
    encoded, _ = plane_lookup(points, features, table, CELL_SIZES, n_features=3)
    encoded.sum().backward()
    assert torch.isfinite(encoded).all() and (features.grad[:, 3] == 0).all()


def test_empty_table():
    table, _ = reference.dumb_table([])
    encoded, valid = plane_lookup(torch.rand(5, 3), torch.zeros(0, 4), table, CELL_SIZES)
    assert (encoded == 0).all() and not valid.any()


def test_same_bits_with_any_number_of_threads():
    points, features, table, _ = scene(40)
    points = points.repeat(100, 1)
    results = []
    threads = torch.get_num_threads()
    for n in (1, 2):
        torch.set_num_threads(n)
        p, f = points.clone().requires_grad_(), features.clone().requires_grad_()
        encoded, _ = plane_lookup(p, f, table, CELL_SIZES)
        results.append([encoded, *torch.autograd.grad(encoded.square().sum(), [p, f])])
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


# --- derivatives --------------------------------------------------------------------------------------------------


def inside_cells(points, margin=1e-3):
    """Moves points so that none is nearer than margin to the border of a cell, where the gradient jumps."""
    for size in CELL_SIZES:
        cells = points / size
        points = size * (cells.floor() + (cells - cells.floor()).clamp(2 * margin, 1 - 2 * margin))
    return points


@pytest.mark.parametrize("reduce", REDUCES)
@pytest.mark.parametrize("wanted", ["points", "features", "both"])
def test_gradcheck(reduce, wanted):
    points, features, table, _ = scene(3, share=0.8, centre=(-1.0, 0.5, 2.0))
    points = inside_cells(points).requires_grad_(wanted != "features")
    features.requires_grad_(wanted != "points")

    def run(p, f):
        return plane_lookup(p, f, table, CELL_SIZES, 3, reduce)[0]

    assert torch.autograd.gradcheck(run, (points, features), eps=1e-6, atol=1e-5, fast_mode=wanted != "points")
    assert torch.autograd.gradgradcheck(run, (points, features), eps=1e-6, atol=1e-4, fast_mode=True)


def test_no_third_derivative():
    points, features, table, _ = scene(3)
    points.requires_grad_()
    encoded, _ = plane_lookup(points, features, table, CELL_SIZES, reduce="prod")
    (first,) = torch.autograd.grad(encoded.sum(), points, create_graph=True)
    (second,) = torch.autograd.grad(first.square().sum(), points, create_graph=True)
    with pytest.raises(NotImplementedError, match="third derivatives"):
        torch.autograd.grad(second.sum(), points)


@pytest.mark.parametrize("reduce", REDUCES)
def test_opcheck(reduce):
    points, features, table, _ = scene(5)
    points.requires_grad_()
    features.requires_grad_()
    rest = (points, features, table.probe, table.brick_keys, table.masks, CELL_SIZES, 3, reduce)
    grad = torch.rand(5, len(CELL_SIZES) * 3 * (3 if reduce == "cat" else 1), dtype=torch.float64, requires_grad=True)
    torch.library.opcheck(native.plane_lookup.default, rest)
    for need_points, need_features in [(True, True), (True, False), (False, True)]:
        torch.library.opcheck(native.plane_lookup_backward.default, (grad, *rest, need_points, need_features))
    constant = [t.detach() if isinstance(t, torch.Tensor) else t for t in rest]
    v_points, v_features = torch.rand_like(constant[0]), torch.rand_like(constant[1])
    for v_p, v_f in [(v_points, v_features), (None, v_features), (v_points, None)]:
        torch.library.opcheck(native.plane_lookup_double_backward.default, (v_p, v_f, grad.detach(), *constant, True))


# --- errors -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "change, message",
    [
        ({"points": torch.zeros(2, 2)}, r"'points' must have shape \[\*, 3\], got \[2, 2\]"),
        ({"points": torch.zeros(2, 3, dtype=torch.float16)}, "'points' must be float32 or float64, got Half"),
        ({"features": torch.zeros(640, 4, dtype=torch.float64)}, "'features' must be Float, got Double"),
        ({"features": torch.zeros(3, 4)}, "'features' must have 64 rows, 64 per brick, got 3"),
        ({"n_features": 5}, "'n_features' must be between 1 and the 4 columns of 'features', got 5"),
        ({"n_features": 0}, "'n_features' must be between 1 and the 4 columns of 'features', got 0"),
        ({"cell_sizes": [0.1, 0.0]}, "'cell_sizes' must be positive, got 0"),
        ({"cell_sizes": [0.1] * 17}, "'cell_sizes' must have at most 16 levels, got 17"),
        ({"reduce": "mean"}, "'reduce' must be 'sum', 'cat' or 'prod', got 'mean'"),
    ],
)
def test_refused(change, message):
    table, _ = reference.dumb_table([(0, 0, 0, 0)])
    arguments = {"points": torch.zeros(2, 3), "features": torch.zeros(64, 4), "cell_sizes": [0.1]}
    with pytest.raises(RuntimeError, match=message):
        plane_lookup(table=table, **{**arguments, **change})


def test_full_probe_is_refused():
    table, _ = reference.dumb_table([(0, 0, 0, 0), (0, 0, 8, 0)])
    table.probe = torch.tensor([0, 1], dtype=torch.int32)
    with pytest.raises(RuntimeError, match="power of two of entries, more than the 2 bricks, got 2"):
        plane_lookup(torch.zeros(1, 3), torch.zeros(128, 4), table, [0.1])
