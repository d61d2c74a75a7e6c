"""The built-in sequence: a furnished room defined in code, ray cast by the native core along a hand-held path.

No files; depth, poses and mesh are exact. The world is in metres with z up and the floor at z = 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from snh import _core
from snh.datasets.sensor import ColorSensor, DepthSensor, image_flow
from snh.errors import DataError
from snh.frame import Camera, Frame

FRAME_RATE = 30.0  # Hz


@dataclass(frozen=True)
class _Path:
    """One walk: mean position and swing of the position in m, headings in degrees, all smooth in the frame number."""

    room: int
    center: tuple[float, float, float]
    swing: tuple[float, float, float]
    rate: tuple[float, float, float]  # degrees per frame of the swing in x, y, z
    phase: tuple[float, float, float]  # degrees
    heading: tuple[float, float]  # degrees at frame 0 and degrees per frame
    sway: tuple[float, float, float]  # degrees added to the heading as a wave: size, degrees per frame, phase
    pitch: tuple[float, float, float]  # degrees below the horizon: mean, size of its wave, degrees per frame


_PATHS = (
    # Around the living room, looking across it.
    _Path(0, (-0.1, 0.1, 1.42), (1.15, 0.7, 0.07), (0.9, 0.9, 0.7), (90, 0, 0), (180, 0.9), (8, 1.7, 0), (17, 7, 1.1)),
    # Back and forth in the living room, looking to both sides.
    _Path(
        0, (0.0, 0.25, 1.38), (0.9, 0.5, 0.10), (0.6, 0.9, 0.8), (-60, 20, 0), (-35, 0), (120, 0.5, -80), (16, 8, 0.9)
    ),
    # Around the study, then back and forth in it.
    _Path(
        1, (0.1, 0.0, 1.36), (0.95, 0.75, 0.06), (0.9, 0.9, 0.7), (200, 110, 0), (290, 0.9), (8, 1.5, 40), (18, 7, 1.0)
    ),
    _Path(
        1, (0.1, 0.1, 1.40), (0.6, 0.6, 0.08), (0.7, 0.8, 0.9), (10, -40, 0), (100, 0), (125, 0.48, -75), (17, 8, 0.9)
    ),
)
N_VARIANTS = len(_PATHS)


def builtin_path(variant: int, n_frames: int) -> np.ndarray:
    """Camera-to-world poses [N, 4, 4] of a walk with the tremor of a hand; at most 3 cm and 1.5 degrees per frame."""
    path = _PATHS[variant]
    i = np.arange(n_frames, dtype=np.float64)
    wave = [np.sin(np.radians(r * i + p)) for r, p in zip(path.rate, path.phase, strict=True)]
    position = np.stack([c + s * w for c, s, w in zip(path.center, path.swing, wave, strict=True)], axis=1)
    size, rate, phase = path.sway
    heading = path.heading[0] + path.heading[1] * i + size * np.sin(np.radians(rate * i + phase))
    mean, size, rate = path.pitch
    pitch = -mean + size * np.sin(np.radians(rate * i))
    tremor = _tremor(i, variant)
    position += 0.006 * tremor[:, :3]
    heading, pitch, roll = (
        np.radians(a) for a in (heading + 0.3 * tremor[:, 3], pitch + 0.3 * tremor[:, 4], tremor[:, 5])
    )
    poses = np.tile(np.eye(4), (n_frames, 1, 1))
    poses[:, :3, :3] = _looking(heading, pitch, roll)
    poses[:, :3, 3] = position
    return poses


def _tremor(i: np.ndarray, seed: int) -> np.ndarray:
    """Six smooth curves [N, 6] of about unit size with periods of 0.7 to 3 seconds."""
    random = np.random.default_rng(seed)
    period, phase = random.uniform(0.7, 3.0, (4, 6)) * FRAME_RATE, random.uniform(0, 2 * np.pi, (4, 6))
    return np.sin(2 * np.pi * i[:, None, None] / period + phase).sum(1) / 2


def _looking(heading: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Rotations [N, 3, 3]; radians: heading from x toward y, pitch above the horizon, roll about the view."""
    forward = np.stack([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)], axis=1)
    level = np.stack([np.sin(heading), -np.cos(heading), np.zeros_like(heading)], axis=1)
    down = np.cross(forward, level)
    cos, sin = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([cos * level + sin * down, cos * down - sin * level, forward], axis=2)


