"""ScanNet's .sens file, version 4: a header, then per frame pose, times, JPEG colour and zlib uint16 depth."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from snh.datasets.calibration import Calibration, Intrinsics, parse_option
from snh.datasets.images import decode_color, depth_in_metres
from snh.datasets.recording import FRAME_RATE, ReaderOptions
from snh.datasets.registration import make_registration
from snh.datasets.sequence import FrameError
from snh.errors import DataError
from snh.frame import Frame

_VERSION = 4
_JPEG, _ZLIB = 2, 1  # the compressions that ScanNet uses


class _Entry(NamedTuple):
    """Where a frame lies in the file, bytes."""

    offset: int
    color_bytes: int
    depth_bytes: int
    timestamp: float
    T_wc: np.ndarray


class SensSequence:
    """Sequence over a .sens file. Opening reads the header and the index of frames only."""

    def __init__(self, path: Path, options: ReaderOptions):
        self.name = path.stem
        self._path = path
        try:
            with path.open("rb") as file:
                calibration, color_size, depth_size, count = _read_header(file, path)
                self._entries = _read_index(file, count)
        except (OSError, struct.error) as error:
            raise DataError(f"{path} is truncated or cannot be read ({error}); copy it again") from error
        if not self._entries:
            raise DataError(f"{path} holds no frames; copy it again")
        if options.intrinsics is not None:
            calibration = parse_option(options.intrinsics)
        self._color_shape, self._depth_shape = color_size[::-1], depth_size[::-1]
        self._depth_scale = options.scale(calibration, 1000)
        self.camera = calibration.depth.camera(*depth_size, f"the depth of {path}")
        self._register = make_registration(calibration, self.camera, color_size, str(path))

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, index: int) -> Frame:
        entry = self._entries[index]
        where = f"frame {index} of {self._path}"
        try:
            with self._path.open("rb") as file:
                file.seek(entry.offset)
                color_data, depth_data = file.read(entry.color_bytes), file.read(entry.depth_bytes)
            rgb = decode_color(color_data, f"the colour of {where}")
            raw = np.frombuffer(zlib.decompress(depth_data), np.uint16).reshape(self._depth_shape)
            if rgb.shape[:2] != self._color_shape:
                raise ValueError(f"colour of {rgb.shape[1]} x {rgb.shape[0]} pixels")
        except (OSError, zlib.error, ValueError, DataError) as error:
            raise FrameError(f"{where} is damaged ({error}); copy the file again", index) from error
        depth = depth_in_metres(raw, self._depth_scale)
        rgb, seen = self._register(rgb, depth)
        T_wc_ref = entry.T_wc if np.isfinite(entry.T_wc).all() else None
        return Frame(index, entry.timestamp, rgb, depth * seen, self.camera, T_wc_ref)

    def reference(self) -> np.ndarray | None:
        """Reference poses T_wc [N, 4, 4], rows of NaN where there is none; None without any."""
        poses = np.array([entry.T_wc for entry in self._entries])
        return poses if np.isfinite(poses).any() else None


def _read_header(file: BinaryIO, path: Path) -> tuple[Calibration, tuple[int, int], tuple[int, int], int]:
    """Both cameras, (width, height) of colour and of depth, number of frames."""
    version, name_bytes = struct.unpack("<IQ", file.read(12))
    if version != _VERSION:
        raise DataError(
            f"{path} has .sens version {version}, but only {_VERSION} is known; export it with ScanNet's tools"
        )
    file.seek(name_bytes, 1)
    matrices = np.reshape(struct.unpack("<64f", file.read(256)), (4, 4, 4))
    # The extrinsics (1 and 3) are identity in ScanNet: both cameras count as being at one place.
    color, depth = matrices[0], matrices[2]
    compressions = struct.unpack("<ii", file.read(8))
    if compressions != (_JPEG, _ZLIB):
        raise DataError(
            f"{path} is not compressed as JPEG and zlib (it says {compressions}); extract it to folders first"
        )
    color_width, color_height, depth_width, depth_height, scale, count = struct.unpack("<IIIIfQ", file.read(28))
    calibration = Calibration(_intrinsics(depth), _intrinsics(color), depth_scale=float(scale))
    return calibration, (color_width, color_height), (depth_width, depth_height), count


def _intrinsics(matrix: np.ndarray) -> Intrinsics:
    return Intrinsics(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])


def _read_index(file: BinaryIO, count: int) -> list[_Entry]:
    """The place of each frame; the image data is jumped over."""
    start = file.tell()
    end = file.seek(0, 2)
    file.seek(start)
    entries = []
    for number in range(count):
        T_wc = np.array(struct.unpack("<16f", file.read(64)))
        microseconds, _, color_bytes, depth_bytes = struct.unpack("<QQQQ", file.read(32))
        offset = file.tell()
        if offset + color_bytes + depth_bytes > end:
            raise struct.error(f"frame {number} of {count} ends past the end")
        if not np.isfinite(T_wc).all():
            T_wc[:] = np.nan
        timestamp = microseconds * 1e-6 if microseconds else number / FRAME_RATE
        entries.append(_Entry(offset, color_bytes, depth_bytes, timestamp, T_wc.reshape(4, 4)))
        file.seek(offset + color_bytes + depth_bytes)
    return entries
