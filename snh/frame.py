"""One RGB-D observation and the camera that made it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np


@dataclass(frozen=True)
class Camera:
    """Pinhole camera. Pixel (u, v) = (column, row); the centre of the first pixel is (0, 0)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def rays(self, stride: int = 1) -> np.ndarray:
        """Directions with z = 1 of every stride-th pixel in the camera frame, float32 [H', W', 3]."""
        u = (np.arange(0, self.width, stride, dtype=np.float32) - np.float32(self.cx)) / np.float32(self.fx)
        v = (np.arange(0, self.height, stride, dtype=np.float32) - np.float32(self.cy)) / np.float32(self.fy)
        x, y = np.meshgrid(u, v)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def project(self, points_c: np.ndarray) -> np.ndarray:
        """Pixel coordinates (u, v) of points in the camera frame, [..., 3] m -> [..., 2]."""
        z = points_c[..., 2]
        return np.stack([points_c[..., 0] / z * self.fx + self.cx, points_c[..., 1] / z * self.fy + self.cy], axis=-1)

    def scaled(self, width: int, height: int) -> Camera:
        """The same camera after resizing its images to width x height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5, cy=(self.cy + 0.5) * sy - 0.5,
        )  # fmt: skip

    def cropped(self, border: int) -> Camera:
        """The same camera after cutting `border` pixels from each side."""
        return replace(
            self,
            width=self.width - 2 * border,
            height=self.height - 2 * border,
            cx=self.cx - border,
            cy=self.cy - border,
        )


@dataclass(frozen=True)
class Frame:
    """One RGB-D observation.

    rgb [H, W, 3] uint8, depth [H, W] float32 z-depth in metres (0 = no reading), timestamp in seconds,
    T_wc_ref [4, 4] float64 reference pose (camera to world) or None. The reference is for evaluation only.
    """

    index: int
    timestamp: float
    rgb: np.ndarray
    depth: np.ndarray
    camera: Camera
    T_wc_ref: np.ndarray | None = None
