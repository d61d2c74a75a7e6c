"""field: the plain implementation in float64 equals the oracle, the fast ones in float32 equal the plain one."""

from dataclasses import dataclass, replace

import pytest
import reference
import reference_field
import torch

from snh.ops.field import FieldSpec, field_map, field_map_, field_query, field_track
from snh.ops.hash_table import HashTable

N_BASE, N_SURFACE, NEAR, FAR = 5, 4, 0.01, 1.2
LAMBDAS = (5.0, 0.1, 10.0, 1000.0)
SPEC = FieldSpec(cell_sizes=(0.05, 0.13, 0.4), n_octaves=3, hidden=16, n_geometry=7, base_wavelength=4.0)


@dataclass
class Scene:
    spec: FieldSpec
    table: HashTable
    slots: dict  # (level, plane, i, j) -> row, for the oracle
    features: torch.Tensor
    decoder: torch.Tensor

    def to(self, dtype):
        return Scene(self.spec, self.table, self.slots, self.features.to(dtype), self.decoder.to(dtype))


def make_scene(spec=SPEC, seed=0, box=((-1.0, -1.2, 0.2), (1.1, 0.9, 1.9)), missing=0.02) -> Scene:
    """A map of every vertex in a box, m, but for a random share of `missing` ones; float64."""
    generator = torch.Generator().manual_seed(seed)
    vertices = []
    for level, cell in enumerate(spec.cell_sizes):
        for plane, axes in enumerate(reference_field.AXES):
            u, v = (torch.arange(int(box[0][a] // cell), int(box[1][a] // cell) + 2) for a in axes)
            ij = torch.cartesian_prod(u, v)
            ij = ij[torch.rand(len(ij), generator=generator) >= missing]
            vertices += [(level, plane, i, j) for i, j in ij.tolist()]
    masks = reference.brick_masks(vertices)
    table = HashTable()
    table.insert(torch.tensor(list(masks)), torch.tensor([reference.signed(mask) for mask in masks.values()]))
    slots = dict(zip(vertices, table.find(torch.tensor(vertices)).tolist(), strict=True))
    features = torch.zeros(table.n_bricks * 64, 4, dtype=torch.float64)
    rows = torch.tensor(list(slots.values()))
    features[rows, : spec.n_features] = torch.randn(len(rows), spec.n_features, generator=generator).double()
    decoder = 0.3 * torch.randn(spec.decoder_size, generator=generator).double()
    return Scene(spec, table, slots, features, decoder)


def pose(generator, centre=(0.0, 0.0, 0.0)) -> torch.Tensor:
    twist = 0.2 * torch.randn(6, generator=generator).double()
    T = reference_field.exp_se3(twist)
    T[:3, 3] += torch.tensor(centre, dtype=torch.float64)
    return T


def make_rays(n_rays, n_samples, seed=0, n_frames=3, centre=(0.0, 0.0, 0.0)) -> dict:
    """Rays into the box of `make_scene`, some of them out of it at the sides and behind; float64."""
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape):
        return torch.rand(*shape, generator=generator).double()

    return dict(
        dirs_c=torch.cat([rand(n_rays, 2) * 2 - 1, torch.ones(n_rays, 1).double()], dim=1),
        depth=0.6 + 1.4 * rand(n_rays),
        color=rand(n_rays, 3),
        frame_index=torch.randint(0, n_frames, (n_rays,), generator=generator).int(),
        T_wc=torch.stack([pose(generator, centre) for _ in range(n_frames)]),
        uniforms=0.01 + 0.98 * rand(n_rays, n_samples),
    )


def run_map(scene, rays, impl="auto", lambdas=LAMBDAS, n_base=N_BASE, n_surface=N_SURFACE) -> dict:
    """Losses and gradients by field_map_."""
    dtype, n_bricks = scene.features.dtype, scene.table.n_bricks
    result = dict(
        features=torch.zeros_like(scene.features),
        touched=torch.zeros(n_bricks, dtype=torch.uint8),
        decoder=torch.full_like(scene.decoder, 7.0),
        T_wc=torch.full((len(rays["T_wc"]), 3, 4), 7.0, dtype=dtype),
    )
    rays = {k: v if k == "frame_index" else v.to(dtype) for k, v in rays.items()}
    result["losses"] = field_map_(
        *rays.values(), scene.features, scene.table, scene.decoder, scene.spec, n_base, n_surface, NEAR, FAR, lambdas,
        *result.values(), impl=impl,
    )  # fmt: skip
    return result


def run_oracle(scene, rays, lambdas=LAMBDAS, n_base=N_BASE, n_surface=N_SURFACE) -> dict:
    leaves = dict(features=scene.features.clone(), decoder=scene.decoder.clone(), T_wc=rays["T_wc"].clone())
    for leaf in leaves.values():
        leaf.requires_grad_()
    rays = {**rays, "T_wc": leaves["T_wc"]}
    losses = reference_field.field_map(
        *rays.values(), leaves["features"], scene.slots, leaves["decoder"], scene.spec, n_base, n_surface, NEAR, FAR
    )
    if len(rays["depth"]):
        (losses @ torch.tensor(lambdas, dtype=torch.float64)).backward()
    result = {k: leaf.grad if leaf.grad is not None else torch.zeros_like(leaf) for k, leaf in leaves.items()}
    result["T_wc"] = result["T_wc"][:, :3]
    result["losses"] = losses.detach()
    result["touched"] = (result["features"].view(-1, 256) != 0).any(dim=1)
    return result


def assert_close(got, want, bound, name):
    """|got - want| <= bound x the largest entry (1 if all are smaller than that)."""
    scale = max(want.abs().max().item(), 1.0) if want.numel() else 1.0
    error = (got.double() - want).abs().max().item() / scale if want.numel() else 0.0
    assert error <= bound, f"{name}: error {error:.3g} of the largest entry, {bound:.3g} allowed"


# --- the plain implementation against the oracle, float64: 1e-10 ----------------------------------------------------


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33])
def test_map_equals_oracle(n_rays):
    scene, rays = make_scene(), make_rays(n_rays, N_BASE + N_SURFACE)
    got, want = run_map(scene, rays, "reference"), run_oracle(scene, rays)
    for name in ("losses", "features", "decoder", "T_wc"):
        assert_close(got[name], want[name], 1e-10, name)
    assert (got["touched"].bool() | ~want["touched"]).all()