@cache
def _room(number: int) -> _core.BuiltinRoom:
    """Rooms never change, and their light takes half a second to compute."""
    return _core.BuiltinRoom(number)


def _parse(text: str, noise: str) -> tuple[int, str]:
    """Variant and noise of "2", "2:kinect" or "kinect"."""
    number, _, given = text.rpartition(":") if not text.isdecimal() else (text, "", noise)
    if number and not number.isdecimal():
        raise DataError(f"the built-in sequence '{text}' is unknown; use builtin, builtin:2 or builtin:2:kinect")
    return int(number or 0), given


class BuiltinSequence:
    """Frames of a built-in room; the same arguments give the same frames.

    variant: 0 and 1 are two walks in a living room, 2 and 3 in a study; also as the text "2" or "2:kinect".
    noise: "none" gives exact depth and colour, "kinect" what such a sensor measures (see `snh.datasets.sensor`),
    drawn from `seed`. Raises DataError for what does not exist.

    >>> sequence = BuiltinSequence(n_frames=2, width=64, height=48)
    >>> sequence[1].depth.shape
    (48, 64)
    """

    def __init__(
        self,
        variant: int | str = 0,
        n_frames: int = 200,
        width: int = 640,
        height: int = 480,
        noise: str = "none",
        seed: int = 0,
    ):
        if isinstance(variant, str):
            variant, noise = _parse(variant, noise)
        if not 0 <= variant < N_VARIANTS:
            raise DataError(f"the built-in sequence has variants 0 to {N_VARIANTS - 1}, got {variant}")
        if noise not in ("none", "kinect"):
            raise DataError(f"the noise of the built-in sequence is 'none' or 'kinect', got '{noise}'")
        if n_frames < 1 or width < 8 or height < 8:
            raise DataError(
                f"the built-in sequence needs frames of at least 8x8 pixels, got {n_frames} of {width}x{height}"
            )
        focal = 525.0 * width / 640
        self.camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self.name = f"builtin-{variant}" + ("-kinect" if noise == "kinect" else "")
        self._poses = builtin_path(variant, n_frames + 1)  # the last one only for the blur of the frame before it
        self._room = _room(_PATHS[variant].room)
        self._noisy = noise == "kinect"
        self._depth_sensor, self._color_sensor = DepthSensor(seed), ColorSensor(seed)

    def __len__(self) -> int:
        return len(self._poses) - 1

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)}")
        T_wc = self._poses[index]
        rgb, depth = self.render(T_wc)
        if self._noisy:
            flow = image_flow(depth, self.camera, T_wc, self._poses[index + 1])
            rgb, depth = self._color_sensor(rgb, index, flow), self._depth_sensor(depth, self.camera, index)
        return Frame(index, index / FRAME_RATE, rgb, depth, self.camera, T_wc.copy())

    def render(self, T_wc: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Colour [H, W, 3] uint8 and exact z-depth [H, W] float32 m from any pose inside the room."""
        c = self.camera
        return self._room.render(T_wc, c.width, c.height, c.fx, c.fy, c.cx, c.cy)

    def reference(self) -> np.ndarray:
        """Exact camera-to-world poses, [N, 4, 4] float64."""
        return self._poses[: len(self)].copy()

    def ground_truth_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] float32 m and faces [T, 3] int32 of all surface that adjoins free space, front outward."""
        return self._room.mesh()

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Distance in metres [N] from points [N, 3] to the nearest surface, negative inside furniture or walls."""
        return self._room.signed_distance(points)
