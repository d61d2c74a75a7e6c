"""ScanNet as extracted folders: color/0.jpg, depth/0.png, pose/0.txt (optional), intrinsic/intrinsic_depth.txt and
intrinsic_color.txt, in the folder or in its subfolder frames; or the .sens file itself (sens.py)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from snh.datasets.calibration import Calibration, parse_option, read_calibration, require_calibration
from snh.datasets.images import image_size
from snh.datasets.poses import read_matrix_files
from snh.datasets.recording import FRAME_RATE, Pair, ReaderOptions, Recording, numbered_files, pair_by_key
from snh.datasets.sens import SensSequence
from snh.datasets.sequence import Sequence

LAYOUT = "color/, depth/ and intrinsic/, or one .sens file (ScanNet)"

_DEPTH_SCALE = 1000


def matches(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (_frames_folder(folder) / "intrinsic").is_dir() or _sens_file(folder) is not None


def open_folder(folder: Path, options: ReaderOptions) -> Sequence:
    """The recording in a folder of this layout."""
    frames = _frames_folder(folder)
    sens = _sens_file(folder)
    if sens is not None and not (frames / "color").is_dir():
        return SensSequence(sens, options)
    color = numbered_files(frames / "color", "", (".jpg", ".jpeg", ".png"))
    depth = numbered_files(frames / "depth", "", (".png",))
    numbers = pair_by_key(color, depth, frames)
    pairs = [Pair(color[n], depth[n], n / FRAME_RATE) for n in numbers]
    poses = read_matrix_files(frames / "pose" / f"{pair.depth.stem}.txt" for pair in pairs)
    calibration = _calibration(frames, options, pairs[0])
    return Recording(folder.resolve().name, pairs, calibration, options.scale(calibration, _DEPTH_SCALE), poses)


def _frames_folder(folder: Path) -> Path:
    return folder / "frames" if (folder / "frames").is_dir() else folder


def _sens_file(folder: Path) -> Path | None:
    files = sorted(folder.glob("*.sens"))
    return files[0] if len(files) == 1 else None


def _calibration(folder: Path, options: ReaderOptions, pair: Pair) -> Calibration:
    """Both cameras, taken to stand at one place as ScanNet's own tools do; colour exported at the size of depth
    counts as registered."""
    if options.intrinsics is not None:
        return parse_option(options.intrinsics)
    depth, color = (folder / "intrinsic" / f"intrinsic_{kind}.txt" for kind in ("depth", "color"))
    if not depth.is_file():
        return require_calibration(folder)
    calibration = read_calibration(depth)
    if color.is_file() and image_size(pair.color) != image_size(pair.depth):
        calibration = replace(calibration, color=read_calibration(color).depth)
    return calibration