@pytest.mark.parametrize(
    "change",
    [
        dict(cut_behind=True),
        dict(n_features=4, cell_sizes=(0.1,)),
        dict(n_features=1, n_octaves=0),
        dict(n_geometry=0, hidden=1),
    ],
    ids=str,
)
@pytest.mark.parametrize("samples", [(5, 4), (0, 3), (3, 0)])
def test_map_variants_equal_oracle(change, samples):
    spec = replace(SPEC, **change)
    scene, rays = make_scene(spec), make_rays(9, sum(samples))
    got = run_map(scene, rays, "reference", n_base=samples[0], n_surface=samples[1])
    want = run_oracle(scene, rays, n_base=samples[0], n_surface=samples[1])
    for name in ("losses", "features", "decoder", "T_wc"):
        assert_close(got[name], want[name], 1e-10, name)


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33])
@pytest.mark.parametrize("n_samples", [1, 3])
def test_track_equals_oracle(n_rays, n_samples):
    scene, rays = make_scene(), make_rays(n_rays, n_samples)
    arguments = rays["dirs_c"], rays["depth"], rays["T_wc"][0], rays["uniforms"], scene.features
    got = field_track(*arguments, scene.table, scene.decoder, scene.spec, 0.08, impl="reference")
    want = reference_field.field_track(*arguments, scene.slots, scene.decoder, scene.spec, 0.08)
    assert_close(got[0], want[0], 1e-10, "residuals")
    assert_close(got[1], want[1], 1e-10, "jacobian")
    assert got[2].equal(want[2])
    if n_rays > 1:
        assert want[2].any() and not want[2].all()


@pytest.mark.parametrize("n", [0, 1, 31, 32, 33, 300])
def test_query_equals_oracle(n):
    scene = make_scene()
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(1)).double() * 4 - 2
    got = field_query(points, scene.features, scene.table, scene.decoder, scene.spec, impl="reference")
    want = reference_field.field(points, scene.features, scene.slots, scene.decoder, scene.spec)
    assert_close(got[0], want[0], 1e-10, "tsdf")
    assert_close(got[1], want[1], 1e-10, "color")
    assert got[2].equal(want[2])
    geometry = field_query(points, scene.features, scene.table, scene.decoder, scene.spec, with_color=False)
    assert geometry[0].equal(got[0]) and geometry[1].shape == (0, 3)


# --- the differentiable form ----------------------------------------------------------------------------------------


def differentiable(scene, rays):
    rays = dict(rays)
    T_wc = rays.pop("T_wc")
    uniforms = rays.pop("uniforms")

    def losses(T_wc, features, decoder):
        return field_map(
            *rays.values(), T_wc, uniforms, features, scene.table, decoder, scene.spec, N_BASE, N_SURFACE, NEAR, FAR
        )

    return losses, tuple(t.clone().requires_grad_() for t in (T_wc, scene.features, scene.decoder))


