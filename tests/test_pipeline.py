"""The ops together, as a user's own code has them: samples, look-up, a small network, rendering; eager and compiled."""

import pytest
import torch

from snh.ops import HashTable, hull_cells, plane_lookup, ray_render, ray_sample

CELL_SIZES = [0.1, 0.2, 0.4]


class Pipeline(torch.nn.Module):
    """Depth and colour of rays from learned features over the box [-1, 1]^3."""

    def __init__(self):
        super().__init__()
        corners = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        self.table = HashTable()
        self.table.insert(*hull_cells(corners, torch.zeros(3), CELL_SIZES))
        self.features = torch.nn.Parameter(0.1 * torch.randn(64 * self.table.n_bricks, 4))
        self.decoder = torch.nn.Sequential(torch.nn.Linear(9, 16), torch.nn.ReLU(), torch.nn.Linear(16, 4))

    def forward(self, rays_o, rays_d, depth, uniforms):
        z = ray_sample(depth, uniforms, n_base=8, n_surface=4, truncation=0.1)
        points = rays_o[:, None] + z[..., None] * rays_d[:, None]
        encoded, valid = plane_lookup(points.reshape(-1, 3), self.features, self.table, CELL_SIZES)
        decoded = self.decoder(encoded).reshape(*z.shape, 4)
        tsdf, color = decoded[..., 0], decoded[..., 1:].sigmoid()
        return *ray_render(tsdf, color, z, sharpness=10.0, cut_behind=0.1), valid


def rays(n_rays):
    g = torch.Generator().manual_seed(0)
    rays_d = torch.cat([torch.rand(n_rays, 2, generator=g) - 0.5, torch.ones(n_rays, 1)], 1)
    rays_o = torch.tensor([[0.0, 0.0, -0.9]]).repeat(n_rays, 1).requires_grad_()
    depth, uniforms = torch.rand(n_rays, generator=g) + 0.3, torch.rand(n_rays, 12, generator=g)
    return rays_o, rays_d, depth, uniforms


@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compiles_into_one_graph(backend):
    torch.manual_seed(0)
    pipeline, arguments = Pipeline(), rays(33)
    compiled = torch.compile(pipeline, fullgraph=True, backend=backend)
    results = []
    for run in (pipeline, compiled):
        color, depth, weight, valid = run(*arguments)
        loss = color.square().sum() + depth.square().sum()
        results.append([color, depth, weight, *torch.autograd.grad(loss, [arguments[0], *pipeline.parameters()])])
        assert valid.all()
    for eager, fused in zip(*results, strict=True):
        torch.testing.assert_close(fused, eager, rtol=1e-4, atol=1e-5)  # the compiler may reorder float32 sums


def test_normals_train_with_an_eikonal_loss():
    """Second derivatives reach the features through a network: the gradient norm of a random field is driven to one."""
    torch.manual_seed(0)
    pipeline = Pipeline()
    optimizer = torch.optim.Adam(pipeline.parameters(), lr=0.01)
    points = (torch.rand(500, 3) * 1.8 - 0.9).requires_grad_()
    errors = []
    for _ in range(60):
        encoded, _ = plane_lookup(points, pipeline.features, pipeline.table, CELL_SIZES)
        distance = pipeline.decoder(encoded)[:, 0]
        (normal,) = torch.autograd.grad(distance.sum(), points, create_graph=True)
        error = (normal.norm(dim=1) - 1).square().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[-1] < 0.1 * errors[0]
