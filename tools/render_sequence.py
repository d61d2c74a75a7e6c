"""Renders a GLB scene along a camera path into a sequence of the Replica layout with exact depth and poses.

    python tools/render_sequence.py room.glb path.txt OUT [--frames 300] [--kinect] [--exposure] [--blur]

Written: results/frameNNNNNN.jpg, results/depthNNNNNN.png (uint16, 6553.5 per metre, 0 beyond 10 m),
traj.txt (camera to world, 16 numbers a line, OpenCV axes), cam_params.json, and mesh.ply, the scene itself.
A path has lines `index x y z qx qy qz qw` (camera to world, OpenCV axes), as TUM files have. It is turned so that
up is up in the scene and moved to where all of it keeps the required clearance and sees most of the room.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import trimesh
from glb_scene import GlbScene
from tqdm import tqdm

from snh.datasets.sensor import ColorSensor, DepthSensor, image_flow
from snh.errors import DataError, OutputError, SNHError
from snh.frame import Camera
from snh.geometry import rotation_from_quaternion

DEPTH_SCALE = 6553.5  # counts per metre
GRID = 0.1  # m, spacing of the positions at which a path is tried
AXES = np.concatenate([np.eye(3), -np.eye(3)])


def read_path(path: Path) -> np.ndarray:
    """Camera-to-world poses [N, 4, 4] of a text file of `index x y z qx qy qz qw`."""
    if not path.is_file():
        raise DataError(f"the camera path {path} does not exist")
    try:
        rows = np.loadtxt(path, ndmin=2)
    except ValueError as error:
        raise DataError(f"the camera path {path} is not a table of numbers: {error}") from error
    if rows.shape[1] != 8 or len(rows) == 0:
        raise DataError(
            f"the camera path {path} needs 8 numbers a line (index x y z qx qy qz qw), found {rows.shape[1]}"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    poses[:, :3, :3] = [rotation_from_quaternion(q) for q in rows[:, 4:]]
    return poses


def turn_upright(poses: np.ndarray, up: int) -> np.ndarray:
    """Poses turned by right angles so that what was up on average for the camera is axis `up`, centred on zero."""
    old_up = AXES[np.argmax(AXES @ -poses[:, :3, 1].mean(0))]
    new_up = np.eye(3)[up]
    if old_up @ new_up < -0.5:
        R = np.diag([1.0 if k == 0 else -1.0 for k in range(3)])
    elif old_up @ new_up > 0.5:
        R = np.eye(3)
    else:  # a quarter turn about the axis that is orthogonal to both
        axis = np.cross(old_up, new_up)
        R = np.outer(axis, axis) + np.outer(new_up, old_up) - np.outer(old_up, new_up)
    turned = poses.copy()
    turned[:, :3] = R @ poses[:, :3]
    turned[:, :3, 3] -= (turned[:, :3, 3].min(0) + turned[:, :3, 3].max(0)) / 2
    return turned


def yawed(poses: np.ndarray, up: int, angle: float) -> np.ndarray:
    """Poses turned about the vertical through zero by an angle in radians."""
    R = cv2.Rodrigues(np.eye(3)[up] * angle)[0]
    result = poses.copy()
    result[:, :3] = R @ poses[:, :3]
    return result


class ClearanceGrid:
    """Distance to the nearest surface on a grid over a scene; 0 where an axis ray leaves the scene."""

    def __init__(self, scene: GlbScene):
        self.low = scene.low + GRID / 2
        axes = [np.arange(lo, hi, GRID) for lo, hi in zip(self.low, scene.high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
        self.clearance = scene.distance(points)
        inside = np.flatnonzero(self.clearance.reshape(-1) > GRID)
        flat = points.reshape(-1, 3)[inside]
        enclosed = np.ones(len(inside), bool)
        for axis in AXES:
            enclosed &= scene.cast(flat, np.broadcast_to(axis, flat.shape)).hit
        self.clearance.reshape(-1)[np.setdiff1d(np.arange(points[..., 0].size), inside[enclosed])] = 0

    def of_path(self, offsets: np.ndarray) -> np.ndarray:
        """Least clearance [nx, ny, nz] of a path of offsets [N, 3] centred on each point of the grid."""
        result = np.full_like(self.clearance, np.inf)
        for shift in np.unique(np.rint(offsets / GRID).astype(int), axis=0):
            moved = np.zeros_like(result)
            to, source = zip(*(shifted(n, s) for n, s in zip(result.shape, shift, strict=True)), strict=True)
            moved[to] = self.clearance[source]
            np.minimum(result, moved, out=result)
        return result


def shifted(n: int, shift: int) -> tuple[slice, slice]:
    """Slices of an axis of n entries such that a[to] = b[source] reads b at +shift."""
    return slice(max(0, -shift), max(0, min(n, n - shift))), slice(max(0, shift), max(0, min(n, n + shift)))


def view_score(scene: GlbScene, poses: np.ndarray) -> float:
    """How much a path sees: share of rays that end between 0.5 and 5 m, plus the number of meshes seen / 100."""
    u, v = np.meshgrid(np.linspace(-0.55, 0.55, 16), np.linspace(-0.42, 0.42, 12))
    rays_c = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays_d = np.concatenate([rays_c @ T[:3, :3].T for T in poses])
    rays_o = np.repeat(poses[:, :3, 3], len(rays_c), axis=0)
    hits = scene.cast(rays_o, rays_d)
    good = ((hits.z > 0.5) & (hits.z < 5)).sum() / len(hits.hit)
    return float(good + len(np.unique(scene.mesh_of[hits.triangle])) / 100)


def fit_path(scene: GlbScene, poses: np.ndarray, clearance: float) -> np.ndarray:
    """Upright poses placed where they keep the clearance and see most, over four headings and all positions.

    Raises DataError with the reachable clearance where the path does not fit.
    """
    grid = ClearanceGrid(scene)
    best: tuple[float, np.ndarray] | None = None
    reachable = 0.0
    for heading in range(4):
        turned = yawed(poses, scene.up, heading * np.pi / 2)
        room = grid.of_path(turned[:, :3, 3])
        reachable = max(reachable, float(room.max()))
        fitting = np.argwhere(room >= clearance + GRID)  # GRID covers the rounding of positions to the grid
        for index in fitting[:: max(1, len(fitting) // 300)]:
            placed = turned.copy()
            placed[:, :3, 3] += grid.low + index * GRID
            score = view_score(scene, placed[:: max(1, len(placed) // 8)])
            if best is None or score > best[0]:
                best = score, placed
    if best is None:
        size = " x ".join(f"{e:.1f}" for e in np.ptp(poses[:, :3, 3], axis=0))
        raise DataError(
            f"the path ({size} m) does not fit into the scene with a clearance of {clearance:.2f} m; "
            f"about {max(0.0, reachable - GRID):.2f} m is reachable: lower --clearance or use --shrink"
        )
    return best[1]


@dataclass(frozen=True)
class Sensors:
    """What is done to exact frames; None leaves depth or colour as it is."""

    depth: DepthSensor | None = None
    color: ColorSensor | None = None

    def __call__(
        self, rgb: np.ndarray, depth: np.ndarray, camera: Camera, poses: np.ndarray, index: int
    ) -> tuple[np.ndarray, np.ndarray]:
        flow = None
        if self.color is not None:
            if self.color.shutter > 0:
                T_next = poses[index + 1] if index + 1 < len(poses) else poses[index]
                flow = image_flow(depth, camera, poses[index], T_next)
            rgb = self.color(rgb, index, flow)
        return rgb, depth if self.depth is None else self.depth(depth, camera, index)


def render_all(
    scene: GlbScene, camera: Camera, poses: np.ndarray, sensors: Sensors, jobs: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Colour and depth of every pose in order, a few frames at the same time."""

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        rgb, depth = scene.render(camera, poses[index])
        return sensors(rgb, depth, camera, poses, index)

    with ThreadPoolExecutor(jobs) as pool:
        yield from pool.map(frame, range(len(poses)))


