"""ray_render against numbers worked by hand, the dumb oracle, finite differences and torch's own checks."""

import math

import pytest
import reference_rays as reference
import torch

from snh.ops import ray_render
from snh.ops._library import native

SIZES = [0, 1, 31, 32, 33]
UNIT = 2.0**-24  # float32 rounding


def samples(n_rays, n_samples, dtype=torch.float64, offset=0.0, seed=0):
    g = torch.Generator().manual_seed(seed)
    tsdf = torch.rand(n_rays, n_samples, generator=g, dtype=torch.float64) * 2 - 1
    color = torch.rand(n_rays, n_samples, 3, generator=g, dtype=torch.float64)
    z = torch.rand(n_rays, n_samples, generator=g, dtype=torch.float64).sort(dim=1)[0] * 4 + offset
    return tsdf.to(dtype), color.to(dtype), z.to(dtype)


# --- by hand ------------------------------------------------------------------------------------------------------

LOG3 = math.log(3)  # sigmoid(ln 3) = 3/4, so the bell is 3/16 there, and 1/4 at zero


@pytest.mark.parametrize(
    "tsdf, z, cut_behind, weight",
    [
        ([0.0], [1.0], None, [1.0]),
        ([LOG3, 0.0, -LOG3], [1.0, 2.0, 3.0], None, [3 / 10, 4 / 10, 3 / 10]),
        # The crossing is sample 0 at z = 1: what lies beyond 1 + cut weighs nothing, z = 1 + cut itself still does.
        ([LOG3, 0.0, -LOG3], [1.0, 2.0, 3.0], 1.0, [3 / 7, 4 / 7, 0.0]),
        ([LOG3, 0.0, -LOG3], [1.0, 2.0, 3.0], 0.5, [1.0, 0.0, 0.0]),
        # Only the first crossing counts, and only one from positive to zero or negative.
        ([-LOG3, LOG3, -LOG3, LOG3, -LOG3], [1.0, 2.0, 3.0, 4.0, 5.0], 1.5, [1 / 3, 1 / 3, 1 / 3, 0.0, 0.0]),
        ([-LOG3, -LOG3, LOG3], [1.0, 2.0, 3.0], 0.1, [1 / 3, 1 / 3, 1 / 3]),
        ([0.0, -LOG3], [1.0, 2.0], 0.1, [4 / 7, 3 / 7]),
    ],
)
def test_hand_worked(tsdf, z, cut_behind, weight):
    n = len(z)
    z, want = torch.tensor([z], dtype=torch.float64), torch.tensor([weight], dtype=torch.float64)
    color = torch.stack([z, 2 * z, 0 * z], dim=-1)
    color_ray, depth_ray, got = ray_render(torch.tensor([tsdf], dtype=torch.float64) / 5, color, z, 5.0, cut_behind)
    depth = (want * z).sum(1)
    tolerance = 1e-8 / (0.1875 * n) * 20  # the epsilon in the sum of the weights
    torch.testing.assert_close(got, want, rtol=0, atol=tolerance)
    torch.testing.assert_close(depth_ray, depth, rtol=0, atol=tolerance)
    torch.testing.assert_close(color_ray, torch.stack([depth, 2 * depth, 0 * depth], 1), rtol=0, atol=tolerance)


def test_epsilon_is_in_the_sum():
    """Far from every surface, w = exp(-|x|) is as small as the epsilon 1e-8."""
    x = -math.log(1e-8)
    _, depth, weight = ray_render(
        torch.tensor([[x]]).double(), torch.ones(1, 1, 3).double(), torch.ones(1, 1).double(), 1.0
    )
    assert abs(weight.item() - 0.5) < 1e-7 and abs(depth.item() - 0.5) < 1e-7


@pytest.mark.parametrize("n_samples, tsdf", [(0, 0.0), (3, 1e30), (3, -1e30)])
def test_no_samples_and_no_weight_render_as_zero(n_samples, tsdf):
    samples = torch.full((2, n_samples), tsdf), torch.ones(2, n_samples, 3), torch.ones(2, n_samples)
    color, depth, weight = ray_render(*samples, sharpness=16.0)
    assert (color == 0).all() and (depth == 0).all() and (weight == 0).all() and weight.shape == (2, n_samples)


# --- against the oracle -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_rays", SIZES)
@pytest.mark.parametrize("n_samples", [1, 12, 48])
@pytest.mark.parametrize("cut_behind", [None, 0.06, 1.0])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle(n_rays, n_samples, cut_behind, dtype):
    for offset in (-2.0, 1e5):  # samples behind the camera; 100 km
        tsdf, color, z = samples(n_rays, n_samples, dtype, offset)
        got = ray_render(tsdf, color, z, 1 / 0.06, cut_behind)
        want = reference.ray_render(tsdf, color, z, 1 / 0.06, cut_behind)
        # float32: x up to 1/0.06 with two roundings (relative error of exp: 2 x 17), a few more, and as many as samples
        # in the sums; relative to the largest z
        relative = 1e-10 if dtype == torch.float64 else (50 + 2 * n_samples) * UNIT
        for a, b in zip(got, want, strict=True):
            assert a.dtype == dtype
            largest = max(1.0, b.abs().max().item()) if b.numel() else 1.0
            torch.testing.assert_close(a.double(), b, rtol=0, atol=relative * largest)


