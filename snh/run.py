"""What the command line does: a whole run with its files, the demo, meshing a finished run, comparing results."""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
import yaml
from tqdm import tqdm

from snh import ops
from snh.config import Config, MeshConfig
from snh.datasets import FrameError, Sequence, check, prefetch
from snh.datasets.builtin import BuiltinSequence
from snh.errors import OutputError
from snh.eval.reconstruction import evaluate_reconstruction
from snh.eval.trajectory import ate, write_tum
from snh.files import write_atomically
from snh.mesh import Mesh, candidate_blocks, extract_mesh, save_mesh
from snh.mesh.views import dollhouse_view, up_direction
from snh.nn import SceneField
from snh.slam import SLAM
from snh.slam.keyframes import Views
from snh.slam.map_file import load_map, save_map
from snh.viz import path_picture, render_mesh, save_png


@dataclass
class Run:
    """A SLAM run in progress: the system, what each frame was, and the clock."""

    slam: SLAM
    indices: list[int] = field(default_factory=list)  # of the frames that were used, in the sequence
    timestamps: list[float] = field(default_factory=list)
    skipped: dict[int, str] = field(default_factory=dict)  # frames that could not be read
    init_s: float = 0.0
    tracking_s: float = 0.0
    interrupted: bool = False


def run_sequence(
    sequence: Sequence, config: Config, out: Path, seed: int, threads: int | None, with_mesh: bool, quiet: bool
) -> int:
    """SLAM over a sequence; results in `out`. Returns the exit code: 0, or 130 after an interrupt."""
    check(sequence)
    prepare_output(out)
    run = track_sequence(sequence, config, seed, threads, quiet)
    metrics, _ = save_run(run, sequence, config, out, with_mesh)
    print(summary(metrics, out))
    return 130 if run.interrupted else 0


def run_demo(
    config: Config, out: Path, n_frames: int, seed: int, threads: int | None, with_mesh: bool, quiet: bool
) -> int:
    """SLAM in the built-in room, judged by its exact poses and surface."""
    sequence = BuiltinSequence(n_frames=n_frames)
    prepare_output(out)
    print(f"the built-in room: {len(sequence)} frames of {sequence.camera.width} x {sequence.camera.height} pixels")
    run = track_sequence(sequence, config, seed, threads, quiet)
    metrics, mesh = save_run(run, sequence, config, out, with_mesh)
    if mesh is not None and not run.interrupted:
        print("measuring the mesh against the exact surface")
        metrics.update(_against_truth(run, sequence, mesh))
        write_metrics(out, metrics)
    print(summary(metrics, out))
    return 130 if run.interrupted else 0


def _against_truth(run: Run, sequence: BuiltinSequence, mesh: Mesh) -> dict:
    """Errors of a mesh of the built-in room, moved to the room by the trajectory's alignment."""
    vertices, faces = sequence.ground_truth_mesh()
    truth = Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.zeros((len(vertices), 3), np.uint8))
    T_ref = sequence.reference()[run.indices]
    placed = mesh.transformed(ate(run.slam.trajectory(), T_ref).T_ref_est)
    return evaluate_reconstruction(placed, truth, sequence.camera, T_ref[::2])


def mesh_again(run: Path, voxel: float | None, out: Path | None) -> int:
    """Extracts the mesh of a finished run's map once more."""
    saved = load_map(run / "map.npz")
    config = saved.config if voxel is None else saved.config.updated({"mesh": {"voxel": voxel}}, "--voxel")
    path = out or run / "mesh.ply"
    mesh = mesh_of(saved.field, saved.views, config.mesh)
    save_mesh(mesh, path)
    print(f"  {len(mesh.vertices)} vertices, {len(mesh.faces)} faces in {path}")
    return 0


