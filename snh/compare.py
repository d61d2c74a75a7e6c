"""`snh-slam eval`: a finished run or a trajectory against a reference."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from snh.datasets import Sequence, open_sequence
from snh.datasets.poses import read_tum
from snh.datasets.tum import associate
from snh.errors import DataError
from snh.eval.reconstruction import evaluate_reconstruction
from snh.eval.trajectory import ate, rpe
from snh.files import write_atomically
from snh.mesh import load_mesh

MAX_DIFFERENCE = 0.02  # s between a pose and its reference


def compare(estimate: Path, reference: Path, source: str | None, protocol: str, json_path: Path | None) -> int:
    """Prints the errors of `estimate` (a run's folder or a TUM file) against a trajectory, a recording or a mesh."""
    if reference.suffix.lower() in (".ply", ".glb", ".obj", ".stl"):
        figures = _mesh_errors(estimate, reference, source, protocol)
    else:
        figures = _trajectory_errors(_trajectory_file(estimate), reference)
    width = max(map(len, figures))
    for name, value in figures.items():
        print(f"  {name:<{width}}  {value:.3f}" if isinstance(value, float) else f"  {name:<{width}}  {value}")
    if json_path is not None:
        write_atomically(json_path, (json.dumps(figures, indent=2) + "\n").encode())
    return 0


def _trajectory_file(estimate: Path) -> Path:
    return estimate / "trajectory.txt" if estimate.is_dir() else estimate


def _trajectory_errors(estimate: Path, reference: Path) -> dict:
    times, T_est = read_tum(estimate)
    if reference.is_dir():
        times_ref, T_ref = _reference_of(open_sequence(reference))
    else:
        times_ref, T_ref = read_tum(reference)
    i, j = _paired(times, times_ref)
    absolute, relative = ate(T_est[i], T_ref[j]), rpe(T_est[i], T_ref[j])
    return {
        "ate_rmse_cm": absolute.rmse_cm,
        "ate_mean_cm": absolute.mean_cm,
        "ate_max_cm": absolute.max_cm,
        "rpe_cm": relative.translation_cm,
        "rpe_deg": relative.rotation_deg,
        "frames": int(np.isfinite(absolute.errors_cm).sum()),
        "frames_without_reference": len(times) - int(np.isfinite(absolute.errors_cm).sum()),
    }


def _mesh_errors(run: Path, reference: Path, source: str | None, protocol: str) -> dict:
    if source is None or not run.is_dir():
        raise DataError("to judge a mesh give the output folder of a run and its recording: --source RECORDING")
    sequence = open_sequence(source)
    times, T_est = read_tum(run / "trajectory.txt")
    times_ref, T_ref = _reference_of(sequence)
    i, j = _paired(times, times_ref)
    placed = load_mesh(run / "mesh.ply").transformed(ate(T_est[i], T_ref[j]).T_ref_est)
    return evaluate_reconstruction(placed, load_mesh(reference), sequence.camera, T_ref[j][::2], protocol)  # type: ignore[arg-type]


def _paired(times: np.ndarray, times_ref: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the poses that belong together, by time."""
    pairs = associate(times, times_ref, MAX_DIFFERENCE)
    if not pairs:
        raise DataError(f"no two poses are within {MAX_DIFFERENCE} s of each other; do both use the same clock?")
    i, j = np.array(pairs).T
    return i, j


def _reference_of(sequence: Sequence) -> tuple[np.ndarray, np.ndarray]:
    """Timestamps [N] s and reference poses [N, 4, 4] of a recording."""
    T_ref = sequence.reference()
    if T_ref is None:
        raise DataError(f"{sequence.name} has no reference poses")
    return np.array([sequence[k].timestamp for k in range(len(sequence))]), T_ref