@pytest.mark.parametrize("n_rays", SIZES)
@pytest.mark.parametrize("cut_behind", [None, 0.5])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle_gradients(n_rays, cut_behind, dtype):
    inputs = samples(n_rays, 24, dtype)
    g = torch.Generator().manual_seed(1)
    upstream = [torch.rand(s, generator=g, dtype=torch.float64) - 0.5 for s in [(n_rays, 3), (n_rays,), (n_rays, 24)]]
    results = []
    for render in (ray_render, reference.ray_render):
        leaves = [t.clone().requires_grad_() for t in inputs]
        outputs = render(*leaves, 1 / 0.06, cut_behind)
        loss = sum((o.double() * u).sum() for o, u in zip(outputs, upstream, strict=True))
        loss = loss + sum(0 * t.sum() for t in leaves)  # the oracle's empty result is a constant
        results.append(torch.autograd.grad(loss, leaves))
    # float32: as the value, times the sharpness for tsdf and the sum of up to 5 terms of |g| <= 4
    tolerance = 1e-10 if dtype == torch.float64 else 100 * UNIT * 20 / 0.06
    for a, b in zip(*results, strict=True):
        torch.testing.assert_close(a.double(), b.double(), rtol=0, atol=tolerance)


def test_not_contiguous():
    tsdf, color, z = samples(33, 12)
    want = ray_render(tsdf, color, z, 4.0, 0.3)
    got = ray_render(
        tsdf.T.contiguous().T, color.permute(2, 0, 1).contiguous().permute(1, 2, 0), z.T.contiguous().T, 4.0, 0.3
    )
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


# --- derivatives --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut_behind", [None, 0.8])
def test_gradcheck(cut_behind):
    inputs = [t.requires_grad_() for t in samples(3, 6)]

    def run(*leaves):
        return ray_render(*leaves, 3.0, cut_behind)

    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-7)
    assert torch.autograd.gradgradcheck(run, inputs, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize("output", [0, 1, 2])
def test_gradcheck_of_one_output(output):
    inputs = [t.requires_grad_() for t in samples(2, 5)]
    assert torch.autograd.gradcheck(lambda *leaves: ray_render(*leaves, 3.0)[output], inputs, atol=1e-7)
    assert torch.autograd.gradgradcheck(lambda *leaves: ray_render(*leaves, 3.0)[output], inputs, atol=1e-6)


def test_gradient_is_finite_where_no_sample_weighs():
    tsdf = torch.tensor([[1e4, 1e4, 1e4]]).requires_grad_()
    _, depth, _ = ray_render(tsdf, torch.ones(1, 3, 3), torch.ones(1, 3), 16.0)
    depth.sum().backward()
    assert (tsdf.grad == 0).all()


def test_opcheck():
    for cut_behind in (None, 0.5):
        inputs = [t.requires_grad_() for t in samples(4, 6)]
        torch.library.opcheck(native.ray_render.default, (*inputs, 3.0, cut_behind))
    weight = ray_render(*[t.detach() for t in inputs], 3.0)[2].requires_grad_()
    grads = [torch.rand(s, dtype=torch.float64, requires_grad=True) for s in [(4, 3), (4,), (4, 6)]]
    torch.library.opcheck(native.ray_render_backward.default, (*grads, *inputs, weight, 3.0))


@pytest.mark.parametrize(
    "tsdf, color, z, message",
    [
        (torch.zeros(2), torch.zeros(2, 4, 3), torch.zeros(2, 4), r"'tsdf' must have shape \[\*, \*\], got \[2\]"),
        (torch.zeros(2, 4), torch.zeros(2, 4), torch.zeros(2, 4), r"'color' must have shape \[2, 4, 3\], got \[2, 4\]"),
        (torch.zeros(2, 4), torch.zeros(2, 4, 3), torch.zeros(2, 5), r"'z' must have shape \[2, 4\], got \[2, 5\]"),
        (torch.zeros(2, 4), torch.zeros(2, 4, 3).double(), torch.zeros(2, 4), "'color' must be Float, got Double"),
        (
            torch.zeros(2, 4).half(),
            torch.zeros(2, 4, 3),
            torch.zeros(2, 4),
            "'tsdf' must be float32 or float64, got Half",
        ),
    ],
)
def test_refused(tsdf, color, z, message):
    with pytest.raises(RuntimeError, match=message):
        ray_render(tsdf, color, z)
