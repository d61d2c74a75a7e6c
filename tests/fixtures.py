"""Writers of tiny recordings, each in the exact layout of its dataset."""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from snh.frame import Camera
from snh.geometry import quaternion_from_rotation, se3_exp

CAMERA = Camera(64, 48, 60.0, 61.0, 31.5, 24.0)
KINECT_MATRIX = "585 0 320\n0 585 240\n0 0 1\n"


@dataclass(frozen=True)
class Shot:
    """What one frame should read as: rgb [H, W, 3] uint8, depth [H, W] float32 m, T_wc [4, 4]."""

    rgb: np.ndarray
    depth: np.ndarray
    T_wc: np.ndarray


def make_shots(count: int = 5, camera: Camera = CAMERA) -> list[Shot]:
    """Smooth colours (JPEG keeps them within a few levels), a slanted wall with a hole, a path of small steps."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    shots = []
    for n in range(count):
        rgb = np.stack([40 + 2 * u + 5 * n, 200 - 2 * v, 90 + u], axis=-1).clip(0, 255).astype(np.uint8)
        depth = np.round(1000 + 10 * u + 20 * n).astype(np.float32) / 1000
        depth[5:9, 7:12] = 0
        shots.append(Shot(rgb, depth, se3_exp(np.array([0.02 * n, 0.01 * n, 0, 0, 0.03 * n, 0]))))
    return shots


def write_color(path: Path, rgb: np.ndarray) -> None:
    """RGB image as a file, JPEG at full quality."""
    path.parent.mkdir(parents=True, exist_ok=True)
    quality = [] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, 100]
    assert cv2.imwrite(str(path), rgb[..., ::-1], quality)


def write_depth(path: Path, depth: np.ndarray, scale: float) -> None:
    """Depth in m as a 16-bit PNG with `scale` units per metre."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.round(depth * scale).astype(np.uint16))


def write_7scenes(folder: Path, shots: list[Shot], camera: Camera = CAMERA, suffix: str = "jpg") -> Path:
    """frame-000000.color.jpg, .depth.png, .pose.txt and camera-intrinsics.txt."""
    for n, shot in enumerate(shots):
        write_color(folder / f"frame-{n:06d}.color.{suffix}", shot.rgb)
        write_depth(folder / f"frame-{n:06d}.depth.png", shot.depth, 1000)
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", shot.T_wc)
    np.savetxt(folder / "camera-intrinsics.txt", _matrix(camera))
    return folder


def write_replica(folder: Path, shots: list[Shot], camera: Camera = CAMERA, parameters_above: bool = True) -> Path:
    """results/frame000000.jpg, results/depth000000.png, traj.txt, and cam_params.json one level up or inside."""
    for n, shot in enumerate(shots):
        write_color(folder / f"results/frame{n:06d}.jpg", shot.rgb)
        write_depth(folder / f"results/depth{n:06d}.png", shot.depth, 6553.5)
    np.savetxt(folder / "traj.txt", [shot.T_wc.ravel() for shot in shots])
    keys = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    parameters = (folder.parent if parameters_above else folder) / "cam_params.json"
    parameters.write_text(json.dumps({"camera": {**keys, "scale": 6553.5}}))
    return folder


def write_tum(folder: Path, shots: list[Shot], delay: float = 0.004, period: float = 1 / 30) -> Path:
    """rgb.txt, depth.txt, groundtruth.txt and their images; depth and pose come `delay` s after colour."""
    comments = ["# three lines", "# of", "# comment"]
    lists: dict[str, list[str]] = {kind: comments.copy() for kind in ("rgb", "depth", "groundtruth")}
    for n, shot in enumerate(shots):
        time = 1305031102.0 + n * period
        late = time + delay
        write_color(folder / f"rgb/{time:.6f}.png", shot.rgb)
        write_depth(folder / f"depth/{late:.6f}.png", shot.depth, 5000)
        lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
        lists["depth"].append(f"{late:.6f} depth/{late:.6f}.png")
        numbers = " ".join(f"{x:.9f}" for x in (*shot.T_wc[:3, 3], *quaternion_from_rotation(shot.T_wc[:3, :3])))
        lists["groundtruth"].append(f"{late:.4f} {numbers}")
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_scannet(folder: Path, shots: list[Shot], camera: Camera = CAMERA) -> Path:
    """color/0.jpg, depth/0.png, pose/0.txt, intrinsic/*.txt."""
    for n, shot in enumerate(shots):
        write_color(folder / f"color/{n}.jpg", shot.rgb)
        write_depth(folder / f"depth/{n}.png", shot.depth, 1000)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{n}.txt", shot.T_wc)
    (folder / "intrinsic").mkdir()
    for kind in ("color", "depth"):
        np.savetxt(folder / f"intrinsic/intrinsic_{kind}.txt", _matrix4(camera))
        np.savetxt(folder / f"intrinsic/extrinsic_{kind}.txt", np.eye(4))
    return folder


def write_sens(path: Path, shots: list[Shot], camera: Camera = CAMERA) -> Path:
    """A .sens file, version 4, JPEG colour and zlib depth."""
    name = b"StructureSensor"
    matrices = (_matrix4(camera), np.eye(4), _matrix4(camera), np.eye(4))
    data = struct.pack("<IQ", 4, len(name)) + name + b"".join(_floats(matrix) for matrix in matrices)
    size = (camera.width, camera.height)
    data += struct.pack("<iiIIIIfQ", 2, 1, *size, *size, 1000.0, len(shots))
    for n, shot in enumerate(shots):
        color = cv2.imencode(".jpg", shot.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
        depth = zlib.compress(np.round(shot.depth * 1000).astype("<u2").tobytes())
        data += _floats(shot.T_wc) + struct.pack("<QQQQ", n * 33333, n * 33333, len(color), len(depth)) + color + depth
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data + struct.pack("<Q", 0))  # no IMU frames
    return path


def write_generic(folder: Path, shots: list[Shot], color_name: str = "color", scale: float = 1000) -> Path:
    """color/0000.jpg and depth/0000.png, no intrinsics, no poses."""
    for n, shot in enumerate(shots):
        write_color(folder / color_name / f"{n:04d}.jpg", shot.rgb)
        write_depth(folder / "depth" / f"{n:04d}.png", shot.depth, scale)
    return folder


def _matrix(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])


def _matrix4(camera: Camera) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = _matrix(camera)
    return result


def _floats(matrix: np.ndarray) -> bytes:
    return matrix.astype("<f4").tobytes()