def prepare_output(out: Path) -> None:
    """Creates the output folder and proves that it can be written before any work is done."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(
            f"cannot write to the output folder {out}: {error.strerror}; choose another with -o"
        ) from error


def track_sequence(sequence: Sequence, config: Config, seed: int, threads: int | None, quiet: bool) -> Run:
    """Tracks and maps every frame; Ctrl-C ends after the frame in work."""
    torch.set_num_threads(threads or os.cpu_count() or 1)
    run = Run(SLAM(sequence.camera, config, seed))
    previous = _on_interrupt(run)
    interval = 0.2 if sys.stderr.isatty() else 10.0  # s; a log file gets few lines
    bar = tqdm(total=len(sequence), unit="frame", disable=quiet, dynamic_ncols=True, mininterval=interval)
    start = time.perf_counter()
    try:
        for item in prefetch(sequence, range(len(sequence))):
            bar.update()
            if isinstance(item, FrameError):
                run.skipped[item.index] = str(item)
                bar.write(f"frame {item.index} is skipped: {item}", file=sys.stderr)
                continue
            result = run.slam.step(item)
            run.indices.append(item.index)
            run.timestamps.append(item.timestamp)
            if result.status == "first":
                run.init_s = time.perf_counter() - start
            elif result.status != "ok":
                bar.write(f"frame {item.index}: {result.status}; {CONSEQUENCE[result.status]}", file=sys.stderr)
            bar.set_postfix_str(_state(run), refresh=False)
            if run.interrupted:
                break
    finally:
        signal.signal(signal.SIGINT, previous)
        bar.close()
    run.tracking_s = time.perf_counter() - start - run.init_s
    return run


CONSEQUENCE = {
    "no depth": "its pose is extrapolated and it is not mapped",
    "no colour": "it is tracked by its depth alone and not mapped",
    "lost": "its depth fits the map badly, so it is not mapped",
}


def _on_interrupt(run: Run):
    """First Ctrl-C: finish the frame and save everything. Second: Python's own KeyboardInterrupt."""

    def handler(signum, frame):
        run.interrupted = True
        signal.signal(signal.SIGINT, signal.default_int_handler)
        print("\ninterrupted: saving what there is (Ctrl-C again to drop it)", file=sys.stderr)

    return signal.signal(signal.SIGINT, handler)


def _state(run: Run) -> str:
    megabytes = run.slam.field.encoding.memory_bytes(occupied=True) / 1e6
    return f"keyframes {len(run.slam.keyframes)}, map {megabytes:.2f} MB"


def save_run(run: Run, sequence: Sequence, config: Config, out: Path, with_mesh: bool) -> tuple[dict, Mesh | None]:
    """Writes every result of a run to `out`; each file is complete or absent. Returns the metrics and the mesh."""
    slam = run.slam
    T_wc = slam.trajectory()
    reference = sequence.reference()
    T_ref = None if reference is None else reference[run.indices]
    write_tum(out / "trajectory.txt", np.array(run.timestamps), T_wc)
    write_atomically(out / "config.yaml", yaml.safe_dump(config.to_dict(), sort_keys=False).encode())
    write_atomically(out / "frames.csv", _frame_table(run).encode())
    save_map(out / "map.npz", slam)
    metrics = measure(run, T_wc, T_ref)
    write_metrics(out, metrics)
    draw_path(out / "path.png", T_wc, T_ref)

    mesh = None
    if with_mesh:
        mesh = mesh_of(slam.field, slam.keyframes.views(), config.mesh)
        save_mesh(mesh, out / "mesh.ply")
        save_mesh(mesh, out / "mesh.glb")
        draw_mesh(out / "mesh.png", mesh, T_wc)
        metrics["peak_rss_mb"] = peak_rss_mb()
        write_metrics(out, metrics)
    return metrics, mesh


def write_metrics(out: Path, metrics: dict) -> None:
    write_atomically(out / "metrics.json", (json.dumps(metrics, indent=2) + "\n").encode())


def mesh_of(field: SceneField, views: Views, config: MeshConfig) -> Mesh:
    """The coloured surface of a field."""
    spec, table = field.spec, field.table

    def query(points: np.ndarray, with_color: bool):
        answer = ops.field_query(
            torch.from_numpy(points), field.features.detach(), table, field.decoder.weight.detach(), spec, with_color
        )
        return tuple(tensor.numpy() for tensor in answer)

    blocks = candidate_blocks(table.brick_keys.numpy(), spec.cell_sizes[0], config.voxel)
    observed = views.contain if config.inside_views else None
    return extract_mesh(query, blocks, config.voxel, spec.truncation, observed=observed, min_faces=config.min_faces)


