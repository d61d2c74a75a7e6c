"""What every recording looks like to the rest of the program."""

from __future__ import annotations

import math
from collections.abc import Sequence as AbstractSequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from snh.errors import ConfigError, DataError
from snh.frame import Camera, Frame


class Sequence(Protocol):
    """A finite recording: frames by number, one camera, perhaps reference poses."""

    @property
    def name(self) -> str:
        """Short name for folders and tables."""

    @property
    def camera(self) -> Camera:
        """Camera of every frame."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame:
        """Frame `index` (its `.index` too). Raises FrameError if this one frame is damaged, IndexError past the end."""

    def reference(self) -> np.ndarray | None:
        """Reference poses T_wc [N, 4, 4] float64, rows of NaN where there is none; None without any reference."""


class FrameError(DataError):
    """One damaged frame of a recording whose other frames may be good: a caller may skip `index` and go on."""

    def __init__(self, sentence: str, index: int):
        super().__init__(sentence)
        self.index = index


@dataclass(frozen=True)
class View:
    """Some frames of a sequence, resized to (width, height), then cut by `crop` pixels on each side.

    Readings beyond `depth_max` m become 0. Frames are numbered anew from 0 and keep their timestamps.
    """

    source: Sequence
    indices: range
    resize: tuple[int, int] | None = None
    crop: int = 0
    depth_max: float = math.inf

    @property
    def name(self) -> str:
        return self.source.name

    @property
    def camera(self) -> Camera:
        camera = self.source.camera.scaled(*self.resize) if self.resize else self.source.camera
        return camera.cropped(self.crop)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> Frame:
        try:
            frame = self.source[self.indices[index]]
        except FrameError as error:
            raise FrameError(str(error), index) from error
        rgb, depth = self._shape(frame.rgb, frame.depth)
        if self.depth_max < math.inf:
            depth = np.where(depth <= self.depth_max, depth, np.float32(0))
        return replace(frame, index=index, rgb=rgb, depth=depth, camera=self.camera)

    def _shape(self, rgb: np.ndarray, depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.resize:
            rgb = cv2.resize(rgb, self.resize, interpolation=cv2.INTER_AREA)
            # Mixing depth across an edge would invent points in mid-air; _EXACT takes the pixel nearest to the centre.
            depth = cv2.resize(depth, self.resize, interpolation=cv2.INTER_NEAREST_EXACT)
        if self.crop:
            inside = slice(self.crop, -self.crop)
            rgb, depth = np.ascontiguousarray(rgb[inside, inside]), np.ascontiguousarray(depth[inside, inside])
        return rgb, depth

    def reference(self) -> np.ndarray | None:
        poses = self.source.reference()
        return None if poses is None else poses[self.indices.start : self.indices.stop : self.indices.step]

    def files(self, index: int) -> AbstractSequence[Path]:
        """Image files that frame `index` is read from: (colour, depth), or none."""
        return image_files(self.source, self.indices[index])

    def without_limit(self) -> View:
        """The same frames with readings at any distance."""
        return replace(self, depth_max=math.inf)


def image_files(sequence: Sequence, index: int) -> AbstractSequence[Path]:
    """The files that a frame is read from, none for sequences that are not made of files."""
    files = getattr(sequence, "files", None)
    return files(index) if files else ()


def select_frames(sequence: Sequence, start: int, frames: int | None, stride: int) -> range:
    """Numbers of every `stride`-th frame from `start`, at most `frames` of them."""
    if start < 0 or stride < 1 or (frames is not None and frames < 1):
        raise ConfigError(f"start {start}, frames {frames}, stride {stride}: use start >= 0, frames >= 1, stride >= 1")
    if start >= len(sequence):
        raise DataError(f"{sequence.name} has {len(sequence)} frames; choose a start below that, not {start}")
    chosen = range(len(sequence))[start::stride]
    return chosen if frames is None else chosen[:frames]


def make_view(
    sequence: Sequence, *, start: int = 0, frames: int | None = None, stride: int = 1,
    resize: tuple[int, int] | None = None, crop: int = 0, depth_max: float | None = None,
) -> View:  # fmt: skip
    """The part of a sequence that the options ask for; raises ConfigError or DataError if nothing would be left."""
    if resize and min(resize) < 1:
        raise ConfigError(f"resize {resize}: use a width and a height of at least one pixel")
    width, height = resize or (sequence.camera.width, sequence.camera.height)
    if crop < 0 or 2 * crop >= min(width, height):
        raise ConfigError(
            f"crop {crop} leaves nothing of {width} x {height} pixels; use 0 to {(min(width, height) - 1) // 2}"
        )
    if depth_max is not None and not depth_max > 0:
        raise ConfigError(f"depth_max {depth_max}: use a distance above 0 m")
    indices = select_frames(sequence, start, frames, stride)
    return View(sequence, indices, resize, crop, math.inf if depth_max is None else depth_max)
