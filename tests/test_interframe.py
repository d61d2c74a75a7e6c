"""interframe against numbers worked by hand, the dumb oracle and finite differences of the twist."""

import math

import numpy as np
import pytest
import reference_rays as reference
import torch

from snh import geometry
from snh.ops import interframe
from snh.ops._library import native

UNIT = 2.0**-24  # float32 rounding
CAMERA = (60.0, 55.0, 31.5, 23.5)
HEIGHT, WIDTH = 48, 64


def scene(n_rays, dtype=torch.float64, seed=0):
    """Rays, a pose a few degrees and centimetres away and a keyframe of noise. About a fifth leaves the image."""
    g = torch.Generator().manual_seed(seed)
    depth = torch.rand(n_rays, 1, generator=g, dtype=torch.float64) * 3 + 0.5
    uv = torch.rand(n_rays, 2, generator=g, dtype=torch.float64) * torch.tensor([WIDTH + 8, HEIGHT + 8]) - 4
    fx, fy, cx, cy = CAMERA
    directions = torch.cat([(uv - torch.tensor([cx, cy])) / torch.tensor([fx, fy]), torch.ones(n_rays, 1)], 1)
    color = torch.rand(n_rays, 3, generator=g, dtype=torch.float64)
    image = torch.randint(0, 256, (HEIGHT, WIDTH, 3), generator=g, dtype=torch.uint8)
    T_kc = torch.from_numpy(geometry.se3_exp(np.array([0.05, -0.02, 0.03, 0.02, -0.05, 0.04])))
    return (directions * depth).to(dtype), color.to(dtype), T_kc.to(dtype), image


# --- by hand ------------------------------------------------------------------------------------------------------


def test_hand_worked():
    """Red = 10 (u + 2 v), so C = 10/255 (u + 2 v) everywhere. fx = fy = 2, the point (2, 1, 2): u = 4, v = 3."""
    v, u = torch.meshgrid(torch.arange(6), torch.arange(8), indexing="ij")
    image = torch.zeros(6, 8, 3, dtype=torch.uint8)
    image[..., 0] = (10 * (u + 2 * v)).to(torch.uint8)
    T_kc = torch.eye(4, dtype=torch.float64)
    T_kc[:3, 3] = torch.tensor([0.5, 0.0, 1.0])
    points, color = torch.tensor([[1.5, 1.0, 1.0]]).double(), torch.tensor([[0.1, 0.2, 0.3]]).double()
    residuals, jacobian, valid = interframe(points, color, T_kc, image, (2.0, 2.0, 2.0, 2.0))
    assert valid.tolist() == [True]
    unit = 10 / 255
    torch.testing.assert_close(residuals, torch.tensor([[unit * 10 - 0.1, -0.2, -0.3]]).double())
    # u = 2 x / z + 2: du = dx - dz at z = 2, x = 2; v = 2 y / z + 2: dv = dy - dz / 2. du + 2 dv = dx + 2 dy - 2 dz.
    a = torch.tensor([1.0, 2.0, -2.0]).double()
    phi = torch.linalg.cross(points[0], a)  # a . (phi x p) = phi . (p x a)
    torch.testing.assert_close(jacobian[0, 0], unit * torch.cat([a, phi]))
    assert (jacobian[0, 1:] == 0).all()


@pytest.mark.parametrize(
    "u, v, z, inside",
    [
        (1.0, 1.0, 1.0, True),
        (0.99, 1.0, 1.0, False),
        (1.0, 0.99, 1.0, False),
        (WIDTH - 2.0, HEIGHT - 2.0, 1.0, True),
        (WIDTH - 1.99, HEIGHT - 2.0, 1.0, False),
        (WIDTH - 2.0, HEIGHT - 1.99, 1.0, False),
        (20.0, 20.0, -1.0, False),
        (20.0, 20.0, 0.0, False),
        (math.nan, 20.0, 1.0, False),
    ],
)
def test_margin(u, v, z, inside):
    point = torch.tensor([[u * z, v * z, z]], dtype=torch.float64)
    image = torch.full((HEIGHT, WIDTH, 3), 51, dtype=torch.uint8)
    residuals, jacobian, valid = interframe(
        point, torch.zeros(1, 3).double(), torch.eye(4).double(), image, (1, 1, 0, 0)
    )
    assert valid.item() == inside
    assert residuals.flatten().tolist() == pytest.approx([0.2 * inside] * 3) and (jacobian == 0).all()


