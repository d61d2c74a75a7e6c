"""Colour registered to depth: for each depth pixel, the colour of the point that it sees.

Pixel (u, v) with depth z projects to K_color (R r + t / z), r = K_depth^-1 (u, v, 1), with (R, t) = T_color_depth.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from snh.datasets.calibration import Calibration
from snh.frame import Camera

# (colour [Hc, Wc, 3] uint8, depth [H, W] float32 m) -> colour [H, W, 3] uint8 and where it was seen, bool [H, W]
Registration = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]

_HOLE_SCALE = 8  # holes in the depth are filled on an image smaller by this factor


def make_registration(
    calibration: Calibration, camera: Camera, color_size: tuple[int, int], where: str
) -> Registration:
    """The registration of colour images of size (width, height) to the depth camera; made once per recording."""
    color = calibration.color or calibration.depth
    lens = color.camera(*color_size, f"the colour of {where}")
    # A lookup mixes 2 x 2 pixels, so a much larger image is averaged down first, else it would alias.
    shrink = min(1.0, camera.width / lens.width)
    lens = lens.scaled(round(lens.width * shrink), round(lens.height * shrink))
    R, t = calibration.T_color_depth[:3, :3], calibration.T_color_depth[:3, 3]
    if not t.any():
        return FixedRegistration(lens, color.distortion, R, camera)
    undistort = FixedRegistration(lens, color.distortion, np.eye(3), lens)
    return DepthRegistration(undistort, lens, R, t, camera)


class FixedRegistration:
    """Both cameras at one place (t = 0): the lookup does not depend on depth, so one map serves all frames."""

    def __init__(self, lens: Camera, distortion: tuple[float, ...], R: np.ndarray, camera: Camera):
        self._lens_size = (lens.width, lens.height)
        # OpenCV's rotation leads from the lens to the new camera, ours the other way.
        u, v = cv2.initUndistortRectifyMap(
            _matrix(lens), np.array(distortion), R.T, _matrix(camera), (camera.width, camera.height), cv2.CV_32FC1
        )
        self._seen = _inside(u, v, lens)
        self._maps = cv2.convertMaps(u, v, cv2.CV_16SC2)
        self._same = lens == camera and not any(distortion) and np.array_equal(R, np.eye(3))

    def __call__(self, color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if color.shape[1::-1] != self._lens_size:
            color = cv2.resize(color, self._lens_size, interpolation=cv2.INTER_AREA)
        if self._same:
            return color, self._seen
        return cv2.remap(color, *self._maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), self._seen


class DepthRegistration:
    """Cameras apart: each pixel is looked up where its own depth puts it.

    A point that something nearer hides from the colour camera gets the colour of what hides it. Where the sensor's
    projector stands beyond the colour camera (Kinect), such pixels lie in the projector's shadow and have no depth.
    """

    def __init__(self, undistort: FixedRegistration, lens: Camera, R: np.ndarray, t: np.ndarray, camera: Camera):
        self._undistort = undistort
        self._lens = lens
        rays = camera.rays() @ (_matrix(lens) @ R).T.astype(np.float32)
        self._rays = [np.ascontiguousarray(rays[..., k]) for k in range(3)]
        self._shift = (_matrix(lens) @ t).astype(np.float32)

    def __call__(self, color: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        color, covered = self._undistort(color, depth)
        inverse_depth = _inverse_depth(depth)
        x, y, z = (ray + shift * inverse_depth for ray, shift in zip(self._rays, self._shift, strict=True))
        u, v = cv2.divide(x, z), cv2.divide(y, z)
        seen = _inside(u, v, self._lens) & (z > 0)
        if not covered.all():
            seen &= cv2.remap(covered.astype(np.uint8), u, v, cv2.INTER_NEAREST) > 0
        return cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), seen


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def _inside(u: np.ndarray, v: np.ndarray, camera: Camera) -> np.ndarray:
    """Whether (u, v) lies on a pixel of the camera's images, borders of half a pixel included."""
    return (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)


def _inverse_depth(depth: np.ndarray) -> np.ndarray:
    """1 / depth [H, W] float32; holes get the mean of their surroundings, so that the colour has no jump there."""
    valid = (depth > 0).astype(np.float32)
    inverse = cv2.divide(1.0, np.maximum(depth, 1e-6)) * valid
    height, width = depth.shape
    small = (max(1, width // _HOLE_SCALE), max(1, height // _HOLE_SCALE))
    total, count = (cv2.blur(cv2.resize(x, small, interpolation=cv2.INTER_AREA), (9, 9)) for x in (inverse, valid))
    overall = float(total.sum() / max(count.sum(), 1e-6))
    mean = np.where(count > 0.01, total / np.maximum(count, 0.01), np.float32(overall))
    return np.where(valid > 0, inverse, cv2.resize(mean, (width, height)))
