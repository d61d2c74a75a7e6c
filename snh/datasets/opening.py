"""One door to all layouts."""

from __future__ import annotations

from collections.abc import Sequence as AbstractSequence
from pathlib import Path

from snh.datasets import generic, replica, scannet, seven_scenes, tum
from snh.datasets.recording import ReaderOptions
from snh.datasets.sens import SensSequence
from snh.datasets.sequence import Sequence, View, make_view
from snh.errors import ConfigError, DataError

# In the order in which they are tried: the later ones ask for less.
FORMATS = {"7scenes": seven_scenes, "replica": replica, "tum": tum, "scannet": scannet, "generic": generic}


def open_sequence(
    source: str | Path, *, format: str = "auto",
    intrinsics: str | Path | AbstractSequence[float] | None = None, depth_scale: float | None = None,
    depth_max: float | None = None, max_time_difference: float = 0.02,
    start: int = 0, frames: int | None = None, stride: int = 1,
    resize: tuple[int, int] | None = None, crop: int = 0,
) -> View:  # fmt: skip
    """Opens a recording; nothing but the list of files, the poses and the first headers is read.

    source: a folder in one of FORMATS, a ScanNet .sens file, or "builtin", "builtin:2", "builtin:2:kinect", the
        scene that needs no files.
    format: one of FORMATS, or "auto" to recognise it.
    intrinsics: (fx, fy, cx, cy) in px, the text "fx,fy,cx,cy", or a calibration file; else a file in the folder says.
    depth_scale: units of the depth files per metre; depth_max: readings beyond so many m count as none.
    max_time_difference: s, largest one within a pair of colour and depth or pose (TUM layout only).
    start, frames, stride: which frames; resize: (width, height), then crop: pixels cut from each side.
    Raises DataError or ConfigError with one sentence. `check` looks further before a long run.
    """
    options = ReaderOptions(intrinsics, depth_scale, max_time_difference)
    if str(source).partition(":")[0] == "builtin":
        sequence = _open_builtin(str(source), options, None if frames is None else start + frames * stride)
    else:
        sequence = _open_files(Path(source), format, options)
    return make_view(sequence, start=start, frames=frames, stride=stride, resize=resize, crop=crop, depth_max=depth_max)


def _open_files(path: Path, format: str, options: ReaderOptions) -> Sequence:
    if format != "auto" and format not in FORMATS:
        raise ConfigError(f"format {format} is unknown; use auto, {', '.join(FORMATS)}")
    if not path.exists():
        raise DataError(f"{path} does not exist; give the folder of a recording, or builtin")
    if path.suffix == ".sens" and path.is_file():
        return SensSequence(path, options)
    if not path.is_dir():
        raise DataError(f"{path} is neither a folder nor a .sens file; give the folder of a recording")
    if next(path.iterdir(), None) is None:
        raise DataError(f"{path} is empty; give the folder that holds the images of a recording")
    if format != "auto":
        return FORMATS[format].open_folder(path, options)
    for layout in FORMATS.values():
        if layout.matches(path):
            return layout.open_folder(path, options)
    wanted = "; ".join(layout.LAYOUT for layout in FORMATS.values())
    raise DataError(f"{path} has none of the known layouts: {wanted}; give the folder that holds these")


def _open_builtin(source: str, options: ReaderOptions, frames: int | None) -> Sequence:
    """The built-in scene; its walk has no end, so it gets as many frames as are asked for."""
    if options.intrinsics is not None or options.depth_scale is not None:
        raise ConfigError("the builtin scene has its own camera; leave out intrinsics and depth_scale")
    from snh.datasets.builtin import BuiltinSequence  # needs the native library, which readers of files do not

    variant = source.partition(":")[2] or 0
    return BuiltinSequence(variant) if frames is None else BuiltinSequence(variant, n_frames=max(frames, 1))