def test_gradcheck():
    spec = FieldSpec(cell_sizes=(0.4,), n_octaves=1, hidden=4, n_geometry=2, base_wavelength=4.0)
    scene, rays = make_scene(spec, missing=0.1), make_rays(3, N_BASE + N_SURFACE, n_frames=2)
    losses, leaves = differentiable(scene, rays)
    exists = (scene.features != 0).double()  # the others are constant by contract
    assert torch.autograd.gradcheck(
        lambda T, f, d: losses(T, f * exists, d), leaves, eps=1e-6, atol=1e-6, fast_mode=True
    )


def test_gradient_of_each_loss_alone():
    scene, rays = make_scene(), make_rays(7, N_BASE + N_SURFACE)
    for k in range(4):
        weights = [float(k == other) for other in range(4)]
        losses, leaves = differentiable(scene, rays)
        (losses(*leaves) @ torch.tensor(weights).double()).backward()
        want = run_oracle(scene, rays, lambdas=weights)
        for name, leaf in zip(("T_wc", "features", "decoder"), leaves, strict=True):
            grad = leaf.grad[:, :3] if name == "T_wc" else leaf.grad
            assert_close(grad, want[name], 1e-10, f"{name} of loss {k}")


def test_opcheck():
    scene, rays = make_scene().to(torch.float64), make_rays(3, N_BASE + N_SURFACE)
    T, f, d = (t.clone().requires_grad_() for t in (rays["T_wc"], scene.features, scene.decoder))
    table = (scene.table.probe, scene.table.brick_keys, scene.table.masks)
    rest = (*scene.spec._arguments, N_BASE, N_SURFACE, NEAR, FAR, "reference")
    head = (rays["dirs_c"], rays["depth"], rays["color"], rays["frame_index"])
    torch.library.opcheck(torch.ops.snh.field_map.default, (*head, T, rays["uniforms"], f, *table, d, *rest))
    scene_arguments = (scene.features, *table, scene.decoder, *scene.spec._arguments)
    torch.library.opcheck(
        torch.ops.snh.field_track.default,
        (rays["dirs_c"], rays["depth"], rays["T_wc"][0], rays["uniforms"], *scene_arguments, 0.06, "reference"),
    )
    torch.library.opcheck(
        torch.ops.snh.field_query.default, (rays["dirs_c"], *scene_arguments, True, "reference"),
    )  # fmt: skip


# --- the fast implementation against the plain one ------------------------------------------------------------------

IMPLS = ["baseline", "avx2", "avx512"]
# float32 against float64 on the same numbers, relative to the largest entry: rounding 6e-8, about 30 roundings deep
# through two decoders, doubled per octave of gamma; sums over some 10^4 samples with signs. The pose gradient loses
# another digit to cancellation between samples.
BOUNDS = dict(losses=5e-6, features=1e-5, decoder=1e-5, T_wc=5e-5)


@pytest.fixture(params=IMPLS)
def impl(request) -> str:
    try:
        field_query(torch.zeros(0, 3), *empty_map(SPEC), impl=request.param)
    except RuntimeError as error:
        assert "does not have" in str(error)
        pytest.skip(f"this processor does not have {request.param}")
    return request.param


def empty_map(spec):
    return torch.zeros(0, 4), HashTable(), torch.zeros(spec.decoder_size), spec


def rounded(scene, rays):
    """The same with numbers that float32 holds exactly."""
    scene = scene.to(torch.float32).to(torch.float64)
    return scene, {k: v if k == "frame_index" else v.float().double() for k, v in rays.items()}


def assert_fast_map(scene, rays, impl, bounds=BOUNDS, **samples):
    scene, rays = rounded(scene, rays)
    want = run_map(scene, rays, "reference", **samples)
    got = run_map(scene.to(torch.float32), rays, impl, **samples)
    for name, bound in bounds.items():
        scale = want[name].abs().max().item() if want[name].numel() else 0.0
        error = (got[name].double() - want[name]).abs().max().item() if want[name].numel() else 0.0
        assert error <= bound * scale, f"{name}: error {error:.3g}, largest entry {scale:.3g}"
    # A brick may be marked although its gradient is zero, never the other way round.
    for gradient in (got["features"], want["features"]):
        assert (got["touched"].bool() | (gradient.view(-1, 256) == 0).all(dim=1)).all()
    absent = torch.ones(len(scene.features), dtype=torch.bool)
    absent[list(scene.slots.values())] = False
    assert not got["features"][absent].any()


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33, 70])
def test_fast_map(n_rays, impl):
    assert_fast_map(make_scene(), make_rays(n_rays, N_BASE + N_SURFACE), impl)