def write_frame(folder: Path, index: int, rgb: np.ndarray, depth: np.ndarray) -> None:
    counts = np.where((depth > 0) & (depth <= 10), np.rint(depth * DEPTH_SCALE), 0).astype(np.uint16)
    done = cv2.imwrite(str(folder / f"frame{index:06d}.jpg"), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    done &= cv2.imwrite(str(folder / f"depth{index:06d}.png"), counts, [cv2.IMWRITE_PNG_COMPRESSION, 2])
    if not done:
        raise OutputError(f"frame {index} cannot be written to {folder}; check permissions and free space")


def write_layout(out: Path, scene: GlbScene, camera: Camera, poses: np.ndarray) -> None:
    """Everything but the images: poses, camera and the scene as a mesh."""
    (out / "results").mkdir(parents=True, exist_ok=True)
    np.savetxt(out / "traj.txt", poses.reshape(-1, 16), fmt="%.9f")
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    params = {"camera": {"w": camera.width, "h": camera.height, **intrinsics, "scale": DEPTH_SCALE}}
    (out / "cam_params.json").write_text(json.dumps(params, indent=2) + "\n")
    trimesh.Trimesh(scene.vertices, scene.faces.astype(np.int64), process=False).export(out / "mesh.ply")


def make_camera(size: str) -> Camera:
    try:
        width, height = (int(n) for n in size.split("x"))
    except ValueError:
        raise DataError(f"--size {size} is not WIDTHxHEIGHT, for example 640x480") from None
    if min(width, height) < 8:
        raise DataError(f"--size {size} is too small; use at least 8x8")
    focal = 525 * width / 640
    return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def parse(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="GLB file in metres")
    parser.add_argument("path", type=Path, help="lines of: index x y z qx qy qz qw")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument(
        "--size", default="640x480", help="image size (default 640x480); the focal length is 525/640 x width"
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--start", type=int, default=0, help="first line of the path to use")
    parser.add_argument("--stride", type=int, default=1, help="use every n-th line of the path")
    parser.add_argument(
        "--up", choices=["auto", "y", "z"], default="auto", help="the scene's vertical (auto: its smaller extent)"
    )
    parser.add_argument("--clearance", type=float, default=0.4, help="least distance of the camera to any surface, m")
    parser.add_argument("--shrink", type=float, default=1.0, help="scale of the path's positions")
    parser.add_argument("--kinect", action="store_true", help="depth as a Kinect measures it, and noise in the colour")
    parser.add_argument("--exposure", action="store_true", help="exposure and white balance drift")
    parser.add_argument("--blur", action="store_true", help="motion blur")
    parser.add_argument("--seed", type=int, default=0, help="of the noise")
    parser.add_argument("--jobs", type=int, default=2, help="frames rendered at the same time")
    return parser.parse_args(argv)


def sensors_of(args: argparse.Namespace) -> Sensors:
    color = ColorSensor(
        args.seed,
        exposure=0.15 if args.exposure else 0.0,
        shutter=0.3 if args.blur else 0.0,
        noise=2.0 if args.kinect else 0.0,
    )
    changed = args.kinect or args.exposure or args.blur
    return Sensors(DepthSensor(args.seed) if args.kinect else None, color if changed else None)


def main(argv: list[str] | None = None) -> None:
    args = parse(argv)
    camera = make_camera(args.size)
    poses = read_path(args.path)[args.start :: args.stride][: args.frames]
    if len(poses) == 0:
        raise DataError(f"--start {args.start} is past the end of the camera path {args.path}")
    scene = GlbScene(args.scene, args.up)
    upright = turn_upright(poses, scene.up)
    upright[:, :3, 3] *= args.shrink
    poses = fit_path(scene, upright, args.clearance)
    write_layout(args.out, scene, camera, poses)
    frames = render_all(scene, camera, poses, sensors_of(args), args.jobs)
    for index, (rgb, depth) in enumerate(tqdm(frames, total=len(poses))):
        write_frame(args.out / "results", index, rgb, depth)


if __name__ == "__main__":
    try:
        main()
    except SNHError as error:
        sys.exit(f"render_sequence: {error}")