def test_image_smaller_than_its_margin():
    _, _, valid = interframe(torch.ones(3, 3), torch.zeros(3, 3), torch.eye(4), torch.zeros(1, 0, 3).byte(), CAMERA)
    assert not valid.any()


# --- against the oracle -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_rays", [0, 1, 31, 32, 33, 1000])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_oracle(n_rays, dtype):
    points, color, T_kc, image = scene(n_rays, dtype)
    residuals, _, valid = interframe(points, color, T_kc, image, CAMERA)
    want, want_valid = reference.interframe(points, color, T_kc, image, CAMERA)
    # float32: 8 roundings of a pixel coordinate up to 64, times a colour gradient of up to 2 per pixel; no ray of this
    # scene is that near to the margin
    tolerance = 1e-10 if dtype == torch.float64 else 8 * UNIT * 64 * 2 + 8 * UNIT
    assert torch.equal(valid, want_valid)
    torch.testing.assert_close(residuals.double(), want, rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_jacobian_is_the_derivative_to_the_right_twist(dtype):
    points, color, T_kc, image = scene(200)
    _, jacobian, valid = interframe(*(t.to(dtype) for t in (points, color, T_kc)), image, CAMERA)
    step = 1e-7
    for k in range(6):
        moved = []
        for sign in (1, -1):
            twist = np.zeros(6)
            twist[k] = sign * step
            T = T_kc @ torch.from_numpy(geometry.se3_exp(twist))
            moved.append(reference.interframe(points, color, T, image, CAMERA)[0])
        numeric = (moved[0] - moved[1]) / (2 * step)
        # float64: 1e-15 of rounding, over the step, times 100 px/m. float32: 8 roundings of a coordinate up to 64 px,
        # times the image's mixed derivative, up to 4 per px^2, and up to 400 px per unit of twist
        tolerance = 1e-5 if dtype == torch.float64 else 8 * UNIT * 64 * 4 * 400
        torch.testing.assert_close(jacobian[..., k].double(), numeric, rtol=0, atol=tolerance)
    assert 100 < valid.sum() < 200


def test_not_contiguous():
    points, color, T_kc, image = scene(33)
    want = interframe(points, color, T_kc, image, CAMERA)
    got = interframe(points.T.contiguous().T, color.T.contiguous().T, T_kc.T.contiguous().T,
                     image.permute(2, 0, 1).contiguous().permute(1, 2, 0), CAMERA)  # fmt: skip
    assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))


def test_opcheck():
    torch.library.opcheck(native.interframe.default, (*scene(5), *CAMERA))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"image": torch.zeros(4, 4, 3)}, "'image' must be Byte, got Float"),
        ({"image": torch.zeros(4, 4).byte()}, r"'image' must have shape \[\*, \*, 3\], got \[4, 4\]"),
        ({"T_kc": torch.eye(3)}, r"'T_kc' must have shape \[4, 4\], got \[3, 3\]"),
        ({"T_kc": torch.eye(4).double()}, "'T_kc' must be Float, got Double"),
        ({"color": torch.zeros(3, 3)}, r"'color' must have shape \[2, 3\], got \[3, 3\]"),
    ],
)
def test_refused(change, message):
    arguments = {"points_c": torch.ones(2, 3), "color": torch.zeros(2, 3), "T_kc": torch.eye(4),
                 "image": torch.zeros(4, 4, 3).byte(), "camera": CAMERA}  # fmt: skip
    with pytest.raises(RuntimeError, match=message):
        interframe(**{**arguments, **change})