@pytest.mark.parametrize("samples", [(36, 12), (1, 0), (0, 1), (2, 3), (200, 17)], ids=str)
def test_fast_map_sample_counts(samples, impl):
    n_base, n_surface = samples
    growth = max(1.0, sum(samples) / 48) ** 0.5  # the bounds are for 48 samples; rounding of a sum grows as its root
    bounds = {name: bound * growth for name, bound in BOUNDS.items()}
    assert_fast_map(make_scene(), make_rays(11, sum(samples)), impl, bounds, n_base=n_base, n_surface=n_surface)


@pytest.mark.parametrize(
    "change",
    [
        dict(cut_behind=True),
        dict(n_features=4, cell_sizes=(0.1,)),
        dict(n_features=1, n_octaves=0),
        dict(n_geometry=0, hidden=1),
        dict(hidden=33, n_geometry=16, n_features=2),
        dict(cell_sizes=tuple(0.05 * 1.2**k for k in range(16)), hidden=8, n_octaves=1),
    ],
    ids=str,
)
def test_fast_map_variants(change, impl):
    scene = make_scene(replace(SPEC, **change))
    scene.decoder *= 3 if "cut_behind" in change else 1  # so that rays do cross surfaces
    assert_fast_map(scene, make_rays(40, N_BASE + N_SURFACE), impl)


@pytest.mark.parametrize("centre", [-9.0, 40.0])
def test_fast_map_away_from_the_origin(centre, impl):
    """Coordinates of one sign: floor and truncation differ. Positions lose digits with the distance."""
    box = tuple(tuple(x + centre for x in corner) for corner in ((-1.0, -1.2, 0.2), (1.1, 0.9, 1.9)))
    rays = make_rays(33, N_BASE + N_SURFACE, centre=(centre,) * 3)
    digits = dict(losses=1e-4, features=1e-3, decoder=1e-3, T_wc=1e-2)
    assert_fast_map(make_scene(box=box), rays, impl, bounds=digits)


@pytest.mark.parametrize("far", [1e5, -1e5, 1e12, float("nan")])
def test_fast_map_far_outside(far, impl):
    """100 km away there is no vertex: no gradient reaches the features, and nothing is read out of bounds."""
    scene, rays = make_scene().to(torch.float32), make_rays(33, N_BASE + N_SURFACE)
    rays["T_wc"][:, :3, 3] += far
    got = run_map(scene, rays, impl)
    assert not got["touched"].any() and not got["features"].any()
    assert got["losses"].isfinite().all() or far != far
    fine = run_map(scene, make_rays(33, N_BASE + N_SURFACE), impl)  # nothing of it is left in the workspace
    assert all(value.isfinite().all() for value in fine.values())


def test_fast_map_follows_the_table(impl):
    """The directory of bricks is kept between calls: other tables, growth and masks of the same bricks are noticed."""
    rays = make_rays(20, N_BASE + N_SURFACE)
    for missing in (0.02, 0.5, 0.02, 0.9):
        assert_fast_map(make_scene(missing=missing), rays, impl)
    scene = make_scene(missing=0.0)
    half = Scene(scene.spec, HashTable(), scene.slots, scene.features.clone(), scene.decoder)
    half.table.insert(
        scene.table.brick_keys[::2].contiguous(), scene.table.masks[::2].contiguous() & 0x0F0F0F0F0F0F0F0F
    )
    for grow in (lambda: None, lambda: half.table.insert(scene.table.brick_keys, scene.table.masks)):
        grow()
        exists = (half.table.masks[:, None] >> torch.arange(64)) & 1
        half.features = scene.features[: half.table.n_bricks * 64] * exists.reshape(-1, 1)
        half.slots = dict(enumerate(torch.nonzero(exists.flatten()).flatten().tolist()))
        assert_fast_map(half, rays, impl)


def test_fast_map_with_bricks_far_apart(impl):
    """Two rooms 100 km apart: no grid of bricks covers both, so the hash table itself is asked."""
    scene, rays = make_scene(), make_rays(33, N_BASE + N_SURFACE)
    near = scene.table.n_bricks
    keys = torch.cat([scene.table.brick_keys, scene.table.brick_keys + (250_000 << 28) + 250_000])
    scene.table.insert(keys.unique(), torch.full_like(keys, -1))
    assert scene.table.n_bricks == 2 * near
    masks = torch.cat([make_scene().table.masks, torch.full((near,), -1)])
    scene.table = HashTable.from_bricks(scene.table.brick_keys.clone(), masks)
    scene.features = torch.cat([scene.features, torch.ones_like(scene.features)])
    scene.slots |= {("far", k): near * 64 + k for k in range(near * 64)}
    assert_fast_map(scene, rays, impl)


