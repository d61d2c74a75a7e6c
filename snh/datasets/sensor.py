"""What a Kinect-like sensor makes of exact depth and colour. Seed and frame index determine every pixel."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from snh.frame import Camera


@dataclass(frozen=True)
class DepthSensor:
    """Structured light as in the first Kinect.

    Axial noise is that of Nguyen et al. (3DIMPVT 2012); disparity is measured in steps of 1/8 pixel with a focal
    length of 585 pixels and a baseline of 7.5 cm, whatever the size of the image. Outlines are torn. No
    reading (0): the projector's shadow beside near objects, surfaces at a grazing angle, all outside [near, far] m.
    """

    seed: int = 0
    near: float = 0.4
    far: float = 8.0
    focal: float = 585.0  # pixels
    baseline: float = 0.075  # m
    disparity_step: float = 1 / 8  # pixels
    lateral_px: float = 0.5  # standard deviation of the position of outlines
    edge_loss: float = 0.5  # share of pixels on outlines without a reading
    grazing_deg: tuple[float, float] = (75.0, 82.0)  # angles of incidence at which no and every reading is lost

    def __call__(self, depth: np.ndarray, camera: Camera, index: int) -> np.ndarray:
        """Exact z-depth [H, W] float32 m of frame `index` -> measured z-depth, 0 = no reading."""
        random = np.random.default_rng([self.seed, index])
        valid = depth > 0
        z = np.where(valid, depth, self.far + 1).astype(np.float32)
        edge = outlines(z)
        lost = ~valid | self._shadow(z, camera) | (edge & (random.random(z.shape, np.float32) < self.edge_loss))
        angle = np.degrees(incidence(z, camera))
        low, high = self.grazing_deg
        lost |= ~edge & (angle > low + (high - low) * random.random(z.shape, np.float32))
        z = self._torn(z, edge, random)
        z = z + random.standard_normal(z.shape, np.float32) * axial_sigma(z)
        z = self._quantised(z)
        lost |= (z < self.near) | (z > self.far)
        return np.where(lost, np.float32(0), z)

    def _torn(self, z: np.ndarray, edge: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Outline pixels take the depth of a pixel nearby."""
        v, u = np.nonzero(edge)
        shift = np.rint(random.standard_normal((2, len(u))) * self.lateral_px).astype(int)
        torn = z.copy()
        torn[v, u] = z[np.clip(v + shift[0], 0, z.shape[0] - 1), np.clip(u + shift[1], 0, z.shape[1] - 1)]
        return torn

    def _quantised(self, z: np.ndarray) -> np.ndarray:
        scale = self.focal * self.baseline / self.disparity_step
        return (scale / np.maximum(np.rint(scale / np.maximum(z, 0.05)), 1)).astype(np.float32)

    def _shadow(self, z: np.ndarray, camera: Camera) -> np.ndarray:
        """Pixels the projector does not light: its column for them is right of that of a pixel farther right."""
        column = np.arange(z.shape[1], dtype=np.float32) - np.float32(camera.fx * self.baseline) / z
        least_right = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
        return column > least_right + 0.5


def axial_sigma(z: np.ndarray) -> np.ndarray:
    """Standard deviation in metres of a reading at depth z."""
    return np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) ** 2


def outlines(z: np.ndarray) -> np.ndarray:
    """Pixels at steps in depth. 1/z is linear over the image of a plane, so its second difference shows the steps."""
    w = 1 / z
    bend = np.zeros_like(w)
    bend[:, 1:-1] = np.abs(w[:, 2:] + w[:, :-2] - 2 * w[:, 1:-1])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(w[2:] + w[:-2] - 2 * w[1:-1]))
    return bend > 0.02 * w


def incidence(z: np.ndarray, camera: Camera) -> np.ndarray:
    """Angle in radians [H, W] between the viewing ray and the surface's normal."""
    rays = camera.rays()
    points = rays * z[..., None]
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    lengths = np.linalg.norm(normal, axis=-1) * np.linalg.norm(rays, axis=-1)
    return np.arccos(np.clip(np.abs((normal * rays).sum(-1)) / np.maximum(lengths, 1e-12), 0, 1))


@dataclass(frozen=True)
class ColorSensor:
    """Exposure and white balance that drift over seconds, motion blur, and noise."""

    seed: int = 0
    exposure: float = 0.15  # largest relative change of brightness
    shutter: float = 0.3  # share of the time between frames during which the shutter is open
    noise: float = 2.0  # standard deviation of a grey level, of 255

    def __call__(self, rgb: np.ndarray, index: int, flow: np.ndarray | None = None) -> np.ndarray:
        """Image [H, W, 3] uint8 of frame `index` as the sensor delivers it.

        flow [H, W, 2] is the motion of the image in pixels per frame (see `image_flow`); without it nothing blurs.
        """
        random = np.random.default_rng([self.seed, index, 1])
        image = rgb.astype(np.float32) if flow is None else self._blurred(rgb, flow)
        image = image * self.gain(index) + random.standard_normal(rgb.shape, np.float32) * np.float32(self.noise)
        return np.clip(np.rint(image), 0, 255).astype(np.uint8)

    def gain(self, index: int) -> np.ndarray:
        """Gain of red, green and blue, [3]: three slow waves with phases from the seed."""
        phase = np.random.default_rng([self.seed, 2]).uniform(0, 2 * np.pi, (3, 3))
        wave = np.sin(index * np.array([0.021, 0.047, 0.083])[:, None] + phase) / 3
        common = wave[:, 0].sum()
        balance = wave.sum(0) - wave.sum(0).mean()
        return (1 + self.exposure * (0.8 * common + 0.1 * balance)).astype(np.float32)

    def _blurred(self, rgb: np.ndarray, flow: np.ndarray, taps: int = 7) -> np.ndarray:
        """Mean of the image along the flow while the shutter is open, centred on the frame's time."""
        v, u = np.mgrid[: rgb.shape[0], : rgb.shape[1]].astype(np.float32)
        total = np.zeros(rgb.shape, np.float32)
        for share in np.linspace(-0.5, 0.5, taps) * self.shutter:
            moved = (flow * np.float32(share)).astype(np.float32)
            total += cv2.remap(
                rgb, u + moved[..., 0], v + moved[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
        return total / taps


def image_flow(depth: np.ndarray, camera: Camera, T_wc: np.ndarray, T_wc_next: np.ndarray) -> np.ndarray:
    """Motion in pixels [H, W, 2] of each pixel of a frame to the next; pixels without depth count as 3 m away."""
    T = np.linalg.inv(T_wc_next) @ T_wc
    points = camera.rays() * np.where(depth > 0, depth, 3)[..., None]
    moved = points @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    moved[..., 2] = np.maximum(moved[..., 2], 0.05)
    return camera.project(moved) - camera.project(points)
