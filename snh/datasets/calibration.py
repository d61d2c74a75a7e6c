"""Cameras of a recording: intrinsics of depth and colour, how they are placed, and the files that say so."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from snh.errors import DataError
from snh.frame import Camera

FILE_NAMES = (
    "calibration.yaml", "calibration.yml", "calibration.json", "camera.yaml", "camera.yml", "camera.json",
    "cam_params.json", "camera_intrinsic.json", "intrinsics.json", "camera-intrinsics.txt", "intrinsics.txt",
    "calibration.txt",
)  # fmt: skip

_KNOWN_KEYS = {"depth", "color", "offset", "T_color_depth", "depth_scale"}


@dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera in pixels with OpenCV distortion (k1, k2, p1, p2, k3, ...); size 0 = not said."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 0
    height: int = 0
    distortion: tuple[float, ...] = ()

    def camera(self, width: int, height: int, where: str) -> Camera:
        """The camera of width x height images; raises DataError if the calibration is for another size."""
        if (self.width or width, self.height or height) != (width, height):
            raise DataError(
                f"the intrinsics of {where} are for {self.width} x {self.height} pixels, its images have "
                f"{width} x {height}; give intrinsics for the images as they are stored"
            )
        return Camera(width, height, self.fx, self.fy, self.cx, self.cy)

    def matrix(self) -> np.ndarray:
        """Camera matrix [3, 3] float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


@dataclass(frozen=True)
class Calibration:
    """Both cameras; `color` None = the colour image is registered to depth already.

    T_color_depth [4, 4] maps points of the depth camera to the colour camera, m; depth_scale in units per metre.
    """

    depth: Intrinsics
    color: Intrinsics | None = None
    T_color_depth: np.ndarray = field(default_factory=lambda: np.eye(4))
    depth_scale: float | None = None


def find_calibration(folder: Path, option: str | Path | Sequence[float] | None = None) -> Calibration | None:
    """The calibration that the option gives, else that of a file in `folder` or one level up, else None."""
    if option is not None:
        return parse_option(option)
    for place in (folder, folder.resolve().parent):
        for name in FILE_NAMES:
            if (place / name).is_file():
                return read_calibration(place / name)
    return None


def require_calibration(folder: Path, option: str | Path | Sequence[float] | None = None) -> Calibration:
    """Like find_calibration, but raises DataError if nothing says what the camera is."""
    calibration = find_calibration(folder, option)
    if calibration is None:
        raise DataError(
            f"the camera intrinsics of {folder} are missing: give intrinsics fx,fy,cx,cy, or put a calibration.yaml "
            "(or camera-intrinsics.txt, cam_params.json) into the folder or beside it"
        )
    return calibration


def parse_option(option: str | Path | Sequence[float]) -> Calibration:
    """A calibration from (fx, fy, cx, cy), the text "fx,fy,cx,cy" or the path of a calibration file."""
    if not isinstance(option, (str, Path)):
        return Calibration(_from_numbers([float(x) for x in option], "the intrinsics option"))
    if re.fullmatch(r"[\d.,eE+\- ]+", str(option)):
        return Calibration(_from_text(str(option), "the intrinsics option"))
    if not Path(option).is_file():
        raise DataError(f"intrinsics {option} is neither fx,fy,cx,cy nor a file; correct it")
    return read_calibration(Path(option))


def read_calibration(path: Path) -> Calibration:
    """A calibration file: YAML or JSON (see docs/datasets.md), or a text file with a matrix or fx fy cx cy."""
    try:
        text = path.read_text()
        if path.suffix == ".txt":
            return Calibration(_from_text(text, str(path)))
        content = json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, yaml.YAMLError) as error:
        raise DataError(f"{path} cannot be read as a calibration ({_first_line(error)}); correct the file") from error
    if not isinstance(content, Mapping):
        raise DataError(f"{path} holds no cameras; write depth: {{fx: ..., fy: ..., cx: ..., cy: ...}}")
    return _from_two_cameras(content, path) if "depth" in content else _from_one_camera(content, path)


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def _from_text(text: str, where: str) -> Intrinsics:
    try:
        numbers = [float(token) for token in text.replace(",", " ").split()]
    except ValueError as error:
        raise DataError(f"{where} holds something that is not a number; write fx fy cx cy or a matrix") from error
    return _from_numbers(numbers, where)


