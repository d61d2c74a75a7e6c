"""Every CUDA kernel, executed on the CPU by the host shim (or on a CUDA device where there is one) and compared with
the CPU implementation: integers equal, floats within the bound beside each comparison. Several orders of blocks, warps
and lanes; sizes around a warp, and the full size of a mapping step, 2048 rays of 48 samples."""

import math

import pytest
import shim
import torch

from snh.ops import HashTable, hull_cells
from snh.ops._library import native

SIZES = [0, 1, 31, 32, 33]
RAYS, N_BASE, N_SURFACE = 2048, 36, 12
SAMPLES = N_BASE + N_SURFACE
CELL_SIZES = [0.02, 0.0348, 0.0606, 0.1056, 0.1838, 0.32]
UNIT = 2.0**-24  # rounding of float32


@pytest.fixture(scope="module")
def kernels():
    """The ops as kernels on CPU tensors."""
    shim.require()
    torch.ops.snh_shim.set_schedule(0)
    return torch.ops.snh_shim


@pytest.fixture(params=shim.SCHEDULES, ids=lambda number: f"schedule{number}")
def any_order(request, kernels):
    """The same under each schedule."""
    kernels.set_schedule(request.param)
    yield kernels
    kernels.set_schedule(0)


def random(*shape, seed=0):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def assert_close(got, want, roundings):
    """|got - want| <= roundings x 2^-24 x the largest entry."""
    assert got.shape == want.shape and got.dtype == want.dtype
    if want.numel() == 0:
        return
    assert torch.isfinite(got).all()
    error, largest = (got - want).abs().max().item(), want.abs().max().item()
    assert error <= roundings * UNIT * largest, f"{error / (UNIT * largest):.1f} roundings, {roundings} allowed"


def fenced(shape, dtype=torch.float32, fill=0):
    """A tensor between two fences, and a check that nobody wrote to them."""
    n, fence = math.prod(shape), 64
    storage = torch.full((n + 2 * fence,), 77, dtype=dtype)
    inner = storage[fence : fence + n]
    inner.fill_(fill)

    def intact():
        return bool((storage[:fence] == 77).all() and (storage[fence + n :] == 77).all())

    return inner.view(shape), intact


# --- a scene at full size -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rays():
    """Samples of rays from one camera into a room of 4 x 3 x 3 m, [R * S, 3] m, in the order of the rays."""
    dirs = torch.cat([random(RAYS, 2) * 1.2 - 0.6, torch.ones(RAYS, 1)], dim=1)
    depth = 1 + 2 * random(RAYS, seed=1)
    z = native.ray_sample(depth, random(RAYS, SAMPLES, seed=2), N_BASE, N_SURFACE, 0.01, 1.2, 0.06)
    return (dirs[:, None] * z[..., None]).reshape(-1, 3), dirs * depth[:, None]


@pytest.fixture(scope="module")
def scene(rays):
    """Points of all samples, features and the table of their frame's hull, a tenth of its vertices missing."""
    points, surface = rays
    keys, masks = hull_cells(surface, torch.zeros(3), CELL_SIZES)
    gone = sum((random(len(masks), seed=9 + bit) < 0.1).long() << bit for bit in range(63))
    table = HashTable()
    table.insert(keys, masks & ~gone)
    return points, random(64 * table.n_bricks, 4, seed=3) - 0.5, table


# --- hash_table -----------------------------------------------------------------------------------------------------


def bricks(n, seed, span=40):
    """n keys, ascending, and masks."""
    g = torch.Generator().manual_seed(seed)
    i, j = torch.randint(-span, span, (2, 4 * n + 1), generator=g) + 2**27
    head = torch.randint(0, 64, (4 * n + 1,), generator=g)
    keys = torch.unique((head - (head % 4 == 3).long()) << 56 | i << 28 | j)  # planes 0, 1, 2
    keys = keys[torch.randperm(len(keys), generator=g)[:n]].sort().values
    return keys, torch.randint(-(2**62), 2**62, (len(keys),), generator=g) | 1


