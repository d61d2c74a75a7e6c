"""A look at a recording before a long run, so that a fault is told at once and before anything is written."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from snh.datasets.images import image_size
from snh.datasets.recording import wrong_size
from snh.datasets.sequence import Sequence, View, image_files
from snh.errors import DataError
from snh.frame import Frame

_NEAREST_BELOW = 100.0  # m; no RGB-D camera sees as far
_FARTHEST_ABOVE = 0.05  # m; no RGB-D camera sees as near


def check(sequence: Sequence) -> None:
    """Raises DataError if a run over the sequence would make no sense.

    Reads the header and the end of every image file, and decodes the first, the middle and the last frame.
    """
    if len(sequence) < 2:
        raise DataError(f"{sequence.name} gives a single frame, from which no motion follows; use at least two frames")
    _check_files(image_files(sequence, i) for i in range(len(sequence)))
    unlimited = sequence.without_limit() if isinstance(sequence, View) else sequence
    for index in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        _check_depth(sequence.name, unlimited[index])
    if not sequence[0].depth.any():
        raise DataError(f"no depth of the first frame of {sequence.name} is nearer than depth_max; raise it")


def _check_files(files: Iterable[Iterable[Path]]) -> None:
    """All images readable to the end, all colour images of one size and all depth images of one size."""
    expected: list[tuple[int, int]] = []
    for frame in files:
        for kind, path in enumerate(frame):
            size = image_size(path)
            if len(expected) <= kind:
                expected.append(size)
            if size != expected[kind]:
                raise wrong_size(path, size, expected[kind])


def _check_depth(name: str, frame: Frame) -> None:
    """A first frame with depth, and distances that an RGB-D camera can measure."""
    readings = frame.depth[frame.depth > 0]
    if readings.size == 0:
        if frame.index == 0:
            raise DataError(
                f"the first frame of {name} has no valid depth, but the map starts there; choose a later start"
            )
        return
    nearest, farthest = float(np.min(readings)), float(np.max(readings))
    if nearest > _NEAREST_BELOW or farthest < _FARTHEST_ABOVE:
        raise DataError(
            f"depth of frame {frame.index} of {name} reaches from {nearest:.3g} to {farthest:.3g} m, so the depth "
            "scale is wrong; set depth_scale to the units of the depth files per metre, as 1000 for millimetres"
        )
