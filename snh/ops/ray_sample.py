"""Depths of the samples on each ray."""

import torch
from torch import Tensor

from snh.ops._library import native


def ray_sample(
    depth: Tensor,  # [R] m, > 0
    uniforms: Tensor,  # [R, n_base + n_surface] in [0, 1)
    n_base: int = 36,
    n_surface: int = 12,
    truncation: float = 0.06,  # m
    near: float = 0.01,
    far: float = 1.2,
) -> Tensor:  # [R, S] m
    """Stratified samples on [near, far] x depth and, around the surface, on depth +- truncation, merged by depth.

    Paper, section III-B. Not differentiable: sample depths are constants of the loss. `uniforms` places each sample
    in its stratum, so that the caller owns the randomness; 0.5 everywhere gives the regular grid. float32 or float64.

    Raises RuntimeError when shapes or dtypes do not fit.

    >>> import torch
    >>> ray_sample(torch.tensor([2.0]), torch.full((1, 4), 0.5), n_base=2, n_surface=2)
    tensor([[0.6150, 1.8050, 1.9700, 2.0300]])
    """
    return native.ray_sample(depth, uniforms, n_base, n_surface, near, far, truncation)


@torch.library.register_fake("snh::ray_sample")
def _(depth, uniforms, n_base, n_surface, near, far, truncation):
    return depth.new_empty(depth.shape[0], n_base + n_surface)