def same_tables(n, seeds, schedule):
    tables = []
    for on_kernels in (False, True):
        context = shim.kernels(schedule) if on_kernels else torch.no_grad()
        with context:
            table = HashTable()
            counts = [table.insert(*bricks(n, seed)) for seed in seeds]
            vertices = torch.cartesian_prod(*(torch.arange(k) for k in (2, 3, 20, 20))) - torch.tensor([0, 0, 10, 10])
            tables.append((counts, table.probe, table.brick_keys, table.masks, table.find(vertices)))
    return tables


@pytest.mark.parametrize("schedule", shim.SCHEDULES)
@pytest.mark.parametrize("n", [*SIZES, 3000])
def test_hash_table_is_the_same_bit_for_bit(n, schedule):
    """Three insertions, with growth: counts, probe array, keys, masks and slots."""
    cpu, kernels = same_tables(n, range(3), schedule)
    assert kernels[0] == cpu[0]
    for got, want in zip(kernels[1:], cpu[1:], strict=True):
        assert torch.equal(got, want)


def test_hash_table_at_full_size(scene, any_order):
    _, _, table = scene
    probe = any_order.hash_table_build(table.brick_keys, len(table.probe))
    assert torch.equal(probe, table.probe)
    assert torch.equal(
        any_order.hash_table_numbers(probe, table.brick_keys, table.brick_keys),
        torch.arange(table.n_bricks, dtype=torch.int32),
    )


def test_hash_table_refuses_what_the_cpu_refuses(any_order):
    keys = torch.tensor([5, 9, 9, 5, 3])
    for ops in (native, any_order):
        with pytest.raises(RuntimeError, match="must not repeat a key, entry 2 does"):
            ops.hash_table_build(keys, 16)
        probe = ops.hash_table_build(keys[:2], 16)
        storage = torch.zeros(8, dtype=torch.int64)
        with pytest.raises(RuntimeError, match="strictly ascending, entry 2 is not"):
            ops.hash_table_insert_(probe, storage, storage.clone(), 0, keys, keys)
        with pytest.raises(RuntimeError, match="the storage holds 8 bricks, but 9 are needed"):
            ops.hash_table_insert_(probe, storage, storage.clone(), 8, keys[:1] + 100, keys[:1])


# --- ray_sample -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_base, n_surface", [(N_BASE, N_SURFACE), (0, 3), (3, 0), (33, 31)])
@pytest.mark.parametrize("n_rays", [*SIZES, RAYS])
def test_ray_sample_is_the_same_bit_for_bit(n_rays, n_base, n_surface, any_order):
    depth, uniforms = 0.05 + 3 * random(n_rays), random(n_rays, n_base + n_surface, seed=1)
    arguments = depth, uniforms, n_base, n_surface, 0.01, 1.2, 0.06
    assert torch.equal(any_order.ray_sample(*arguments), native.ray_sample(*arguments))


def test_ray_sample_merges_ties(kernels):
    """Both sets have a sample at 1 m: u = 0 in the last of two base strata on [0, 2], u = 0.5 on 1 +- 0.5."""
    arguments = torch.tensor([1.0]), torch.tensor([[0.0, 0.0, 0.5]]), 2, 1, 0.0, 2.0, 0.5
    assert kernels.ray_sample(*arguments).tolist() == [[0.0, 1.0, 1.0]]


# --- ray_render -----------------------------------------------------------------------------------------------------


def samples(n_rays, n_samples):
    tsdf = random(n_rays, n_samples) * 2 - 1 + torch.linspace(1, -1, n_samples)
    z = random(n_rays, n_samples, seed=1).sort(dim=1).values * 3
    return tsdf, random(n_rays, n_samples, 3, seed=2), z


