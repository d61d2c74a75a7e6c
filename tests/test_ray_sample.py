"""ray_sample against numbers worked by hand, the dumb oracle and torch's own checks."""

import pytest
import reference_rays as reference
import torch

from snh.ops import ray_sample
from snh.ops._library import native

UNIT = 2.0**-24  # float32 rounding


@pytest.mark.parametrize(
    "depth, uniforms, n_base, n_surface, want",
    [
        # Base strata on [0, 4] of width 1, surface strata on [1, 3] of width 1.
        (2.0, [0.5, 0.5, 0.5, 0.5], 4, 0, [0.5, 1.5, 2.5, 3.5]),
        (2.0, [0.25, 0.75], 0, 2, [1.25, 2.75]),
        (2.0, [0.0, 0.5, 0.0, 0.5, 0.0, 0.25], 4, 2, [0.0, 1.0, 1.5, 2.0, 2.25, 3.5]),
        (2.0, [], 0, 0, []),
        # Nearer than the truncation: the surface strata begin behind the camera and are kept.
        (0.5, [0.5, 0.5], 1, 1, [0.5, 0.5]),
        (0.5, [0.5, 0.0, 0.5], 1, 2, [-0.5, 0.5, 1.0]),
    ],
)
def test_hand_worked(depth, uniforms, n_base, n_surface, want):
    z = ray_sample(
        torch.tensor([depth]), torch.tensor([uniforms]), n_base, n_surface, truncation=1.0, near=0.0, far=2.0
    )
    assert z.tolist() == [want]


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33])
@pytest.mark.parametrize("counts", [(36, 12), (1, 0), (0, 1), (7, 31)])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle(n_rays, counts, dtype):
    g = torch.Generator().manual_seed(n_rays)
    for largest in (8.0, 1e5):  # metres
        depth = (torch.rand(n_rays, generator=g, dtype=torch.float64) * largest + 0.02).to(dtype)
        uniforms = torch.rand(n_rays, sum(counts), generator=g, dtype=torch.float64).to(dtype)
        z = ray_sample(depth, uniforms, *counts, truncation=0.06, near=0.01, far=1.2)
        want = reference.ray_sample(depth, uniforms, *counts, truncation=0.06, near=0.01, far=1.2)
        # 8 roundings of numbers up to 1.2 depth: of the three settings, of the range and step, of place, product, sum
        tolerance = 1e-10 if dtype == torch.float64 else 8 * UNIT * 1.2 * (largest + 1)
        assert z.dtype == dtype and (z.diff(dim=1) >= 0).all()
        torch.testing.assert_close(z.double(), want, rtol=0, atol=tolerance)


def test_every_stratum_holds_one_sample():
    uniforms = torch.rand(100, 36, generator=torch.Generator().manual_seed(0))
    z = ray_sample(torch.full((100,), 3.0), uniforms, n_base=36, n_surface=0)
    edges = torch.linspace(0.03, 3.6, 37)
    rounding = 4 * UNIT * 3.6
    assert ((z >= edges[:-1] - rounding) & (z <= edges[1:] + rounding)).all()


def test_largest_uniform_keeps_the_order():
    uniforms = torch.full((3, 48), 1 - UNIT)
    z = ray_sample(torch.tensor([0.1, 1.0, 1e4]), uniforms)
    assert (z.diff(dim=1) >= 0).all()


def test_not_contiguous():
    depth, uniforms = torch.rand(33) + 1, torch.rand(33, 48)
    want = ray_sample(depth, uniforms)
    assert torch.equal(ray_sample(torch.stack([depth, depth], 1)[:, 0], uniforms.T.contiguous().T), want)


def test_opcheck():
    for dtype in (torch.float32, torch.float64):
        arguments = (torch.rand(5, dtype=dtype), torch.rand(5, 48, dtype=dtype), 36, 12, 0.01, 1.2, 0.06)
        torch.library.opcheck(native.ray_sample.default, arguments)


@pytest.mark.parametrize(
    "depth, uniforms, counts, message",
    [
        (torch.zeros(2, 1), torch.zeros(2, 3), (2, 1), r"'depth' must have shape \[\*\], got \[2, 1\]"),
        (torch.zeros(2), torch.zeros(2, 4), (2, 1), r"'uniforms' must have shape \[2, 3\], got \[2, 4\]"),
        (torch.zeros(2), torch.zeros(2, 3).double(), (2, 1), "'uniforms' must be Float, got Double"),
        (torch.zeros(2).int(), torch.zeros(2, 3), (2, 1), "'depth' must be float32 or float64, got Int"),
        (torch.zeros(2), torch.zeros(2, 3), (-1, 4), "'n_base' must be at least 0, got -1"),
        (torch.zeros(2), torch.zeros(2, 3), (4, -1), "'n_surface' must be at least 0, got -1"),
    ],
)
def test_refused(depth, uniforms, counts, message):
    with pytest.raises(RuntimeError, match=message):
        ray_sample(depth, uniforms, *counts)
