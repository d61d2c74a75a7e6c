"""Any folder with two folders of images, color (or rgb, image) and depth, or two lists of files, color.txt and
depth.txt; poses in traj.txt, poses.txt or a folder pose are optional. Files with the same number in their names
pair; lists pair line by line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from snh.datasets.calibration import require_calibration
from snh.datasets.images import SUFFIXES
from snh.datasets.poses import pick_rows, read_matrices, read_matrix_files
from snh.datasets.recording import FRAME_RATE, Pair, ReaderOptions, Recording, pair_by_key
from snh.datasets.sequence import Sequence
from snh.errors import DataError

LAYOUT = "color/ (or rgb/, image/) with depth/, or lists color.txt with depth.txt (generic)"

_COLOR_FOLDERS = ("color", "rgb", "image", "images", "colour")
_DEPTH_FOLDERS = ("depth", "depths")
_POSE_FILES = ("traj.txt", "poses.txt")
_POSE_FOLDERS = ("pose", "poses")
_DEPTH_SCALE = 1000


def matches(folder: Path) -> bool:
    """Whether the folder has this layout, or half of it."""
    return (folder / "color.txt").is_file() or _subfolder(folder, _COLOR_FOLDERS + _DEPTH_FOLDERS) is not None


def open_folder(folder: Path, options: ReaderOptions) -> Sequence:
    """The recording in a folder of this layout; frames are taken as 30 Hz."""
    files = _from_lists(folder) if (folder / "color.txt").is_file() else _from_folders(folder)
    pairs = [Pair(color, depth, n / FRAME_RATE) for n, (color, depth) in enumerate(files)]
    calibration = require_calibration(folder, options.intrinsics)
    poses = _poses(folder, pairs)
    return Recording(folder.resolve().name, pairs, calibration, options.scale(calibration, _DEPTH_SCALE), poses)


def _from_lists(folder: Path) -> list[tuple[Path, Path]]:
    color, depth = _read_list(folder / "color.txt"), _read_list(folder / "depth.txt")
    if len(color) != len(depth) or not color:
        raise DataError(
            f"{folder} lists {len(color)} colour and {len(depth)} depth images; "
            "list as many of each, the images of a pair on the same line"
        )
    return list(zip(color, depth, strict=True))


def _read_list(path: Path) -> list[Path]:
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}); write one image file a line") from error
    return [path.parent / line.strip() for line in lines if line.strip() and not line.startswith("#")]


def _from_folders(folder: Path) -> list[tuple[Path, Path]]:
    color_folder, depth_folder = _subfolder(folder, _COLOR_FOLDERS), _subfolder(folder, _DEPTH_FOLDERS)
    if color_folder is None or depth_folder is None:
        there, missing = ("depth", "colour") if color_folder is None else ("colour", "depth")
        raise DataError(f"{folder} has a folder of {there} but none of {missing} images; add color/ or depth/")
    color, depth = _images(color_folder), _images(depth_folder)
    color_numbers, depth_numbers = _by_number(color), _by_number(depth)
    if color_numbers is not None and depth_numbers is not None:
        return [(color_numbers[n], depth_numbers[n]) for n in pair_by_key(color_numbers, depth_numbers, folder)]
    color_names, depth_names = ({path.stem: path for path in paths} for paths in (color, depth))
    return [(color_names[name], depth_names[name]) for name in pair_by_key(color_names, depth_names, folder)]


def _images(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]


def _by_number(paths: list[Path]) -> dict[float, Path] | None:
    """Files by the last number in their name (12, 0012, 1305031102.175304); None if one has none or two share one."""
    numbers = [re.findall(r"\d+(?:\.\d+)?", path.stem) for path in paths]
    found = {float(number[-1]): path for number, path in zip(numbers, paths, strict=True) if number}
    return found if len(found) == len(paths) else None


def _subfolder(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_dir()), None)


def _poses(folder: Path, pairs: list[Pair]) -> np.ndarray | None:
    """Poses [N, 4, 4]: line n of a file is that of frame n, a file in a folder that of the depth image of its name."""
    for name in _POSE_FILES:
        if (folder / name).is_file():
            return pick_rows(read_matrices(folder / name), range(len(pairs)))
    pose_folder = _subfolder(folder, _POSE_FOLDERS)
    if pose_folder is None:
        return None
    return read_matrix_files(pose_folder / f"{pair.depth.stem}.txt" for pair in pairs)
