"""Colour and depth of rays from the samples on them."""

from __future__ import annotations

import torch
from torch import Tensor

from snh.ops._library import native


def ray_render(
    tsdf: Tensor,  # [R, S], in units of the truncation
    color: Tensor,  # [R, S, 3]
    z: Tensor,  # [R, S] m, ascending per ray
    sharpness: float = 1 / 0.06,
    cut_behind: float | None = None,  # m
) -> tuple[Tensor, Tensor, Tensor]:  # [R, 3], [R] m, [R, S]
    """Colour and depth of each ray, and the weight of each sample (paper, eq. 6-7).

    The weight is sigmoid(tsdf * sharpness) sigmoid(-tsdf * sharpness), divided by the sum over the ray plus 1e-8, so
    that `(weight * x).sum(1)` renders any other quantity x. The paper's sharpness is 1 / truncation. With `cut_behind`,
    samples more than that distance behind the ray's first change from positive to non-positive tsdf weigh nothing.
    Differentiable twice in `tsdf`, `color` and `z` through all three results. float32 or float64.

    Raises RuntimeError when shapes or dtypes do not fit.

    >>> import torch
    >>> z = torch.tensor([[1.0, 2.0, 3.0]])
    >>> color, depth, weight = ray_render(torch.tensor([[1.0, 0.0, -1.0]]), torch.ones(1, 3, 3), z, sharpness=2.0)
    >>> weight
    tensor([[0.2283, 0.5435, 0.2283]])
    >>> depth
    tensor([2.])
    """
    return native.ray_render(tsdf, color, z, sharpness, cut_behind)


@torch.library.register_fake("snh::ray_render")
def _(tsdf, color, z, sharpness, cut_behind):
    return tsdf.new_empty(tsdf.shape[0], 3), tsdf.new_empty(tsdf.shape[0]), tsdf.new_empty(tsdf.shape)


@torch.library.register_fake("snh::ray_render_backward")
def _(grad_color, grad_depth, grad_weight, tsdf, color, z, weight, sharpness):
    return tsdf.new_empty(tsdf.shape), color.new_empty(color.shape), z.new_empty(z.shape)


def _save(ctx, inputs, output):
    tsdf, color, z, ctx.sharpness, _ = inputs
    ctx.save_for_backward(tsdf, color, z, output[2])


def _backward(ctx, grad_color, grad_depth, grad_weight):
    grads = native.ray_render_backward(grad_color, grad_depth, grad_weight, *ctx.saved_tensors, ctx.sharpness)
    return (*grads, None, None)


def _save_backward(ctx, inputs, output):
    *tensors, ctx.sharpness = inputs
    ctx.save_for_backward(*tensors)


def _double_backward(ctx, v_tsdf, v_color, v_z):
    """Gradient of sum(v * the backward's results), formulas in csrc/ray_render/ray_render.h differentiated once more.

    In plain torch: second derivatives of a rendering are rare. With t = tanh, a = -sharpness t v_tsdf and
    b = v_color . dC + v_z dD, that sum is Phi = sum_i p_i (a_i (g_i - g_mean) + b_i). The weights p are an input of
    the backward, so their own gradient to tsdf is left to autograd.
    """
    d_color, d_depth, d_weight, tsdf, color, z, p = ctx.saved_tensors
    g = d_weight + (color @ d_color[..., None])[..., 0] + z * d_depth[:, None]
    centred = g - (p * g).sum(1, keepdim=True)
    t = torch.tanh(tsdf * (ctx.sharpness / 2))
    a = -ctx.sharpness * t * v_tsdf
    b = (v_color @ d_color[..., None])[..., 0] + v_z * d_depth[:, None]
    a_mean = (p * a).sum(1, keepdim=True)
    to_g = p * (a - a_mean)  # dPhi/dg
    return (
        torch.einsum("rs,rsc->rc", to_g, color) + torch.einsum("rs,rsc->rc", p, v_color),
        (to_g * z + p * v_z).sum(1),
        to_g,
        -(ctx.sharpness**2) / 2 * (1 - t * t) * v_tsdf * p * centred,
        to_g[..., None] * d_color[:, None],
        to_g * d_depth[:, None],
        a * centred - a_mean * g + b,
        None,
    )


torch.library.register_autograd("snh::ray_render", _backward, setup_context=_save)
torch.library.register_autograd("snh::ray_render_backward", _double_backward, setup_context=_save_backward)