@pytest.mark.parametrize("cut_behind", [None, 0.06])
@pytest.mark.parametrize(
    "n_rays, n_samples", [*((n, 48) for n in [*SIZES, RAYS]), *((5, n) for n in [0, 1, 32, 33, 97])]
)
def test_ray_render(n_rays, n_samples, cut_behind, any_order):
    """Sums of n_samples positive terms, and a division: 2 roundings each at worst."""
    arguments = *samples(n_rays, n_samples), 4.0, cut_behind
    got, want = any_order.ray_render(*arguments), native.ray_render(*arguments)
    for g, w in zip(got, want, strict=True):
        assert_close(g, w, 2 * n_samples)
    grads = random(n_rays, 3, seed=4) - 0.5, random(n_rays, seed=5) - 0.5, random(n_rays, n_samples, seed=6) - 0.5
    arguments = *grads, *arguments[:3], want[2], 4.0
    for g, w in zip(any_order.ray_render_backward(*arguments), native.ray_render_backward(*arguments), strict=True):
        assert_close(g, w, 2 * n_samples + 16)


def test_ray_render_cuts_at_the_first_crossing(kernels):
    """Crossings in the second and third warp-wide piece of the ray; the first one counts."""
    tsdf = torch.ones(1, 100)
    tsdf[0, 40:50], tsdf[0, 80:] = -1, -1
    z = torch.arange(100.0)[None]
    weight = kernels.ray_render(tsdf, torch.zeros(1, 100, 3), z, 1.0, 2.0)[2]
    assert torch.equal(weight[0] > 0, torch.arange(100) <= 41)


# --- plane_lookup ---------------------------------------------------------------------------------------------------


def lookup_arguments(scene, n_features, n_columns, reduce):
    points, features, table = scene
    if n_columns != 4:
        features = random(len(features), n_columns, seed=5) - 0.5
    return points, features, table.probe, table.brick_keys, table.masks, CELL_SIZES, n_features, reduce


LAYOUTS = [(3, 4), (4, 4), (1, 1), (5, 6), (6, 8)]  # features of columns; 16-byte rows or not, one group or two


@pytest.mark.parametrize("reduce", ["sum", "cat", "prod"])
@pytest.mark.parametrize("n_features, n_columns", LAYOUTS)
@pytest.mark.parametrize("n_points", SIZES)
def test_plane_lookup(n_points, n_features, n_columns, reduce, scene, kernels):
    compare_lookup((scene[0][:n_points], *scene[1:]), n_features, n_columns, reduce, kernels)


def test_plane_lookup_at_full_size(scene, kernels):
    compare_lookup(scene, 3, 4, "sum", kernels)


def test_plane_lookup_in_any_order(scene, any_order):
    compare_lookup((scene[0][:1000], *scene[1:]), 3, 4, "prod", any_order)


def compare_lookup(scene, n_features, n_columns, reduce, ops):
    """Forward: a product of 3 sums of 4 terms. To points: 72 corners. To features: the corners of one row, up to
    10,000 terms at full size, in no fixed order; their roundings add up like a random walk."""
    arguments = lookup_arguments(scene, n_features, n_columns, reduce)
    points, features = arguments[:2]
    got, want = ops.plane_lookup(*arguments), native.plane_lookup(*arguments)
    assert_close(got[0], want[0], 16)
    assert torch.equal(got[1], want[1])
    grad = random(*want[0].shape, seed=6) - 0.5
    for g, w in zip(
        ops.plane_lookup_backward(grad, *arguments, True, True),
        native.plane_lookup_backward(grad, *arguments, True, True),
        strict=True,
    ):
        assert_close(g, w, 128)
    only = ops.plane_lookup_backward(grad, *arguments, False, True)
    assert only[0].shape == (0, 3) and only[1].shape == features.shape
    v_points, v_features = random(*points.shape, seed=7) - 0.5, random(*features.shape, seed=8) - 0.5
    some = [(v_points, v_features), (None, v_features), (v_points, None)]
    for v in some if len(points) < 100 else some[:1]:
        for g, w in zip(
            ops.plane_lookup_double_backward(*v, grad, *arguments, True),
            native.plane_lookup_double_backward(*v, grad, *arguments, True),
            strict=True,
        ):
            assert_close(g, w, 256)


