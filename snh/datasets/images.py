"""Image files to arrays. Damage is found here before the decoder sees it, because decoders print instead of raising."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np

from snh.errors import DataError

SUFFIXES = (".png", ".jpg", ".jpeg")

_PNG_START = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_TAIL = 4096  # bytes in which the end marker must lie: some writers append padding or notes after it
_ADVICE = "copy the file again, or remove the frame's colour and depth"


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header of a PNG or JPEG file, whose end is checked too; the pixels are not decoded."""
    try:
        with path.open("rb") as file:
            head = file.read(65536)
            file.seek(max(0, file.seek(0, 2) - _TAIL))
            tail = file.read()
    except OSError as error:
        raise _unreadable(path, error) from error
    _check_end(str(path), head, tail)
    return _size(path, head)


def read_color(path: Path) -> np.ndarray:
    """Colour image [H, W, 3] uint8 RGB."""
    return decode_color(_read(path), str(path))


def read_depth(path: Path) -> np.ndarray:
    """Raw depth image [H, W] uint16 in the file's own unit."""
    return decode_depth(_read(path), str(path))


def decode_color(data: bytes, where: str) -> np.ndarray:
    """Colour image [H, W, 3] uint8 RGB of an encoded PNG or JPEG. A rotation in the file's notes is ignored."""
    image = _decode(data, where, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def decode_depth(data: bytes, where: str) -> np.ndarray:
    """Raw depth image [H, W] uint16 of an encoded PNG."""
    image = _decode(data, where, cv2.IMREAD_UNCHANGED)
    if image.dtype != np.uint16 or image.ndim != 2:
        kind = f"{image.dtype.itemsize * 8}-bit with {1 if image.ndim == 2 else image.shape[2]} channels"
        raise DataError(f"{where} is {kind}, but depth must be a 16-bit PNG with one channel; export the raw depth")
    return image


def depth_in_metres(raw: np.ndarray, scale: float) -> np.ndarray:
    """Raw uint16 [H, W] with `scale` units per metre -> float32 m [H, W]; 0 and 65535 (saturated) become 0."""
    depth = raw.astype(np.float32)
    depth *= np.float32(1 / scale)
    depth[raw == 65535] = 0
    return depth


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise _unreadable(path, error) from error


def _decode(data: bytes, where: str, flags: int) -> np.ndarray:
    _check_end(where, data[:16], data[-_TAIL:])
    if data.startswith(_PNG_START):
        _check_png(where, data)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise DataError(f"{where} cannot be decoded as an image; {_ADVICE}")
    return image


def _unreadable(path: Path, error: OSError) -> DataError:
    return DataError(f"{path} cannot be read ({error.strerror}); {_ADVICE}")


def _check_end(where: str, head: bytes, tail: bytes) -> None:
    if not head:
        raise DataError(f"{where} is empty; {_ADVICE}")
    if not head.startswith((_PNG_START, _JPEG_START)):
        raise DataError(f"{where} is neither PNG nor JPEG; convert it")
    if (b"IEND" if head.startswith(_PNG_START) else _JPEG_END) not in tail:
        raise DataError(f"{where} is truncated; {_ADVICE}")


def _check_png(where: str, data: bytes) -> None:
    """Checks the length and the checksum of each chunk."""
    at = len(_PNG_START)
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        stored = data[at + 8 + length : at + 12 + length]
        if zlib.crc32(memoryview(data)[at + 4 : at + 8 + length]) != int.from_bytes(stored, "big"):
            break
        if kind == b"IEND":
            return
        at += 12 + length
    raise DataError(f"{where} is damaged (wrong checksum); {_ADVICE}")


def _size(path: Path, head: bytes) -> tuple[int, int]:
    if head.startswith(_PNG_START) and len(head) >= 24:
        return struct.unpack_from(">II", head, 16)
    at = 2
    while at + 9 < len(head):
        marker, length = head[at + 1], struct.unpack_from(">H", head, at + 2)[0]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame; the others are tables
            height, width = struct.unpack_from(">HH", head, at + 5)
            return width, height
        at += 2 + length
    raise DataError(f"{path} has a damaged header; {_ADVICE}")
