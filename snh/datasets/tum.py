"""TUM RGB-D layout: rgb.txt and depth.txt (`timestamp file` a line), groundtruth.txt (optional).

Colour and depth come from one camera by the Kinect's own registration; only colour shows lens distortion.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from snh.datasets.calibration import Calibration, Intrinsics, find_calibration, require_calibration
from snh.datasets.poses import pick_rows, read_tum
from snh.datasets.recording import Pair, ReaderOptions, Recording
from snh.datasets.sequence import Sequence
from snh.errors import DataError

LAYOUT = "rgb.txt with depth.txt (TUM RGB-D)"

_DEPTH_SCALE = 5000
# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: fx fy cx cy, k1 k2 p1 p2 k3 of the colour cameras.
_CAMERAS = {
    "1": ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "2": ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "3": ((535.4, 539.2, 320.1, 247.6), ()),
}


def matches(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "rgb.txt").is_file()


def open_folder(folder: Path, options: ReaderOptions) -> Sequence:
    """The recording in a folder of this layout; each frame has the time of its colour image."""
    color_times, color = _read_list(folder / "rgb.txt")
    depth_times, depth = _read_list(folder / "depth.txt")
    matched = associate(color_times, depth_times, options.max_time_difference)
    if not matched:
        raise DataError(
            f"no colour image of {folder} has a depth image within {options.max_time_difference} s; "
            "raise max_time_difference, or correct rgb.txt and depth.txt"
        )
    pairs = [Pair(color[i], depth[j], float(color_times[i])) for i, j in matched]
    calibration = find_calibration(folder, options.intrinsics) or _camera_of_name(folder.resolve().name)
    if calibration is None:
        calibration = require_calibration(folder)
    poses = _reference(folder / "groundtruth.txt", [pair.timestamp for pair in pairs], options.max_time_difference)
    return Recording(folder.resolve().name, pairs, calibration, options.scale(calibration, _DEPTH_SCALE), poses)


def associate(first: np.ndarray, second: np.ndarray, max_difference: float) -> list[tuple[int, int]]:
    """Pairs (i, j) of times first[i], second[j] at most max_difference s apart, each used once, nearest pairs first.

    first [N] and second [M] ascending. The result is ascending in i.
    """
    low = np.searchsorted(second, first - max_difference, side="left")
    high = np.searchsorted(second, first + max_difference, side="right")
    candidates = [
        (abs(first[i] - second[j]), i, j) for i in range(len(first)) for j in range(int(low[i]), int(high[i]))
    ]
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in pairs and j not in taken:
            pairs[i] = j
            taken.add(j)
    return sorted(pairs.items())


def _camera_of_name(name: str) -> Calibration | None:
    """The camera of freiburg1, 2 or 3 (fr1, fr2, fr3) if the folder is called so."""
    match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?!\d)", name.lower())
    if match is None:
        return None
    numbers, distortion = _CAMERAS[match[1]]
    depth = Intrinsics(*numbers)
    return Calibration(depth, Intrinsics(*numbers, distortion=distortion) if distortion else None)


def _read_list(path: Path) -> tuple[np.ndarray, list[Path]]:
    """Times [N] s, ascending, and files of a list with `timestamp file` a line."""
    try:
        lines = [line.strip().split(maxsplit=1) for line in path.read_text().splitlines()]
        entries = sorted((float(line[0]), path.parent / line[1]) for line in lines if line and line[0][0] != "#")
    except (OSError, ValueError, IndexError) as error:
        raise DataError(f"{path} cannot be read as lines of timestamp and file name ({error}); correct it") from error
    return np.array([time for time, _ in entries]), [file for _, file in entries]


def _reference(path: Path, times: list[float], max_difference: float) -> np.ndarray | None:
    """Pose [N, 4, 4] nearest to each time, NaN if none is near enough; None without the file."""
    if not path.is_file():
        return None
    pose_times, poses = read_tum(path)
    if not len(pose_times):
        return None
    gaps = np.abs(pose_times[None] - np.array(times)[:, None])
    nearest = gaps.argmin(axis=1)
    near = gaps[np.arange(len(times)), nearest] <= max_difference
    return pick_rows(poses, np.where(near, nearest, -1).tolist())
