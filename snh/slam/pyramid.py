"""Colour images at halved resolutions: a coarse one is smooth, so that registration finds its way from further off."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from snh.frame import Camera

N_LEVELS = 4  # full resolution, half, quarter, eighth


class Pyramid:
    """An image [H, W, 3] uint8 and its halves; level 0 is the image itself. Coarse levels are made when first used."""

    def __init__(self, rgb: np.ndarray, camera: Camera):
        self.rgb = rgb
        self.camera = camera

    @cached_property
    def levels(self) -> list[tuple[np.ndarray, Camera]]:
        """(image, its camera) of each level, finest first."""
        levels = [(np.ascontiguousarray(self.rgb), self.camera)]
        while len(levels) < N_LEVELS:
            image = halved(levels[-1][0])
            # an odd last row or column is dropped, so the camera is that of twice the new size, halved
            levels.append((image, half_camera(levels[-1][1], image.shape[1], image.shape[0])))
        return levels

    def sample(self, level: int, directions: np.ndarray) -> np.ndarray:
        """Colours in 0..1, [R, 3] float32, of a level where rays [R, 3] with z = 1 meet it, bilinear; at the border
        the nearest pixels."""
        image, camera = self.levels[level]
        u = np.clip(directions[:, 0] * camera.fx + camera.cx, 0, camera.width - 1.001)
        v = np.clip(directions[:, 1] * camera.fy + camera.cy, 0, camera.height - 1.001)
        i, j = u.astype(np.int64), v.astype(np.int64)
        a, b = (u - i)[:, None].astype(np.float32), (v - j)[:, None].astype(np.float32)
        flat, first, width = image.reshape(-1, 3), j * camera.width + i, camera.width
        upper = (1 - a) * flat[first] + a * flat[first + 1]
        lower = (1 - a) * flat[first + width] + a * flat[first + width + 1]
        return ((1 - b) * upper + b * lower) * np.float32(1 / 255)


def halved(image: np.ndarray) -> np.ndarray:
    """Mean of each 2 x 2 pixels, [H, W, 3] -> [H // 2, W // 2, 3] uint8, rounded."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    total = image[0:height:2, 0:width:2].astype(np.uint16)
    for row, column in ((0, 1), (1, 0), (1, 1)):
        total += image[row:height:2, column:width:2]
    return ((total + 2) >> 2).astype(np.uint8)


def half_camera(camera: Camera, width: int, height: int) -> Camera:
    """Camera of the image that `halved` makes: pixel (0, 0) is the mean of four, so its centre lies at (0.5, 0.5)."""
    return Camera(width, height, camera.fx / 2, camera.fy / 2, (camera.cx + 0.5) / 2 - 0.5, (camera.cy + 0.5) / 2 - 0.5)
