"""From encoded points to tsdf and colour."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from snh.ops.field import FieldSpec


class FrequencyEncoding(nn.Module):
    """gamma(x) of eq. 5: sine and cosine of each coordinate at wavelengths of base_wavelength / 2^o metres.

    Wavelengths are metric and fixed: an open scene has no bound to normalise with. Per octave sin [3], then cos [3].

    >>> import torch
    >>> FrequencyEncoding(n_octaves=1, base_wavelength=4.0)(torch.tensor([0.0, 1.0, 2.0])).round(decimals=3).abs()
    tensor([0., 1., 0., 1., 0., 1.])
    """

    def __init__(self, n_octaves: int, base_wavelength: float) -> None:
        super().__init__()
        self.wave_numbers = [2 * math.pi * 2**octave / base_wavelength for octave in range(n_octaves)]  # 1/m

    def forward(self, points: Tensor) -> Tensor:
        """Points [..., 3] m -> [..., 6 n_octaves]."""
        parts = [f(k * points) for k in self.wave_numbers for f in (torch.sin, torch.cos)]
        return torch.cat(parts, dim=-1) if parts else points[..., :0]


class Decoder(nn.Module):
    """The two small networks of eq. 5: f_g -> tsdf and a geometry feature rho, f_c -> colour.

    All weights are one flat Parameter `weight` [P] in the order of `FieldSpec.decoder_views`, as the fused ops take
    it. It starts as nn.Linear does: uniform within 1 / sqrt(inputs), from the seed alone.

    >>> import torch
    >>> spec = FieldSpec(cell_sizes=(0.1, 0.2), n_octaves=2)
    >>> tsdf, color = Decoder(spec)(torch.zeros(5, spec.n_gamma), torch.zeros(5, 6))
    >>> tsdf.shape, color.shape
    (torch.Size([5]), torch.Size([5, 3]))
    """

    def __init__(self, spec: FieldSpec, seed: int = 0) -> None:
        super().__init__()
        self.spec = spec
        weight = torch.rand(spec.decoder_size, generator=torch.Generator().manual_seed(seed))
        views = spec.decoder_views(weight)
        for name, view in views.items():
            n_inputs = views[name.replace(".b", ".W")].shape[1]
            view.mul_(2).sub_(1).div_(n_inputs**0.5)
        self.weight = nn.Parameter(weight)

    def forward(self, gamma: Tensor, encoded: Tensor) -> tuple[Tensor, Tensor]:
        """gamma [..., 6 n_octaves], features [..., L*F] -> tsdf [...], colour [..., 3] in 0..1."""
        views = self.spec.decoder_views(self.weight)
        geometry = _perceptron(views, "geometry", torch.cat([gamma, encoded], dim=-1))
        color = _perceptron(views, "color", torch.cat([gamma, geometry[..., 1:]], dim=-1))
        return geometry[..., 0], color.sigmoid()


def _perceptron(views: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    """Two hidden layers with ReLU."""
    for layer in (1, 2):
        x = nn.functional.linear(x, views[f"{name}.W{layer}"], views[f"{name}.b{layer}"]).relu()
    return nn.functional.linear(x, views[f"{name}.W3"], views[f"{name}.b3"])
