"""The command line as a user meets it: results, bad input, interrupts."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from fixtures import CAMERA, make_shots, write_7scenes, write_color, write_depth, write_replica

from snh.cli import main
from snh.datasets import open_sequence
from snh.mesh import load_mesh

QUICK = [
    "--set=mapping.n_rays=512", "--set=mapping.first_iterations=80", "--set=mapping.iterations=5",
    "--set=tracking.n_rays=512", "--set=mesh.voxel=0.1", "--set=mesh.min_faces=0", "-q",
]  # fmt: skip
METRICS = (
    "frames", "fps", "init_s", "ate_rmse_cm", "map_bytes_occupied", "map_bytes_held", "peak_rss_mb", "n_keyframes",
)  # fmt: skip


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Output folder of a short run in the built-in room."""
    out = tmp_path_factory.mktemp("run") / "out"
    assert run("run", "builtin", "-n", 7, "--resize", "160x120", "-o", out, "--seed", 3, *QUICK) == 0
    return out


# --- results ----------------------------------------------------------------------------------------------------


def test_a_run_writes_what_scripts_rely_on(finished):
    metrics = json.loads((finished / "metrics.json").read_text())
    assert all(name in metrics for name in METRICS)
    assert metrics["frames"] == 7 and metrics["n_keyframes"] == 2
    assert 0 < metrics["ate_rmse_cm"] < 3 and metrics["fps"] > 0
    assert 0 < metrics["map_bytes_occupied"] < metrics["map_bytes_held"]
    lines = (finished / "trajectory.txt").read_text().splitlines()
    rows = np.array([line.split() for line in lines if not line.startswith("#")], dtype=float)
    assert rows.shape == (7, 8)
    np.testing.assert_allclose(rows[:, 0], np.arange(7) / 30, atol=1e-6)
    assert len(load_mesh(finished / "mesh.ply").faces) > 100
    names = {path.name for path in finished.iterdir()}
    expected = {"trajectory.txt", "mesh.ply", "mesh.glb", "metrics.json", "config.yaml", "frames.csv", "map.npz"}
    assert names == expected | {"path.png", "mesh.png"}, "and nothing else, such as a temporary file"


def test_the_config_of_a_run_repeats_it(finished, tmp_path):
    again = tmp_path / "again"
    command = ["run", "builtin", "-n", 7, "--resize", "160x120", "--seed", 3, "-q", "-o", again]
    assert run(*command, "-c", finished / "config.yaml") == 0
    assert (again / "trajectory.txt").read_text() == (finished / "trajectory.txt").read_text()
    assert (again / "mesh.ply").read_bytes() == (finished / "mesh.ply").read_bytes()


def test_a_finished_run_is_meshed_again(finished, tmp_path, capsys):
    assert run("mesh", finished, "--voxel", 0.05, "-o", tmp_path / "fine.glb") == 0
    assert len(load_mesh(tmp_path / "fine.glb").faces) > 2 * len(load_mesh(finished / "mesh.ply").faces)
    assert "faces in" in capsys.readouterr().out


def test_eval_measures_the_path(finished, tmp_path, capsys):
    assert run("eval", finished, finished / "trajectory.txt", "--json", tmp_path / "same.json") == 0
    same = json.loads((tmp_path / "same.json").read_text())
    assert same["ate_rmse_cm"] < 1e-6 and same["frames"] == 7
    assert "ate_rmse_cm" in capsys.readouterr().out


def test_without_reference_poses_the_error_is_null(tmp_path):
    folder = write_7scenes(tmp_path / "scene", make_shots())
    for path in folder.glob("*.pose.txt"):
        path.unlink()
    assert run("run", folder, "-o", tmp_path / "out", *QUICK, "--no-mesh") == 0
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["ate_rmse_cm"] is None


def test_help_is_quick_and_needs_no_torch():
    code = "import sys, snh.cli\ntry:\n snh.cli.main(['--help'])\nfinally:\n assert 'torch' not in sys.modules"
    start = time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert all(command in done.stdout for command in ("run", "demo", "mesh", "eval", "doctor"))
    assert time.perf_counter() - start < 10, "half a second on an idle machine"


def test_doctor_says_what_is_there(capsys):
    assert run("doctor") == 0
    assert "CUDA kernels" in capsys.readouterr().out


# --- bad input: one sentence, non-zero exit, nothing written ----------------------------------------------------


def missing_folder(folder):
    shutil.rmtree(folder)


def empty_folder(folder):
    missing_folder(folder)
    folder.mkdir()


def images_of_two_sizes(folder):
    write_color(folder / "frame-000003.color.jpg", np.zeros((40, 60, 3), np.uint8))


def truncated_png(folder):
    path = folder / "frame-000002.depth.png"
    path.write_bytes(path.read_bytes()[:-200])


def colour_without_depth(folder):
    for path in folder.glob("*.depth.png"):
        path.unlink()


def no_depth_at_first(folder):
    write_depth(folder / "frame-000000.depth.png", np.zeros((CAMERA.height, CAMERA.width)), 1000)


