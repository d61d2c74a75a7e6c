"""Mapping: the field, the decoders and the poses of a window of keyframes, together (section III-C)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from snh import ops
from snh.config import Config
from snh.geometry import se3_exp
from snh.nn import SceneField
from snh.slam.keyframes import KeyframeLibrary


class FieldOptimizer:
    """Adam over the field: feature rows that have gradients, and the decoders. Its moments grow with the map."""

    def __init__(self, field: SceneField, beta1: float, beta2: float, epsilon: float):
        self.field = field
        self.betas = (beta1, beta2, epsilon)
        self.n_steps = 0
        self.grad_features = torch.zeros(0, 4)
        self.m_features, self.v_features = torch.zeros(0, 4), torch.zeros(0, 4)
        self.last_step = torch.zeros(0, dtype=torch.int32)
        self.touched = torch.zeros(0, dtype=torch.uint8)
        decoder = field.decoder.weight.detach()
        self.grad_decoder = torch.zeros_like(decoder)
        self.m_decoder, self.v_decoder = torch.zeros_like(decoder), torch.zeros_like(decoder)

    def grow(self) -> None:
        """Makes room for feature rows that the field has gained; what is there stays."""
        n_rows, n_bricks = self.field.features.shape[0], self.field.table.n_bricks
        for name in ("grad_features", "m_features", "v_features"):
            setattr(self, name, _grown(getattr(self, name), n_rows))
        for name in ("last_step", "touched"):
            setattr(self, name, _grown(getattr(self, name), n_bricks))

    @torch.no_grad()
    def step(self, rate_features: float, rate_decoder: float) -> None:
        self.n_steps += 1
        field, table = self.field, self.field.table
        ops.sparse_adam_(
            field.features, self.grad_features, self.m_features, self.v_features, self.last_step, self.touched,
            table.masks, self.n_steps, rate_features, *self.betas,
        )  # fmt: skip
        ops.adam_(
            field.decoder.weight,
            self.grad_decoder,
            self.m_decoder,
            self.v_decoder,
            self.n_steps,
            rate_decoder,
            *self.betas,
        )


def _grown(tensor: Tensor, n_rows: int) -> Tensor:
    """The tensor with zero rows appended; a view of storage that doubles, so that growing is rarely a copy."""
    if n_rows <= tensor.shape[0]:
        return tensor
    storage = tensor._base if tensor._base is not None else tensor
    if n_rows > storage.shape[0]:
        storage = torch.zeros(max(n_rows, 2 * storage.shape[0]), *tensor.shape[1:], dtype=tensor.dtype)
        storage[: tensor.shape[0]] = tensor
    return storage[:n_rows]


class PoseOptimizer:
    """Adam on right-multiplied se(3) increments of a window's poses; one lives as long as a mapping call."""

    def __init__(self, T_wc: np.ndarray, fixed: np.ndarray, config: Config):
        self.T_wc = T_wc.copy()  # [M, 4, 4]
        self.free = ~fixed  # [M]
        self.config = config.mapping
        self.m = np.zeros((len(T_wc), 6))
        self.v = np.zeros((len(T_wc), 6))
        self.n_steps = 0

    def step(self, grad_T_wc: np.ndarray, rate: float) -> None:
        """One step along the gradient [M, 3, 4] with respect to the entries of T_wc."""
        config = self.config
        grad = twist_gradient(self.T_wc, grad_T_wc)
        self.n_steps += 1
        self.m = config.beta1 * self.m + (1 - config.beta1) * grad
        self.v = config.beta2 * self.v + (1 - config.beta2) * grad * grad
        m = self.m / (1 - config.beta1**self.n_steps)
        v = self.v / (1 - config.beta2**self.n_steps)
        update = -rate * m / (np.sqrt(v) + config.epsilon)
        self.T_wc[self.free] = self.T_wc[self.free] @ se3_exp(update[self.free])


def twist_gradient(T_wc: np.ndarray, grad_T_wc: np.ndarray) -> np.ndarray:
    """Gradient with respect to a right twist (rho, phi) at zero, [M, 6], from that of the entries of T_wc [M, 3, 4].

    T exp(twist) moves t by R rho and R by R skew(phi): with A = R^T dL/dR, dL/dphi = (A21 - A12, A02 - A20, A10 - A01).
    """
    R_t = np.swapaxes(T_wc[:, :3, :3], 1, 2)
    A = R_t @ grad_T_wc[:, :, :3]
    rho = (R_t @ grad_T_wc[:, :, 3:])[..., 0]
    phi = np.stack([A[:, 2, 1] - A[:, 1, 2], A[:, 0, 2] - A[:, 2, 0], A[:, 1, 0] - A[:, 0, 1]], axis=-1)
    return np.concatenate([rho, phi], axis=-1)


class Mapper:
    """Minimises eq. 11 over rays of a window of keyframes."""

    def __init__(self, config: Config, field: SceneField, keyframes: KeyframeLibrary, rng: np.random.Generator):
        self.config = config
        self.field = field
        self.keyframes = keyframes
        self.rng = rng
        mapping = config.mapping
        self.optimizer = FieldOptimizer(field, mapping.beta1, mapping.beta2, mapping.epsilon)
        self.lambdas = (
            mapping.lambda_color, mapping.lambda_depth, mapping.lambda_free_space, mapping.lambda_surface
        )  # fmt: skip

    def optimise(self, window: np.ndarray, n_iterations: int) -> np.ndarray:
        """Bundle adjustment over the window's keyframes: updates the field and the keyframes' poses.

        Keyframe 0 stays fixed. Returns the unweighted losses (colour, depth, free space, surface) of each iteration,
        [n_iterations, 4].
        """
        mapping, sampling = self.config.mapping, self.config.sampling
        self.optimizer.grow()
        poses = PoseOptimizer(self.keyframes.T_wc[window], window == 0, self.config)
        first = len(self.keyframes) == 1
        losses = np.zeros((n_iterations, 4))
        for k in range(n_iterations):
            rays, owner = self.keyframes.draw(window, mapping.n_rays)
            uniforms = self.rng.random((len(owner), sampling.n_base + sampling.n_surface), dtype=np.float32)
            grad_T_wc = torch.zeros(len(window), 3, 4)
            losses[k] = ops.field_map_(
                *rays, torch.from_numpy(owner), torch.from_numpy(poses.T_wc.astype(np.float32)),
                torch.from_numpy(uniforms), self.field.features.detach(), self.field.table,
                self.field.decoder.weight.detach(), self.field.spec,
                sampling.n_base, sampling.n_surface, sampling.near, sampling.far, self.lambdas,
                self.optimizer.grad_features, self.optimizer.touched, self.optimizer.grad_decoder, grad_T_wc,
            ).numpy()  # fmt: skip
            factor = mapping.first_learning_rate ** (1 - k / n_iterations) if first else 1.0
            self.optimizer.step(factor * mapping.learning_rate_features, factor * mapping.learning_rate_decoder)
            if not first:
                poses.step(grad_T_wc.numpy().astype(np.float64), mapping.learning_rate_pose)
        self.keyframes.T_wc[window] = poses.T_wc
        return losses
