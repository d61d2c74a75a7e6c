"""A recording kept as pairs of image files; each layout only says which files, which camera, which poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from snh.datasets.calibration import Calibration
from snh.datasets.images import depth_in_metres, image_size, read_color, read_depth
from snh.datasets.registration import Registration, make_registration
from snh.datasets.sequence import FrameError
from snh.errors import DataError
from snh.frame import Camera, Frame

Key = TypeVar("Key", int, float, str)

FRAME_RATE = 30.0  # Hz, for layouts without timestamps


@dataclass(frozen=True)
class ReaderOptions:
    """What the user may say about the files: intrinsics as in calibration.parse_option, depth units per metre,
    largest difference of timestamps in s that still makes a pair (TUM layout only)."""

    intrinsics: str | Path | Sequence[float] | None = None
    depth_scale: float | None = None
    max_time_difference: float = 0.02

    def scale(self, calibration: Calibration, default: float) -> float:
        """Depth units per metre: the option, else the calibration file's, else that of the layout."""
        given = (self.depth_scale, calibration.depth_scale, default)
        scale = next(value for value in given if value is not None)
        if not 0 < scale < math.inf:
            raise DataError(
                f"depth_scale {scale} must be a positive number of units per metre, as 1000 for millimetres"
            )
        return scale


@dataclass(frozen=True)
class Pair:
    """The files of one frame and its time in s."""

    color: Path
    depth: Path
    timestamp: float


class Recording:
    """Sequence over pairs of image files that decodes one frame at a time."""

    def __init__(
        self, name: str, pairs: Sequence[Pair], calibration: Calibration, depth_scale: float,
        poses: np.ndarray | None = None,
    ):  # fmt: skip
        self.name = name
        self._pairs = pairs
        self._depth_scale = depth_scale
        self._poses = poses
        color_size, depth_size = image_size(pairs[0].color), image_size(pairs[0].depth)
        self.camera: Camera = calibration.depth.camera(*depth_size, f"the depth of {name}")
        self._register: Registration | None = None
        if calibration.color is not None:
            self._register = make_registration(calibration, self.camera, color_size, name)
        elif color_size != depth_size:
            raise DataError(
                f"colour ({color_size[0]} x {color_size[1]}) and depth ({depth_size[0]} x {depth_size[1]}) of {name} "
                "differ in size; give a calibration file with both cameras"
            )
        self._color_shape = (color_size[1], color_size[0])

    def __len__(self) -> int:
        return len(self._pairs)

    def __getitem__(self, index: int) -> Frame:
        pair = self._pairs[index]
        try:
            rgb, depth = self._read(pair)
        except DataError as error:
            raise FrameError(str(error), index) from error
        pose = None if self._poses is None else self._poses[index]
        T_wc_ref = pose if pose is not None and np.isfinite(pose).all() else None
        return Frame(index, pair.timestamp, rgb, depth, self.camera, T_wc_ref)

    def _read(self, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
        rgb, raw = read_color(pair.color), read_depth(pair.depth)
        for path, image, shape in (
            (pair.color, rgb, self._color_shape),
            (pair.depth, raw, (self.camera.height, self.camera.width)),
        ):
            if image.shape[:2] != shape:
                raise wrong_size(path, image.shape[1::-1], shape[::-1])
        depth = depth_in_metres(raw, self._depth_scale)
        if self._register is None:
            return rgb, depth
        rgb, seen = self._register(rgb, depth)
        # A pixel whose colour nobody measured is of no use to the map.
        return rgb, depth * seen

    def reference(self) -> np.ndarray | None:
        """Reference poses T_wc [N, 4, 4], rows of NaN where there is none; None without any."""
        return self._poses

    def files(self, index: int) -> tuple[Path, Path]:
        """(colour, depth) files of a frame."""
        return self._pairs[index].color, self._pairs[index].depth


def wrong_size(path: Path, size: Sequence[int], expected: Sequence[int]) -> DataError:
    return DataError(
        f"{path} has {size[0]} x {size[1]} pixels, but the images before it have {expected[0]} x {expected[1]}; "
        "use images of one size"
    )


def numbered_files(folder: Path, prefix: str, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Files prefix<number><suffix> of a folder by their number; empty if there is no such folder."""
    return {
        int(path.stem[len(prefix) :]): path
        for path in folder.glob(f"{prefix}*")
        if path.suffix.lower() in suffixes and path.stem[len(prefix) :].isdigit()
    }


def pair_by_key(color: Mapping[Key, Path], depth: Mapping[Key, Path], folder: Path) -> list[Key]:
    """Sorted keys of the frames that both mappings hold; raises DataError if one has what the other lacks."""
    if not color and not depth:
        raise DataError(f"{folder} holds no frames; choose the folder that holds the images")
    for key in sorted(set(color) ^ set(depth)):
        there, missing = (color[key], "depth") if key in color else (depth[key], "colour")
        raise DataError(f"{there} has no {missing} image of the same number; add it, or remove the file")
    return sorted(color)