def _from_numbers(numbers: Sequence[float], where: str) -> Intrinsics:
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
    elif len(numbers) in (9, 16):
        K = np.reshape(numbers, (-1, 3 if len(numbers) == 9 else 4))
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    else:
        raise DataError(f"{where} holds {len(numbers)} numbers; write fx,fy,cx,cy or a 3 x 3 or 4 x 4 matrix")
    return _positive(Intrinsics(float(fx), float(fy), float(cx), float(cy)), where)


def _positive(intrinsics: Intrinsics, where: str) -> Intrinsics:
    values = (intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy)
    if not (np.isfinite(values).all() and intrinsics.fx > 0 and intrinsics.fy > 0):
        raise DataError(f"{where} gives fx, fy, cx, cy = {values}; use finite numbers with fx and fy above 0 pixels")
    return intrinsics


def _from_keys(content: Any, where: str) -> Intrinsics:
    """Keys fx, fy, cx, cy, or Open3D's intrinsic_matrix (by columns); w or width, h or height; distortion."""
    try:
        if "intrinsic_matrix" in content:
            intrinsics = _from_numbers(np.reshape(content["intrinsic_matrix"], (3, 3)).T.ravel().tolist(), where)
        else:
            intrinsics = _from_numbers([float(content[key]) for key in ("fx", "fy", "cx", "cy")], where)
        return replace(
            intrinsics,
            width=int(content.get("width", content.get("w", 0))),
            height=int(content.get("height", content.get("h", 0))),
            distortion=tuple(float(k) for k in content.get("distortion", ())),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{where} must give fx, fy, cx, cy as numbers ({_first_line(error)}); correct it") from error


def _from_one_camera(content: Mapping, path: Path) -> Calibration:
    """One camera for both images; distortion is that of the colour image, as in TUM RGB-D."""
    content = content.get("camera", content)
    color = _from_keys(content, str(path))
    scale = _scale(content.get("depth_scale", content.get("scale")), path)
    if not color.distortion:
        return Calibration(color, depth_scale=scale)
    return Calibration(replace(color, distortion=()), color, depth_scale=scale)


def _from_two_cameras(content: Mapping, path: Path) -> Calibration:
    unknown = sorted(set(content) - _KNOWN_KEYS)
    if unknown:
        raise DataError(f"{path} has the unknown key {unknown[0]}; known are {', '.join(sorted(_KNOWN_KEYS))}")
    depth = _from_keys(content["depth"], f"depth in {path}")
    if depth.distortion:
        raise DataError(f"{path} gives distortion for depth, which is not supported; undistort the depth images first")
    return Calibration(
        depth,
        _from_keys(content["color"], f"color in {path}") if "color" in content else None,
        _placement(content, path),
        _scale(content.get("depth_scale"), path),
    )


def _scale(value: Any, path: Path) -> float | None:
    try:
        return None if value is None else float(value)
    except (TypeError, ValueError) as error:
        raise DataError(f"{path} gives the depth scale {value!r}; write a number of units per metre") from error


def _placement(content: Mapping, path: Path) -> np.ndarray:
    if "T_color_depth" in content and "offset" in content:
        raise DataError(f"{path} gives both offset and T_color_depth; keep one")
    try:
        T = np.eye(4)
        T[:3, 3] = np.reshape(content.get("offset", (0, 0, 0)), 3)
        return (
            np.reshape(np.asarray(content["T_color_depth"], dtype=np.float64), (4, 4))
            if "T_color_depth" in content
            else T
        )
    except (TypeError, ValueError) as error:
        raise DataError(f"{path}: offset takes 3 numbers and T_color_depth 4 x 4; correct it") from error
