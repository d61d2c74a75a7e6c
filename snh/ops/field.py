"""The fused field step: sample, look up, decode, render, losses and all gradients in one pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from snh.ops._library import native
from snh.ops.hash_table import HashTable
from snh.ops.sparse_adam import adam_ as adam_
from snh.ops.sparse_adam import sparse_adam_ as sparse_adam_

FEATURE_STRIDE = 4  # floats per feature row


@dataclass(frozen=True)
class FieldSpec:
    """Everything that fixes the scene model except its parameters.

    The decoder is one flat tensor: f_g then f_c, each W1 b1 W2 b2 W3 b3 with W [outputs, inputs] as in nn.Linear.
    """

    cell_sizes: tuple[float, ...]  # m, one per level
    n_features: int = 3  # per level, at most 4
    n_octaves: int = 8  # of gamma
    base_wavelength: float = 8.0  # m, of the lowest octave
    hidden: int = 32
    n_geometry: int = 15  # length of rho
    truncation: float = 0.06  # T_r, m
    sharpness: float = 1 / 0.06  # of eq. 6, 1 / truncation units
    cut_behind: bool = False  # no weight deeper than the truncation behind the first surface on a ray

    @property
    def n_gamma(self) -> int:
        """Length of gamma(x)."""
        return 6 * self.n_octaves

    @property
    def n_encoding(self) -> int:
        """Length of [gamma(x), features(x)], the input of f_g."""
        return self.n_gamma + len(self.cell_sizes) * self.n_features

    @property
    def decoder_size(self) -> int:
        """Length of the flat decoder."""
        return sum(rows * (columns or 1) for _, rows, columns in self._layout)

    def decoder_views(self, flat: Tensor) -> dict[str, Tensor]:
        """Views of the flat decoder [P] by name: "geometry.W1" [H, P+E], "geometry.b1" [H], ... "color.b3" [3].

        Raises ValueError when `flat` does not have `decoder_size` entries.
        """
        if flat.shape != (self.decoder_size,):
            raise ValueError(f"a decoder of this FieldSpec has shape ({self.decoder_size},), got {tuple(flat.shape)}")
        views, first = {}, 0
        for name, rows, columns in self._layout:
            last = first + rows * (columns or 1)
            views[name] = flat[first:last].view((rows, columns) if columns else (rows,))
            first = last
        return views

    @cached_property
    def _layout(self) -> list[tuple[str, int, int]]:
        """(name, rows, columns) of each weight and bias; a bias has 0 columns."""
        H, layout = self.hidden, []
        mlps = (("geometry", self.n_encoding, 1 + self.n_geometry), ("color", self.n_gamma + self.n_geometry, 3))
        for mlp, n_in, n_out in mlps:
            for k, (rows, columns) in enumerate(((H, n_in), (H, H), (n_out, H)), start=1):
                layout += [(f"{mlp}.W{k}", rows, columns), (f"{mlp}.b{k}", rows, 0)]
        return layout

    @cached_property
    def _arguments(self) -> tuple:
        """The spec as the native ops take it."""
        return (
            list(self.cell_sizes), self.n_features, self.n_octaves, self.base_wavelength, self.hidden,
            self.n_geometry, self.truncation, self.sharpness, self.cut_behind,
        )  # fmt: skip


def field_map_(
    dirs_c: Tensor,  # [R, 3], z = 1, camera frame
    depth: Tensor,  # [R] m, > 0
    color: Tensor,  # [R, 3] in 0..1
    frame_index: Tensor,  # [R] int32, row of T_wc
    T_wc: Tensor,  # [M, 4, 4]
    uniforms: Tensor,  # [R, n_base + n_surface] in [0, 1)
    features: Tensor,  # [V, 4], V = 64 bricks; rows of absent vertices are zero
    table: HashTable,
    decoder: Tensor,  # [P]
    spec: FieldSpec,
    n_base: int,
    n_surface: int,
    near: float,  # x depth
    far: float,  # x depth
    lambdas: Sequence[float],  # of color, depth, fs, surface
    grad_features: Tensor,  # [V, 4], zero on entry; added to
    touched: Tensor,  # [B] uint8; set to 1 where a brick got a gradient
    grad_decoder: Tensor,  # [P], written
    grad_T_wc: Tensor,  # [M, 3, 4], written
    impl: str = "auto",
) -> Tensor:  # [4]
    """Losses (color, depth, fs, surface; eq. 8-10, unweighted) of rays and, in place, all gradients of their sum
    weighted with `lambdas` (eq. 11).

    Samples as `ray_sample`, look-up as `plane_lookup` (eq. 4), decoders of eq. 5, rendering as `ray_render`
    (eq. 6-7). `sparse_adam_` takes `grad_features` and `touched` and clears both.

    `impl` forces an implementation: "reference" (plain, float32 or float64), or "baseline", "avx2", "avx512" (fast,
    float32, on torch's threads; repeatable bit for bit at a given number of threads). "auto" takes the best instruction
    set of this processor for float32, and the plain one for float64, rays without samples and more than 2^24 bricks.

    Raises RuntimeError when shapes, dtypes or frame indices do not fit.
    """
    return native.field_map_(
        dirs_c, depth, color, frame_index, T_wc, uniforms, features, table.probe, table.brick_keys, table.masks,
        decoder, *spec._arguments, n_base, n_surface, near, far, list(lambdas), grad_features, touched,
        grad_decoder, grad_T_wc, impl,
    )  # fmt: skip


def field_map(
    dirs_c: Tensor,  # [R, 3], not differentiable
    depth: Tensor,  # [R] m, not differentiable
    color: Tensor,  # [R, 3], not differentiable
    frame_index: Tensor,  # [R] int32
    T_wc: Tensor,  # [M, 4, 4]
    uniforms: Tensor,  # [R, n_base + n_surface], not differentiable
    features: Tensor,  # [V, 4]
    table: HashTable,
    decoder: Tensor,  # [P]
    spec: FieldSpec,
    n_base: int,
    n_surface: int,
    near: float,
    far: float,
    impl: str = "auto",
) -> Tensor:  # [4]
    """`field_map_` as a differentiable function: gradients go to T_wc (its upper three rows), features and decoder.

    Forward computes the losses alone; backward computes them again with all gradients. First derivatives only.
    """
    return native.field_map(
        dirs_c, depth, color, frame_index, T_wc, uniforms, features, table.probe, table.brick_keys, table.masks,
        decoder, *spec._arguments, n_base, n_surface, near, far, impl,
    )  # fmt: skip


def field_track(
    dirs_c: Tensor,  # [R, 3], z = 1, camera frame
    depth: Tensor,  # [R] m, > 0
    T_wc: Tensor,  # [4, 4]
    uniforms: Tensor,  # [R, S] in [0, 1)
    features: Tensor,  # [V, 4]
    table: HashTable,
    decoder: Tensor,  # [P]
    spec: FieldSpec,
    band: float,  # m
    impl: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # [R, S] m, [R, S, 6], [R, S] bool
    """Residuals z + T_r s - D of S samples on depth +- band, their Jacobian to the right twist (rho, phi) of T_wc,
    and where every corner of the look-up exists (eq. 10 without colour, for tracking).

    S = 1 with uniforms of 0.5 is the surface point itself. Not differentiable: the Jacobian is the derivative.

    Raises RuntimeError when shapes or dtypes do not fit.
    """
    return native.field_track(
        dirs_c, depth, T_wc, uniforms, features, table.probe, table.brick_keys, table.masks, decoder, *spec._arguments,
        band, impl,
    )  # fmt: skip


def field_query(
    points: Tensor,  # [N, 3] m, world
    features: Tensor,  # [V, 4]
    table: HashTable,
    decoder: Tensor,  # [P]
    spec: FieldSpec,
    with_color: bool = True,
    impl: str = "auto",
) -> tuple[Tensor, Tensor, Tensor]:  # [N], [N, 3] (or [0, 3]), [N] bool
    """tsdf, colour in 0..1, and where every corner of the look-up exists, at points (eq. 5). Not differentiable.

    Raises RuntimeError when shapes or dtypes do not fit.
    """
    return native.field_query(
        points, features, table.probe, table.brick_keys, table.masks, decoder, *spec._arguments, with_color, impl
    )


def _map_context(ctx, inputs, output) -> None:
    tensors = [x for x in inputs if isinstance(x, Tensor)]
    ctx.save_for_backward(*tensors)
    ctx.numbers = inputs[len(tensors) :]


def _map_backward(ctx, grad_losses):
    grad_features, grad_decoder, grad_T = native.field_map_backward(grad_losses, *ctx.saved_tensors, *ctx.numbers)
    grad_T_wc = torch.nn.functional.pad(grad_T, (0, 0, 0, 1))
    by_place = {4: grad_T_wc, 6: grad_features, 10: grad_decoder}
    n_inputs = len(ctx.saved_tensors) + len(ctx.numbers)
    return tuple(by_place.get(k) for k in range(n_inputs))


torch.library.register_autograd("snh::field_map", _map_backward, setup_context=_map_context)


@torch.library.register_fake("snh::field_map")
def _(dirs_c, depth, color, frame_index, T_wc, uniforms, features, *rest):
    return features.new_empty(4)


@torch.library.register_fake("snh::field_map_")
def _(dirs_c, depth, color, frame_index, T_wc, uniforms, features, *rest):
    return features.new_empty(4)


@torch.library.register_fake("snh::field_map_backward")
def _(grad_losses, dirs_c, depth, color, frame_index, T_wc, uniforms, features, probe, keys, masks, decoder, *rest):
    return torch.empty_like(features), torch.empty_like(decoder), features.new_empty(T_wc.shape[0], 3, 4)


@torch.library.register_fake("snh::field_track")
def _(dirs_c, depth, T_wc, uniforms, features, *rest):
    R, S = uniforms.shape
    return features.new_empty(R, S), features.new_empty(R, S, 6), features.new_empty(R, S, dtype=torch.bool)


@torch.library.register_fake("snh::field_query")
def _(points, features, probe, keys, masks, decoder, *rest):
    n, with_color = points.shape[0], rest[-2]
    return points.new_empty(n), points.new_empty(n if with_color else 0, 3), points.new_empty(n, dtype=torch.bool)