def test_plane_lookup_sums_coarse_cells_once(kernels):
    """All points in one cell: 33 points make two warps, so each corner gets two sums; integers, so exact."""
    table = HashTable()
    table.insert(torch.tensor([1 << 55 | 1 << 27]), torch.tensor([0b11_00000011]))
    points = torch.full((33, 3), 0.5)
    arguments = points, torch.zeros(64, 4), table.probe, table.brick_keys, table.masks, [1.0], 3, "sum"
    grad = torch.arange(33.0)[:, None].expand(33, 3).contiguous()
    _, grad_features = kernels.plane_lookup_backward(grad, *arguments, False, True)
    assert grad_features[[0, 1, 8, 9], :3].tolist() == [[132.0] * 3] * 4  # 528 / 4
    assert grad_features.abs().sum() == 4 * 3 * 132


# --- interframe -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_rays", [*SIZES, 10_000])
def test_interframe(n_rays, any_order):
    """Pixel positions carry the rounding of u, a few hundred pixels: 2^-24 x 640, times gradients of up to 1 / px."""
    T_kc = torch.eye(4)
    T_kc[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    points = torch.cat([random(n_rays, 2) * 3 - 1.5, 3 * random(n_rays, 1, seed=1) - 0.5], dim=1)
    image = (255 * random(120, 160, 3, seed=2)).to(torch.uint8)
    arguments = points, random(n_rays, 3, seed=3), T_kc, image, 130.0, 128.0, 79.5, 59.5
    got, want = any_order.interframe(*arguments), native.interframe(*arguments)
    assert torch.equal(got[2], want[2])
    assert_close(got[0], want[0], 2048)
    assert_close(got[1], want[1], 2048)


# --- sparse_adam ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_bricks", [*SIZES, 2000])
def test_sparse_adam(n_bricks, any_order):
    """Three steps; every third brick is left out of each, another one each time."""
    masks = torch.randint(-(2**63), 2**63 - 1, (n_bricks,), generator=torch.Generator().manual_seed(0))
    results = []
    for ops in (native, any_order):
        state = {name: fenced((64 * n_bricks, 4)) for name in ("features", "grad", "m", "v")}
        counts = {"last_step": fenced((n_bricks,), torch.int32), "touched": fenced((n_bricks,), torch.uint8)}
        tensors = [t for t, _ in (*state.values(), *counts.values())]
        for step in range(1, 4):
            touched = torch.arange(n_bricks) % 3 != step % 3
            tensors[1].copy_((random(64 * n_bricks, 4, seed=step) - 0.5) * touched.repeat_interleave(64)[:, None])
            tensors[5].copy_(touched)
            ops.sparse_adam_(*tensors, masks, step, 0.01, 0.9, 0.99, 1e-15)
        assert all(intact() for _, intact in (*state.values(), *counts.values()))
        assert not tensors[1].any() and not tensors[5].any()
        results.append(tensors)
    for got, want in zip(results[1][:4], results[0][:4], strict=True):
        assert_close(got, want, 8)
    assert torch.equal(results[1][4], results[0][4])


@pytest.mark.parametrize("n", [*SIZES, 7000])
def test_adam(n, any_order):
    results = []
    for ops in (native, any_order):
        tensors = [fenced((n,)) for _ in range(3)]
        parameters, m, v = (t for t, _ in tensors)
        for step in range(1, 4):
            ops.adam_(parameters, random(n, seed=step) - 0.5, m, v, step, 0.01, 0.9, 0.99, 1e-15)
        assert all(intact() for _, intact in tensors)
        results.append((parameters, m, v))
    for got, want in zip(*reversed(results), strict=True):
        assert_close(got, want, 8)


# --- what only a device can show ------------------------------------------------------------------------------------


def test_float64_is_refused(kernels):
    with pytest.raises(RuntimeError, match="'depth' must be float32 on CUDA, got Double"):
        kernels.ray_sample(torch.ones(1).double(), torch.ones(1, 2).double(), 1, 1, 0.01, 1.2, 0.06)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_tensors_on_two_devices_are_refused():
    with pytest.raises(RuntimeError, match="'uniforms' is on cpu but 'depth' is on cuda:0; move all to one device"):
        native.ray_sample(torch.ones(1, device="cuda"), torch.ones(1, 2), 1, 1, 0.01, 1.2, 0.06)
