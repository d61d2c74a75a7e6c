"""Which pixels of a frame are used, and the rays through them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from snh.config import InputConfig
from snh.frame import Camera, Frame


class Rays(NamedTuple):
    """Rays of one or many frames; not differentiable."""

    dirs_c: Tensor  # [R, 3] directions in the camera frame, z = 1
    depth: Tensor  # [R] m
    color: Tensor  # [R, 3] in 0..1


def clean_depth(depth: np.ndarray, limits: InputConfig) -> np.ndarray:
    """Depth [H, W] m with every reading outside the sensor's range (or not finite) set to 0."""
    usable = (depth >= limits.depth_min) & (depth <= limits.depth_max)
    return np.where(usable, depth, np.float32(0))


def pick_pixels(
    depth: np.ndarray, n: int, rng: np.random.Generator, border: int = 0, edge_depth: float = 0.0
) -> np.ndarray:
    """At most n random pixels with depth, flat indices int64 [<= n].

    depth [H, W] m. Pixels within `border` of the image's edge are left out; with edge_depth > 0 so are pixels where a
    neighbour two pixels away has no reading or differs by more than edge_depth x depth.
    """
    height, width = depth.shape
    margin = max(border, 2 if edge_depth > 0 else 0)
    flat = depth.reshape(-1)
    picked: list[np.ndarray] = []
    missing = n
    for _ in range(4):  # draws; a sparse depth image simply gives fewer rays
        draws = missing + missing // 2 + 16
        v = rng.integers(margin, height - margin, draws)
        u = rng.integers(margin, width - margin, draws)
        index = v * width + u
        index = index[_usable(flat, index, width, edge_depth)][:missing]
        picked.append(index)
        missing -= len(index)
        if missing <= 0:
            break
    return np.concatenate(picked)


def _usable(flat: np.ndarray, index: np.ndarray, width: int, edge_depth: float) -> np.ndarray:
    d = flat[index]
    usable = d > 0
    if edge_depth > 0:
        for step in (2, -2, 2 * width, -2 * width):
            usable &= np.abs(flat[index + step] - d) <= edge_depth * d
    return usable


def make_rays(frame: Frame, depth: np.ndarray, pixels: np.ndarray) -> Rays:
    """Rays through flat pixel indices of a frame; depth [H, W] is the frame's cleaned depth."""
    return rays_of(
        frame.camera,
        pixels,
        depth.reshape(-1)[pixels],
        frame.rgb.reshape(-1, 3)[pixels],
    )


def rays_of(camera: Camera, pixels: np.ndarray, depth: np.ndarray, rgb: np.ndarray) -> Rays:
    """Rays through flat pixel indices [R] with depth [R] m and rgb [R, 3] uint8."""
    dirs_c = np.empty((len(pixels), 3), dtype=np.float32)
    dirs_c[:, 0] = (pixels % camera.width - camera.cx) / camera.fx
    dirs_c[:, 1] = (pixels // camera.width - camera.cy) / camera.fy
    dirs_c[:, 2] = 1
    color = rgb.astype(np.float32)
    color *= np.float32(1 / 255)
    return Rays(
        torch.from_numpy(dirs_c),
        torch.from_numpy(np.ascontiguousarray(depth, dtype=np.float32)),
        torch.from_numpy(color),
    )