def test_fast_map_without_map(impl):
    rays = {k: v if k == "frame_index" else v.float() for k, v in make_rays(33, 9).items()}
    features, table, decoder, spec = empty_map(SPEC)
    got = run_map(Scene(spec, table, {}, features, decoder + 0.1), rays, impl)
    want = run_map(Scene(spec, table, {}, features.double(), decoder.double() + 0.1), rays, "reference")
    assert_close(got["losses"], want["losses"], 1e-5, "losses")
    assert_close(got["decoder"], want["decoder"], 1e-5, "decoder")


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33, 250])
@pytest.mark.parametrize("n_samples", [1, 3, 12])
def test_fast_track(n_rays, n_samples, impl):
    scene, rays = rounded(make_scene(), make_rays(n_rays, n_samples))

    def run(impl, dtype):
        dirs_c, depth, T_wc, uniforms = (rays[k].to(dtype) for k in ("dirs_c", "depth", "T_wc", "uniforms"))
        features, decoder = scene.features.to(dtype), scene.decoder.to(dtype)
        return field_track(
            dirs_c, depth, T_wc[0], uniforms, features, scene.table, decoder, scene.spec, 0.08, impl=impl
        )

    got, want = run(impl, torch.float32), run("reference", torch.float64)
    assert_close(got[0], want[0], 1e-5, "residuals")
    assert_close(got[1], want[1], 1e-4, "jacobian")
    assert got[2].equal(want[2])


@pytest.mark.parametrize("n", [0, 1, 31, 32, 33, 500])
def test_fast_query(n, impl):
    scene, _ = rounded(make_scene(), {})
    points = torch.rand(n, 3, generator=torch.Generator().manual_seed(1)) * 4 - 2
    want = field_query(points.double(), scene.features, scene.table, scene.decoder, scene.spec, impl="reference")
    fast = scene.to(torch.float32)
    got = field_query(points, fast.features, fast.table, fast.decoder, fast.spec, impl=impl)
    assert_close(got[0], want[0], 1e-5, "tsdf")
    assert_close(got[1], want[1], 1e-5, "color")
    assert got[2].equal(want[2])


def test_repeats_bit_for_bit_and_across_threads(impl):
    scene, rays = make_scene().to(torch.float32), make_rays(70, N_BASE + N_SURFACE)
    threads = torch.get_num_threads()
    try:
        runs = {}
        for n in (1, 2, 3):
            torch.set_num_threads(n)
            runs[n] = run_map(scene, rays, impl)
            again = run_map(scene, rays, impl)
            assert all(runs[n][name].equal(again[name]) for name in again)
    finally:
        torch.set_num_threads(threads)
    for n in (2, 3):
        assert runs[n]["touched"].equal(runs[1]["touched"])
        for name in BOUNDS:
            assert_close(runs[n][name], runs[1][name].double(), 1e-6, f"{name} on {n} threads")


def test_errors_name_the_argument():
    scene, rays = make_scene(), make_rays(3, N_BASE + N_SURFACE)
    with pytest.raises(RuntimeError, match=r"field_map_: 'baseline' needs float32"):
        run_map(scene, rays, "baseline")
    with pytest.raises(RuntimeError, match=r"field_map_: argument 'impl' must be .* got 'sse9'"):
        run_map(scene, rays, "sse9")
    with pytest.raises(RuntimeError, match=r"field_map_: argument 'frame_index' must be in 0 \.\. 2, got 7 for ray 1"):
        run_map(scene, {**rays, "frame_index": torch.tensor([0, 7, 0], dtype=torch.int32)})
    with pytest.raises(RuntimeError, match=r"field_map_: argument 'color' must have shape \[3, 3\], got \[2, 3\]"):
        run_map(scene, {**rays, "color": rays["color"][:2]})
    with pytest.raises(RuntimeError, match=r"field_query: argument 'decoder' must have shape"):
        field_query(torch.zeros(1, 3).double(), scene.features, scene.table, scene.decoder[1:], scene.spec)
    with pytest.raises(ValueError, match=r"a decoder of this FieldSpec has shape"):
        SPEC.decoder_views(torch.zeros(3))
