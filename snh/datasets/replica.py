"""Replica layout: results/frame000000.jpg, results/depth000000.png, traj.txt (optional), cam_params.json there or
one level up."""

from __future__ import annotations

from pathlib import Path

from snh.datasets.calibration import require_calibration
from snh.datasets.poses import pick_rows, read_matrices
from snh.datasets.recording import FRAME_RATE, Pair, ReaderOptions, Recording, numbered_files, pair_by_key
from snh.datasets.sequence import Sequence

LAYOUT = "results/frame*.jpg|png with results/depth*.png (Replica)"

_DEPTH_SCALE = 6553.5


def matches(folder: Path) -> bool:
    """Whether the folder has this layout."""
    return (folder / "results").is_dir()


def open_folder(folder: Path, options: ReaderOptions) -> Sequence:
    """The recording in a folder of this layout. Line n of traj.txt belongs to the frame with number n."""
    results = folder / "results"
    color = numbered_files(results, "frame", (".jpg", ".jpeg", ".png"))
    depth = numbered_files(results, "depth", (".png",))
    numbers = pair_by_key(color, depth, results)
    pairs = [Pair(color[n], depth[n], n / FRAME_RATE) for n in numbers]
    trajectory = folder / "traj.txt"
    poses = pick_rows(read_matrices(trajectory), numbers) if trajectory.is_file() else None
    calibration = require_calibration(folder, options.intrinsics)
    return Recording(folder.resolve().name, pairs, calibration, options.scale(calibration, _DEPTH_SCALE), poses)
