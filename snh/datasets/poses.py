"""Reference poses from text files. They serve evaluation only, so a missing one is a row of NaN, not an error."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from snh.errors import DataError
from snh.geometry import rotation_from_quaternion


def read_table(path: Path) -> list[list[float]]:
    """Lines of numbers; empty lines and those that start with # are left out."""
    try:
        lines = path.read_text().splitlines()
        return [
            [_number(x) for x in line.replace(",", " ").split()] for line in lines if line.strip() and line[0] != "#"
        ]
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise DataError(f"{path} cannot be read as lines of numbers ({error}); correct or remove it") from error


def read_matrices(path: Path) -> np.ndarray:
    """Poses [N, 4, 4] of a file with 16 (4 x 4) or 12 (3 x 4) numbers a line."""
    rows = read_table(path)
    if any(len(row) not in (12, 16) for row in rows):
        raise DataError(
            f"{path} must hold 12 or 16 numbers a line, the rows of a camera-to-world matrix; correct or remove it"
        )
    return np.array([_matrix(row) for row in rows]).reshape(-1, 4, 4)


def read_matrix_files(paths: Iterable[Path]) -> np.ndarray | None:
    """Poses [N, 4, 4] of one 4 x 4 text file per frame, NaN where the file is missing; None if all are."""
    poses = [_read_matrix_file(path) if path.is_file() else np.full((4, 4), np.nan) for path in paths]
    return np.array(poses) if np.isfinite(poses).any() else None


def read_tum(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps [N] s and poses [N, 4, 4] of a file with lines `timestamp x y z qx qy qz qw`."""
    rows = read_table(path)
    if any(len(row) != 8 for row in rows):
        raise DataError(f"{path} must hold 8 numbers a line, timestamp x y z qx qy qz qw; correct or remove it")
    poses = np.full((len(rows), 4, 4), np.nan)
    for T, row in zip(poses, rows, strict=True):
        if np.isfinite(row).all() and any(row[4:]):
            T[:] = np.eye(4)
            T[:3, :3], T[:3, 3] = rotation_from_quaternion(np.array(row[4:])), row[1:4]
    return np.array([row[0] for row in rows]), poses


def pick_rows(poses: np.ndarray, rows: Sequence[int]) -> np.ndarray:
    """poses[rows] with NaN for rows past the end."""
    padded = np.concatenate([poses, np.full((1, 4, 4), np.nan)])
    return padded[[row if 0 <= row < len(poses) else -1 for row in rows]]


def _read_matrix_file(path: Path) -> np.ndarray:
    numbers = [x for row in read_table(path) for x in row]
    if len(numbers) not in (12, 16):
        raise DataError(f"{path} must hold a 4 x 4 camera-to-world matrix; correct or remove it")
    return _matrix(numbers)


def _matrix(numbers: Sequence[float]) -> np.ndarray:
    T = np.eye(4)
    T.flat[: len(numbers)] = numbers
    return T if np.isfinite(T).all() else np.full((4, 4), np.nan)


def _number(token: str) -> float:
    """float, also of the forms that old Windows programs print: 1.#QNAN, -1.#IND."""
    return float("nan") if "#" in token else float(token)
