"""sparse_adam: the moments of dense Adam, at the price of what was touched."""

import pytest
import torch

from snh.ops.field import adam_, sparse_adam_

RULE = dict(lr=0.01, beta1=0.9, beta2=0.99, eps=1e-15)
BOUND = {torch.float32: 2e-6, torch.float64: 1e-14}  # 10 steps of a few roundings each


class Table:
    """Features of `n_bricks` bricks with their optimiser state."""

    def __init__(self, n_bricks, dtype, masks=-1):
        generator = torch.Generator().manual_seed(0)
        self.masks = torch.full((n_bricks,), masks, dtype=torch.int64)
        self.features = torch.randn(n_bricks * 64, 4, generator=generator, dtype=dtype)
        self.grad, self.m, self.v = (torch.zeros_like(self.features) for _ in range(3))
        self.last_step = torch.zeros(n_bricks, dtype=torch.int32)
        self.touched = torch.zeros(n_bricks, dtype=torch.uint8)

    def step(self, step, gradients, bricks):
        rows = (bricks[:, None] * 64 + torch.arange(64)).flatten()
        self.grad[rows] = gradients[rows]
        self.touched[bricks] = 1
        sparse_adam_(
            self.features, self.grad, self.m, self.v, self.last_step, self.touched, self.masks, step, **RULE
        )  # fmt: skip


def dense_adam(parameters):
    return torch.optim.Adam([parameters], lr=RULE["lr"], betas=(RULE["beta1"], RULE["beta2"]), eps=RULE["eps"])


@pytest.mark.parametrize("n_bricks", [0, 1, 31, 32, 33, 300])
def test_all_touched_equals_torch(n_bricks, dtype):
    table = Table(n_bricks, dtype)
    dense = table.features.clone().requires_grad_()
    optimizer = dense_adam(dense)
    generator = torch.Generator().manual_seed(1)
    for step in range(1, 11):
        gradients = torch.randn(table.features.shape, generator=generator, dtype=dtype)
        table.step(step, gradients, torch.arange(n_bricks))
        dense.grad = gradients
        optimizer.step()
    torch.testing.assert_close(table.features, dense.detach(), rtol=0, atol=BOUND[dtype])
    assert not table.grad.any() and not table.touched.any() and (table.last_step == 10).all()


def test_skipped_rows_have_dense_moments(dtype):
    """A random half of the bricks at each step; compared where touched last."""
    table = Table(40, dtype)
    dense = table.features.clone().requires_grad_()
    optimizer = dense_adam(dense)
    generator = torch.Generator().manual_seed(2)
    for step in range(1, 11):
        bricks = torch.nonzero(torch.rand(40, generator=generator) < 0.5).flatten()
        gradients = torch.zeros_like(table.features)
        rows = (bricks[:, None] * 64 + torch.arange(64)).flatten()
        gradients[rows] = torch.randn(len(rows), 4, generator=generator, dtype=dtype)
        before = table.features.clone()
        table.step(step, gradients, bricks)
        dense.grad = gradients
        optimizer.step()
        untouched = torch.ones(len(before), dtype=torch.bool)
        untouched[rows] = False
        assert table.features[untouched].equal(before[untouched])
    state = optimizer.state[dense]
    torch.testing.assert_close(table.m[rows], state["exp_avg"][rows], rtol=0, atol=BOUND[dtype])
    torch.testing.assert_close(table.v[rows], state["exp_avg_sq"][rows], rtol=0, atol=BOUND[dtype])


def test_absent_vertices_stay_zero():
    table = Table(2, torch.float32, masks=0b101)
    table.features.view(2, 64, 4)[:, [1, *range(3, 64)]] = 0
    table.step(1, torch.ones_like(table.features), torch.tensor([1]))
    rows = table.features.view(2, 64, 4)[1]
    assert rows[[0, 2]].all() and not rows[[1, *range(3, 64)]].any()
    assert not table.m.view(2, 64, 4)[1, 1].any() and not table.grad.any()


@pytest.mark.parametrize("n", [0, 1, 31, 32, 33, 7000])
def test_adam_equals_torch(n, dtype):
    generator = torch.Generator().manual_seed(3)
    parameters = torch.randn(n, generator=generator, dtype=dtype)
    dense = parameters.clone().requires_grad_()
    optimizer = dense_adam(dense)
    m, v = torch.zeros_like(parameters), torch.zeros_like(parameters)
    for step in range(1, 11):
        gradients = torch.randn(n, generator=generator, dtype=dtype)
        adam_(parameters, gradients, m, v, step, **RULE)
        dense.grad = gradients
        optimizer.step()
    torch.testing.assert_close(parameters, dense.detach(), rtol=0, atol=BOUND[dtype])


def test_errors_name_the_argument():
    table = Table(2, torch.float32)
    with pytest.raises(RuntimeError, match=r"'step' counts from 1, got 0"):
        table.step(0, table.grad, torch.arange(2))
    table.m = table.m.double()
    with pytest.raises(RuntimeError, match=r"sparse_adam_: argument 'm' must be Float, got Double"):
        table.step(1, table.grad, torch.arange(2))