def draw_path(path: Path, T_wc: np.ndarray, T_ref: np.ndarray | None) -> None:
    """The path from above and, with a reference, its error per frame."""
    if T_ref is None or not np.isfinite(T_ref).all(axis=(1, 2)).any():
        save_png(path, path_picture(T_wc))
    else:
        error = ate(T_wc, T_ref)
        save_png(path, path_picture(error.T_ref_est @ T_wc, T_ref, error.errors_cm))


def draw_mesh(path: Path, mesh: Mesh, T_wc: np.ndarray) -> None:
    """The room from above and outside, walls towards the viewer left out."""
    if len(mesh.faces) == 0:
        return
    view = dollhouse_view(mesh, up_direction(mesh, T_wc))
    save_png(path, render_mesh(mesh, view.camera, view.T_wc, cull_back_faces=True))


def measure(run: Run, T_wc: np.ndarray, T_ref: np.ndarray | None) -> dict:
    """The figures of a run; `ate_rmse_cm` is null without reference poses."""
    results, encoding = run.slam.results, run.slam.field.encoding
    error = None if T_ref is None or not np.isfinite(T_ref).all(axis=(1, 2)).any() else ate(T_wc, T_ref)
    statuses = [r.status for r in results]
    residuals = [r.residual_cm for r in results if r.status == "ok"]
    return {
        "frames": len(results),
        "fps": (len(results) - 1) / run.tracking_s if len(results) > 1 else None,
        "init_s": run.init_s,
        "ate_rmse_cm": error and error.rmse_cm,
        "ate_max_cm": error and error.max_cm,
        "ate_frames": error and int(np.isfinite(error.errors_cm).sum()),
        "map_bytes_occupied": encoding.memory_bytes(occupied=True),
        "map_bytes_held": encoding.memory_bytes(occupied=False),
        "peak_rss_mb": peak_rss_mb(),
        "n_keyframes": len(run.slam.keyframes),
        "residual_cm": float(np.median(residuals)) if residuals else None,
        "frames_lost": statuses.count("lost"),
        "frames_without_depth": statuses.count("no depth"),
        "frames_without_colour": statuses.count("no colour"),
        "frames_unreadable": len(run.skipped),
        "interrupted": run.interrupted,
    }


def peak_rss_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _frame_table(run: Run) -> str:
    """frames.csv: what became of each frame."""
    lines = ["frame,timestamp,status,keyframe,residual_cm,inlier_share,track_ms,map_ms"]
    for result, timestamp in zip(run.slam.results, run.timestamps, strict=True):
        lines.append(
            f"{result.index},{timestamp:.6f},{result.status},{int(result.is_keyframe)},{result.residual_cm:.3f},"
            f"{result.inlier_share:.3f},{result.track_ms:.2f},{result.map_ms:.2f}"
        )
    return "\n".join(lines) + "\n"


def summary(metrics: dict, out: Path) -> str:
    """The table at the end of a run."""
    rows = [("frames", f"{metrics['frames']} ({metrics['n_keyframes']} keyframes)")]
    if metrics["ate_rmse_cm"] is not None:
        rows.append(("ATE RMSE", f"{metrics['ate_rmse_cm']:.2f} cm over {metrics['ate_frames']} frames"))
    rows += [(label, f"{metrics[key]:.2f}{unit}") for key, label, unit in RECONSTRUCTION if key in metrics]
    if metrics["fps"] is not None:
        rows.append(("speed", f"{metrics['fps']:.1f} frames/s, first frame {metrics['init_s']:.1f} s"))
    occupied, held = metrics["map_bytes_occupied"] / 1e6, metrics["map_bytes_held"] / 1e6
    rows.append(("map", f"{occupied:.2f} MB occupied, {held:.2f} MB held"))
    rows.append(("peak memory", f"{metrics['peak_rss_mb']:.0f} MB"))
    rows += [
        (key.replace("_", " "), str(metrics[key])) for key in metrics if key.startswith("frames_") and metrics[key]
    ]
    width = max(len(name) for name, _ in rows)
    return "\n".join([f"  {name:<{width}}  {value}" for name, value in rows] + [f"  results in {out}"])


RECONSTRUCTION = (
    ("accuracy_cm", "accuracy", " cm"),
    ("completion_cm", "completion", " cm"),
    ("completion_ratio_5cm_pct", "completion ratio (5 cm)", " %"),
    ("depth_l1_cm", "depth L1", " cm"),
)
