"""Keyframe pixel library and window policy (section III-C)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from snh.config import KeyframeConfig
from snh.frame import Camera, Frame
from snh.slam.rays import Rays, pick_pixels, rays_of


@dataclass(frozen=True)
class Views:
    """The viewing frusta of keyframes."""

    camera: Camera
    T_wc: np.ndarray  # [M, 4, 4]
    reach: np.ndarray  # [M] m, largest depth

    def contain(self, points: np.ndarray) -> np.ndarray:
        """Which points [N, 3] m lie inside a frustum, seen or hidden, made a tenth wider and deeper."""
        inside = np.zeros(len(points), dtype=bool)
        size = np.array([self.camera.width, self.camera.height])
        margin = 0.1 * size.max()
        for T_wc, reach in zip(self.T_wc, self.reach, strict=True):
            asked = np.nonzero(~inside)[0]
            points_c = (points[asked] - T_wc[:3, 3]) @ T_wc[:3, :3]
            ahead = (points_c[:, 2] > 0.01) & (points_c[:, 2] < 1.1 * reach)
            asked = asked[ahead]
            pixel = self.camera.project(points_c[ahead])
            inside[asked] = ((pixel > -margin) & (pixel < size + margin)).all(axis=1)
        return inside


class KeyframeLibrary:
    """A share of the pixels of every keyframe, and which keyframes a mapping call uses.

    `T_wc` [M, 4, 4] float64 are the keyframes' poses, corrected by bundle adjustment; `frame_index` their place in
    the sequence. Pixels are kept in 11 bytes each: flat pixel index, depth, colour.
    """

    def __init__(self, config: KeyframeConfig, camera: Camera, rng: np.random.Generator):
        self.config = config
        self.camera = camera
        self.rng = rng
        self.T_wc = np.empty((0, 4, 4))
        self.frame_index: list[int] = []
        self._pixels: list[np.ndarray] = []  # int32 [n]
        self._depth: list[np.ndarray] = []  # float32 [n], m
        self._rgb: list[np.ndarray] = []  # uint8 [n, 3]

    def __len__(self) -> int:
        return len(self.frame_index)

    def add(self, frame: Frame, depth: np.ndarray, T_wc: np.ndarray, edge_depth: float) -> int:
        """Keeps a share of the frame's pixels with depth; returns the keyframe's number."""
        n = max(1, round(self.config.pixel_share * np.count_nonzero(depth)))
        pixels = np.unique(pick_pixels(depth, n, self.rng, edge_depth=edge_depth))
        self._pixels.append(pixels.astype(np.int32))
        self._depth.append(depth.reshape(-1)[pixels])
        self._rgb.append(frame.rgb.reshape(-1, 3)[pixels])
        self.T_wc = np.concatenate([self.T_wc, T_wc[None]])
        self.frame_index.append(frame.index)
        return len(self) - 1

    def window(self) -> np.ndarray:
        """Keyframes of one mapping call, ascending; the newest is always the last.

        `window`: W = max(window, window_share of all): neighbour_share of them nearest in time, the others drawn from
        the earlier ones. `local` and `random` are Table VI's LBA and GBA-Vox; `all_rays` (GBA-Co) uses every keyframe.
        """
        n, config = len(self), self.config
        size = min(n, max(config.window, round(config.window_share * n)))
        if config.policy == "all_rays" or size == n:
            return np.arange(n)
        near = {"window": max(1, round(config.neighbour_share * size)), "local": size, "random": 1}[config.policy]
        drawn = self.rng.choice(n - near, size - near, replace=False)
        return np.concatenate([np.sort(drawn), np.arange(n - near, n)])

    def draw(self, keyframes: np.ndarray, n_rays: int) -> tuple[Rays, np.ndarray]:
        """About n_rays random library rays, shared equally by the keyframes, and each ray's place [R] in `keyframes`.

        With policy `all_rays` every library ray is equally likely instead, as in Co-SLAM, and the newest keyframe gets
        at least 100 rays.
        """
        counts = np.array([len(self._pixels[k]) for k in keyframes])
        if self.config.policy == "all_rays":
            share = np.floor(n_rays * counts / counts.sum()).astype(int)
            share[-1] = max(share[-1], min(100, n_rays))
        else:
            share = np.full(len(keyframes), n_rays // len(keyframes))
            share[: n_rays % len(keyframes)] += 1
        chosen = [self.rng.integers(0, count, m) for count, m in zip(counts, share, strict=True)]
        rays = rays_of(
            self.camera,
            np.concatenate([self._pixels[k][c] for k, c in zip(keyframes, chosen, strict=True)]),
            np.concatenate([self._depth[k][c] for k, c in zip(keyframes, chosen, strict=True)]),
            np.concatenate([self._rgb[k][c] for k, c in zip(keyframes, chosen, strict=True)]),
        )
        return rays, np.repeat(np.arange(len(keyframes), dtype=np.int32), share)

    def views(self) -> Views:
        """What the keyframes look at."""
        return Views(self.camera, self.T_wc.copy(), np.array([depth.max() for depth in self._depth]))

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for part in (self._pixels, self._depth, self._rgb) for a in part)
