"""Tracking: the pose of one frame against the map (section III-D). The map stays fixed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from snh import ops
from snh.config import Config
from snh.frame import Camera, Frame
from snh.geometry import inverse, se3_exp
from snh.nn import SceneField
from snh.slam.mapper import twist_gradient
from snh.slam.pyramid import Pyramid
from snh.slam.rays import Rays, make_rays, pick_pixels

SCHEDULE = (3, 3, 2, 2, 1, 0)  # level of the colour pyramid in each Gauss-Newton iteration; the last one stays


@dataclass(frozen=True)
class Tracked:
    """Pose of a frame and how well it fits the map."""

    T_wc: np.ndarray  # [4, 4]
    residual_cm: float  # median distance of the frame's surface points to the map's surface
    inlier_share: float  # of the surface points within half the band of the map's surface
    colors: Pyramid  # the frame's, for when it becomes a keyframe


@dataclass(frozen=True)
class Reference:
    """The newest keyframe, whose colours eq. 13 compares with."""

    colors: Pyramid
    T_wk: np.ndarray  # [4, 4]


@dataclass(frozen=True)
class Residuals:
    """Residuals of one pose and their derivatives with respect to a right twist."""

    surface: np.ndarray  # [R, S] m
    surface_jacobian: np.ndarray  # [R, S, 6]
    color: np.ndarray  # [R', 3]
    color_jacobian: np.ndarray  # [R', 3, 6]


class Tracker:
    """Finds the pose that minimises eq. 14 from an initial one."""

    def __init__(self, config: Config, field: SceneField, camera: Camera, rng: np.random.Generator):
        self.config = config.tracking
        self.sampling = config.sampling
        self.mapping = config.mapping
        self.field = field
        self.camera = camera
        self.rng = rng
        self.n_samples = max(1, round(self.config.density * self.sampling.n_surface))

    def track(self, frame: Frame, depth: np.ndarray, starts: list[np.ndarray], reference: Reference | None) -> Tracked:
        """Pose of the frame; depth [H, W] m is its cleaned depth, `starts` the initial poses to choose from."""
        config = self.config
        find = {"adam": self._adam, "gauss_newton": self._gauss_newton}[config.tracker]
        colors = Pyramid(frame.rgb, self.camera)
        rays, _ = self._draw(frame, depth, config.n_rays)
        T_wc = min(starts, key=lambda T: self._misfit(T, rays)) if len(starts) > 1 else starts[0]
        T_wc = find(frame, depth, colors, T_wc, reference)
        distance = np.abs(self._surface(T_wc, rays, np.full((len(rays.depth), 1), 0.5, np.float32))[0][:, 0])
        inside = distance < 0.5 * config.band
        return Tracked(T_wc, 100 * float(np.median(distance)), float(inside.mean()), colors)

    # --- eq. 14 by Adam, as in the paper ------------------------------------------------------------------------

    def _adam(
        self, frame: Frame, depth: np.ndarray, colors: Pyramid, T_wc: np.ndarray, reference: Reference | None
    ) -> np.ndarray:
        config = self.config
        m, v = np.zeros(6), np.zeros(6)
        for k in range(1, config.iterations + 1):
            rays, uniforms = self._draw(frame, depth, config.n_rays)
            if config.scheme == "standard":
                gradient = self._rerendering_gradient(T_wc, rays)
            else:
                gradient = self._gradient(self._residuals(T_wc, rays, uniforms, rays.color, reference, 0))
            m = self.mapping.beta1 * m + (1 - self.mapping.beta1) * gradient
            v = self.mapping.beta2 * v + (1 - self.mapping.beta2) * gradient * gradient
            m_hat, v_hat = m / (1 - self.mapping.beta1**k), v / (1 - self.mapping.beta2**k)
            T_wc = T_wc @ se3_exp(-config.learning_rate * m_hat / (np.sqrt(v_hat) + self.mapping.epsilon))
        return T_wc

    def _gradient(self, residuals: Residuals) -> np.ndarray:
        """Gradient [6] of eq. 14: mean of squares over the samples plus lambda_ct times the mean absolute colour."""
        r, J = residuals.surface, residuals.surface_jacobian
        gradient = 2 * np.einsum("rs,rsk->k", r, J) / max(r.size, 1)
        if residuals.color.size:
            sign = np.sign(residuals.color)
            gradient += self.config.lambda_color * np.einsum("rc,rck->k", sign, residuals.color_jacobian) / sign.size
        return gradient

    def _rerendering_gradient(self, T_wc: np.ndarray, rays: Rays) -> np.ndarray:
        """Gradient [6] of the mapping loss, eq. 11, with respect to this frame's pose alone (Table V, `standard`)."""
        sampling, mapping = self.sampling, self.mapping
        T = torch.from_numpy(T_wc[None].astype(np.float32)).requires_grad_()
        uniforms = self.rng.random((len(rays.depth), sampling.n_base + sampling.n_surface), dtype=np.float32)
        lambdas = (mapping.lambda_color, mapping.lambda_depth, mapping.lambda_free_space, mapping.lambda_surface)
        losses = ops.field_map(
            *rays, torch.zeros(len(rays.depth), dtype=torch.int32), T, torch.from_numpy(uniforms),
            self.field.features.detach(), self.field.table, self.field.decoder.weight.detach(), self.field.spec,
            sampling.n_base, sampling.n_surface, sampling.near, sampling.far,
        )  # fmt: skip
        (losses * torch.tensor(lambdas)).sum().backward()
        assert T.grad is not None
        return twist_gradient(T_wc[None], T.grad[:, :3].numpy().astype(np.float64))[0]

    # --- the same residuals by Gauss-Newton ---------------------------------------------------------------------

    def _gauss_newton(
        self, frame: Frame, depth: np.ndarray, colors: Pyramid, T_wc: np.ndarray, reference: Reference | None
    ) -> np.ndarray:
        """Damped, robust least squares on one draw of rays, until the step is negligible.

        Coarse to fine: the colours by SCHEDULE, with a quarter of the rays while they are coarse.
        """
        config = self.config
        rays, uniforms = self._draw(frame, depth, config.n_rays)
        n, directions = len(rays.depth), rays.dirs_c.numpy()
        for k in range(config.iterations):
            level = SCHEDULE[min(k, len(SCHEDULE) - 1)]
            if k == 0 or level != SCHEDULE[min(k, len(SCHEDULE)) - 1]:
                color = rays.color if level == 0 else torch.from_numpy(colors.sample(level, directions))
            subset = slice(0, n if level < 2 else max(1, n // 4))
            part = Rays(*(t[subset] for t in rays))
            H, g = self._normal_equations(
                self._residuals(T_wc, part, uniforms[subset], color[subset], reference, level)
            )
            step = np.linalg.solve(H + np.diag(1e-4 * np.diag(H) + 1e-9), -g)
            length = float(np.linalg.norm(step))
            T_wc = T_wc @ se3_exp(step * min(1.0, 0.1 / max(length, 1e-12)))
            if level == 0 and length < 2e-5:  # 0.02 mm: far below the noise of any sensor
                break
        return T_wc

    def _normal_equations(self, residuals: Residuals) -> tuple[np.ndarray, np.ndarray]:
        """H [6, 6] and g [6] of eq. 14 with robust weights (Geman-McClure on both terms), iteratively re-weighted."""
        config = self.config
        r, J = residuals.surface.reshape(-1), residuals.surface_jacobian.reshape(-1, 6)
        H, g = _weighted(r, J, config.robust_scale, 1 / max(len(r), 1))
        if residuals.color.size:
            c, Jc = residuals.color.reshape(-1), residuals.color_jacobian.reshape(-1, 6)
            # lambda |c| has the slope of lambda / (2 |c|) c^2; |c| is taken at the colour scale
            factor = config.lambda_color / (2 * config.color_scale * len(c))
            H_color, g_color = _weighted(c, Jc, config.color_scale, factor)
            H, g = H + H_color, g + g_color
        return H, g

    # --- residuals ----------------------------------------------------------------------------------------------

    def _draw(self, frame: Frame, depth: np.ndarray, n: int) -> tuple[Rays, np.ndarray]:
        pixels = pick_pixels(depth, n, self.rng, self.config.border, self.config.edge_depth)
        rays = make_rays(frame, depth, pixels)
        if self.n_samples == 1:  # one sample stands on the surface itself
            return rays, np.full((len(pixels), 1), 0.5, dtype=np.float32)
        return rays, self.rng.random((len(pixels), self.n_samples), dtype=np.float32)

    def _surface(self, T_wc: np.ndarray, rays: Rays, uniforms: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Surface residuals [R, S] m and Jacobian [R, S, 6]; samples outside the map count as no information."""
        residuals, jacobian, valid = ops.field_track(
            rays.dirs_c, rays.depth, torch.from_numpy(T_wc.astype(np.float32)), torch.from_numpy(uniforms),
            self.field.features.detach(), self.field.table, self.field.decoder.weight.detach(), self.field.spec,
            self.config.band,
        )  # fmt: skip
        return residuals.numpy(), jacobian.numpy() * valid.numpy()[..., None]

    def _residuals(
        self,
        T_wc: np.ndarray,
        rays: Rays,
        uniforms: np.ndarray,
        color: torch.Tensor,
        reference: Reference | None,
        level: int,
    ) -> Residuals:
        """Both terms of eq. 14; `color` [R, 3] are the rays' colours at a level of the pyramids."""
        surface, surface_jacobian = self._surface(T_wc, rays, uniforms)
        if reference is None or self.config.scheme == "surface_only" or self.config.lambda_color == 0:
            return Residuals(surface, surface_jacobian, np.zeros((0, 3)), np.zeros((0, 3, 6)))
        T_kc = inverse(reference.T_wk) @ T_wc
        image, camera = reference.colors.levels[level]
        difference, jacobian, valid = ops.interframe(  # eq. 13
            rays.dirs_c * rays.depth[:, None], color, torch.from_numpy(T_kc.astype(np.float32)),
            torch.from_numpy(image), (camera.fx, camera.fy, camera.cx, camera.cy),
        )  # fmt: skip
        seen = valid.numpy()
        return Residuals(surface, surface_jacobian, difference.numpy()[seen], jacobian.numpy()[seen])

    def _misfit(self, T_wc: np.ndarray, rays: Rays) -> float:
        """Mean surface distance of an initial pose, each clamped to the band."""
        part = Rays(*(t[:256] for t in rays))
        r, _ = self._surface(T_wc, part, np.full((len(part.depth), 1), 0.5, np.float32))
        return float(np.minimum(np.abs(r), self.config.band).mean())


def _weighted(r: np.ndarray, J: np.ndarray, scale: float, factor: float) -> tuple[np.ndarray, np.ndarray]:
    weight = factor / (1 + (r / scale) ** 2) ** 2
    Jw = J * weight[:, None]
    return (Jw.T @ J).astype(np.float64), (Jw.T @ r).astype(np.float64)
