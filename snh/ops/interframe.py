"""Colour differences between a frame and a keyframe, with their derivative to the pose."""

from __future__ import annotations

import torch
from torch import Tensor

from snh.ops._library import native


def interframe(
    points_c: Tensor,  # [R, 3] m, camera frame
    color: Tensor,  # [R, 3] in 0..1
    T_kc: Tensor,  # [4, 4] frame's camera to keyframe's camera
    image: Tensor,  # [H, W, 3] uint8, the keyframe
    camera: tuple[float, float, float, float],  # fx, fy, cx, cy of the keyframe, px
) -> tuple[Tensor, Tensor, Tensor]:  # [R, 3], [R, 3, 6], [R] bool
    """Residuals C_q_hat - C_q of rays that are projected into a keyframe (paper, eq. 13), Jacobian and validity.

    C_q_hat is the keyframe's colour at the projection of the point, bilinear, 0..1. The Jacobian is to the right twist
    (rho, phi) of `T_kc` or, which is the same, of the frame's T_wc: T <- T exp(twist). Valid are points in front of the
    keyframe that project at least one pixel inside its image; others have zero residual and Jacobian. Points without
    depth are the caller's to drop. Not differentiable. float32 or float64.

    Raises RuntimeError when shapes or dtypes do not fit.

    A keyframe whose red grows by 51 (0.2) per pixel to the right, seen 1 m away at half a pixel right of pixel (1, 1):

    >>> import torch
    >>> image = torch.zeros(4, 4, 3, dtype=torch.uint8)
    >>> image[:, :, 0] = torch.arange(4) * 51
    >>> points_c, color = torch.tensor([[-0.005, -0.01, 1.0]]), torch.zeros(1, 3)
    >>> residuals, jacobian, valid = interframe(points_c, color, torch.eye(4), image, (100.0, 100.0, 2.0, 2.0))
    >>> residuals
    tensor([[0.3000, 0.0000, 0.0000]])
    >>> jacobian[0, 0, :3]
    tensor([20.0000,  0.0000,  0.1000])
    """
    return native.interframe(points_c, color, T_kc, image, *camera)


@torch.library.register_fake("snh::interframe")
def _(points_c, color, T_kc, image, fx, fy, cx, cy):
    n_rays = points_c.shape[0]
    jacobian = points_c.new_empty(n_rays, 3, 6)
    return points_c.new_empty(n_rays, 3), jacobian, points_c.new_empty(n_rays, dtype=torch.bool)