def no_intrinsics(folder):
    (folder / "camera-intrinsics.txt").unlink()


def a_single_frame(folder):
    for path in folder.glob("frame-00000[1-9]*"):
        path.unlink()


def nothing(folder):
    pass


BAD_INPUT = [
    (missing_folder, [], "does not exist"),
    (empty_folder, [], "is empty"),
    (images_of_two_sizes, [], "60"),
    (truncated_png, [], "frame-000002.depth.png"),
    (colour_without_depth, [], "depth"),
    (nothing, ["--depth-scale", "0.001"], "depth_scale"),
    (no_depth_at_first, [], "no valid depth"),
    (no_intrinsics, [], "intrinsics"),
    (a_single_frame, [], "single frame"),
    (nothing, ["--set", "traking.n_rays=5"], "did you mean 'tracking'"),
    (nothing, ["--resize", "big"], "640x480"),
    (nothing, ["-c", "absent"], "presets are"),
]


@pytest.mark.parametrize(("spoil", "options", "part"), BAD_INPUT, ids=[f"{b[0].__name__}-{b[2]}" for b in BAD_INPUT])
def test_bad_input_is_one_sentence_and_writes_nothing(spoil, options, part, tmp_path, capfd):
    folder = write_7scenes(tmp_path / "scene", make_shots())
    spoil(folder)
    assert run("run", folder, "-o", tmp_path / "out", "-q", *options) == 2
    said = capfd.readouterr()
    assert said.out == "" and len(said.err.strip().splitlines()) == 1
    assert said.err.startswith("snh-slam: ") and part in said.err
    assert not (tmp_path / "out").exists()


def test_a_damaged_recording_does_not_touch_earlier_results(finished, tmp_path, capfd):
    out = tmp_path / "out"
    shutil.copytree(finished, out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    folder = write_replica(tmp_path / "scene", make_shots())
    (folder / "results/depth000004.png").write_bytes(b"")
    assert run("run", folder, "-o", out, "-q") == 2
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_an_output_folder_that_cannot_be_made(tmp_path, capfd):
    (tmp_path / "file").write_text("")
    assert run("run", "builtin", "-n", 3, "-o", tmp_path / "file" / "out", *QUICK) == 2
    error = capfd.readouterr().err
    assert "cannot write to the output folder" in error and len(error.strip().splitlines()) == 1


def test_a_file_that_does_not_fit_is_not_half_written(finished, tmp_path):
    """A limit on the file size stands for a full disk: the map does not fit, the small files before it do."""

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))

    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "snh.cli",
        "run",
        "builtin",
        "-n",
        "3",
        "--resize",
        "160x120",
        "-o",
        str(out),
        *QUICK,
    ]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=limit)
    assert done.returncode == 2
    assert len(done.stderr.strip().splitlines()) == 1 and "Cannot write" in done.stderr
    assert {path.name for path in out.iterdir()} == {"trajectory.txt", "config.yaml", "frames.csv"}


def test_a_map_that_is_none(tmp_path, capfd):
    assert run("mesh", tmp_path) == 2
    (tmp_path / "map.npz").write_bytes(b"PK nonsense")
    assert run("mesh", tmp_path) == 2
    assert "damaged" in capfd.readouterr().err


# --- surprises in the middle ------------------------------------------------------------------------------------


def test_frames_without_depth_and_colour_are_said(tmp_path, capfd):
    sequence = open_sequence("builtin", resize=(160, 120), frames=12)
    folder, frames = tmp_path / "scene", [sequence[i] for i in range(12)]
    for i, frame in enumerate(frames):
        write_color(folder / f"frame-{i:06d}.color.png", frame.rgb * (not 6 <= i < 11))
        write_depth(folder / f"frame-{i:06d}.depth.png", frame.depth * (i != 3), 1000)
    c = sequence.camera
    np.savetxt(folder / "camera-intrinsics.txt", [[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]])
    assert run("run", folder, "-o", tmp_path / "out", "--no-mesh", *QUICK) == 0
    said = capfd.readouterr()
    assert "frame 3: no depth" in said.err and said.err.count("no colour") == 5
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert (metrics["frames"], metrics["frames_without_depth"], metrics["frames_without_colour"]) == (12, 1, 5)
    assert metrics["frames_lost"] == 0


def test_an_interrupt_keeps_what_was_done(tmp_path):
    out = tmp_path / "out"
    command = [sys.executable, "-m", "snh.cli", "run", "builtin", "-n", "5000", "--resize", "160x120", "-o", str(out)]
    child = subprocess.Popen([*command, *QUICK], stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    while not out.exists():
        time.sleep(0.1)
    time.sleep(4)  # some frames, or still the first one: both must work
    os.kill(child.pid, signal.SIGINT)
    _, error = child.communicate(timeout=120)
    assert child.returncode == 130 and "interrupted" in error
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["interrupted"] and 1 <= metrics["frames"] < 5000
    assert (out / "mesh.ply").exists()
