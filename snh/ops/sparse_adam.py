"""Adam for a growing feature table: a step costs what was seen, not what was ever mapped."""

import torch
from torch import Tensor

from snh.ops._library import native


def sparse_adam_(
    features: Tensor,  # [V, 4], V = 64 bricks; updated
    grad_features: Tensor,  # [V, 4]; zeroed where touched
    m: Tensor,  # [V, 4] first moment, updated
    v: Tensor,  # [V, 4] second moment, updated
    last_step: Tensor,  # [B] int32, 0 = never touched; updated
    touched: Tensor,  # [B] uint8, from `field_map_`; zeroed
    masks: Tensor,  # [B] int64, of the hash table
    step: int,  # from 1, one count for all bricks
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
) -> None:
    """One Adam step of the touched bricks; gradients to absent vertices are dropped.

    A brick that was skipped for k steps first has its moments decayed by beta^k, so they equal those of dense Adam
    with zero gradients in between; its features did not drift by momentum meanwhile. float32 or float64.

    Raises RuntimeError when shapes or dtypes do not fit or step is below 1.
    """
    native.sparse_adam_(features, grad_features, m, v, last_step, touched, masks, step, lr, beta1, beta2, eps)


def adam_(
    parameters: Tensor,  # [P], updated
    gradients: Tensor,  # [P]
    m: Tensor,  # [P] first moment, updated
    v: Tensor,  # [P] second moment, updated
    step: int,  # from 1
    lr: float,
    beta1: float = 0.9,
    beta2: float = 0.99,
    eps: float = 1e-15,
) -> None:
    """One step of torch.optim.Adam's rule on a flat tensor, in a single call. float32 or float64.

    Raises RuntimeError when shapes or dtypes do not fit or step is below 1.
    """
    native.adam_(parameters, gradients, m, v, step, lr, beta1, beta2, eps)


@torch.library.register_fake("snh::sparse_adam_")
def _(*arguments) -> None:
    return None


@torch.library.register_fake("snh::adam_")
def _(*arguments) -> None:
    return None
