"""The whole scene model: points to tsdf and colour."""

from torch import Tensor, nn

from snh.nn.decoder import Decoder, FrequencyEncoding
from snh.nn.encoding import PlaneHashEncoding
from snh.ops import HashTable
from snh.ops.field import FieldSpec


class SceneField(nn.Module):
    """Scene representation of section III-A: hashed planes, gamma and decoders (eq. 4 and 5).

    Calling it runs separate, twice differentiable ops, for losses of your own such as eikonal ones. The fused ops
    (`snh.ops.field_map` and others) give the same numbers faster from `features`, `table`, `decoder.weight`, `spec`.

    >>> import torch
    >>> field = SceneField(FieldSpec(cell_sizes=(0.1, 0.4)))
    >>> _ = field.encoding.allocate_box((0, 0, 0), (1, 1, 1))
    >>> points = torch.rand(10, 3, requires_grad=True)
    >>> tsdf, color = field(points)
    >>> normals, = torch.autograd.grad(tsdf.sum(), points, create_graph=True)
    >>> ((normals.norm(dim=-1) - 1) ** 2).mean().backward()
    """

    def __init__(self, spec: FieldSpec, seed: int = 0) -> None:
        super().__init__()
        self.spec = spec
        self.encoding = PlaneHashEncoding(spec.cell_sizes, spec.n_features)
        self.gamma = FrequencyEncoding(spec.n_octaves, spec.base_wavelength)
        self.decoder = Decoder(spec, seed)

    @property
    def table(self) -> HashTable:
        """Which vertices exist."""
        return self.encoding.table

    @property
    def features(self) -> nn.Parameter:
        """Feature rows [64 B, 4]."""
        return self.encoding.features

    def forward(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Points [..., 3] m, world -> tsdf [...] in truncation units, colour [..., 3] in 0..1."""
        return self.decoder(self.gamma(points), self.encoding(points))
