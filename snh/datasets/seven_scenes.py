"""7-Scenes layout: frame-000000.color.jpg (or png), .depth.png, .pose.txt (optional) in one folder.

Colour of the original recordings is not registered to depth, and their files describe the depth camera alone. For
the Kinect of 7-Scenes (585, 585, 320, 240 at 640 x 480) the colour camera fitted to the recordings is built in;
other depth cameras count as registered unless a calibration file gives both cameras.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from snh.datasets.calibration import Calibration, Intrinsics, require_calibration
from snh.datasets.poses import read_matrix_files
from snh.datasets.recording import FRAME_RATE, Pair, ReaderOptions, Recording, pair_by_key
from snh.datasets.sequence import Sequence

LAYOUT = "frame-*.color.jpg|png with frame-*.depth.png (7-Scenes)"

KINECT_DEPTH = Intrinsics(585, 585, 320, 240)
KINECT_COLOR = Intrinsics(525, 525, 320, 240)
KINECT_OFFSET = (-0.025, 0.0, 0.0)  # m, point in the colour camera minus point in the depth camera; fitted to +-5 mm
_NAME = re.compile(r"frame-(\d+)\.(color|depth)\.(jpg|jpeg|png)")


def matches(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return any(next(folder.glob(f"frame-*.{kind}.*"), None) for kind in ("color", "depth"))


def open_folder(folder: Path, options: ReaderOptions) -> Sequence:
    """The recording in a folder of this layout."""
    found: dict[str, dict[int, Path]] = {"color": {}, "depth": {}}
    for path in folder.iterdir():
        if match := _NAME.fullmatch(path.name):
            found[match[2]][int(match[1])] = path
    numbers = pair_by_key(found["color"], found["depth"], folder)
    pairs = [Pair(found["color"][n], found["depth"][n], n / FRAME_RATE) for n in numbers]
    poses = read_matrix_files(
        pair.depth.with_name(pair.depth.name.replace(".depth.png", ".pose.txt")) for pair in pairs
    )
    calibration = with_kinect_color(require_calibration(folder, options.intrinsics))
    return Recording(folder.resolve().name, pairs, calibration, options.scale(calibration, 1000), poses)


def with_kinect_color(calibration: Calibration) -> Calibration:
    """Adds the colour camera of the 7-Scenes Kinect to its depth camera; other calibrations stay as they are."""
    if calibration.color is not None or replace(calibration.depth, width=0, height=0) != KINECT_DEPTH:
        return calibration
    T = np.eye(4)
    T[:3, 3] = KINECT_OFFSET
    return replace(calibration, color=KINECT_COLOR, T_color_depth=T)
