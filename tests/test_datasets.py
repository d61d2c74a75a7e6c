"""datasets: each layout reads back what its writer put in, and each bad input is refused with one sentence."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from fixtures import (
    CAMERA,
    Shot,
    make_shots,
    write_7scenes,
    write_color,
    write_depth,
    write_generic,
    write_replica,
    write_scannet,
    write_sens,
    write_tum,
)

from snh.datasets import FORMATS, FrameError, Sequence, check, open_sequence, prefetch
from snh.datasets.images import image_size
from snh.datasets.tum import associate
from snh.errors import ConfigError, DataError
from snh.frame import Camera, Frame
from snh.geometry import se3_exp

INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
JPEG_LEVELS = 6  # chroma subsampling moves smooth colours by a few levels even at full quality


def write_tum_with_camera(folder: Path, shots: list[Shot], **timing: float) -> Path:
    write_tum(folder, shots, **timing)
    (folder / "camera.yaml").write_text(yaml.safe_dump(dict(zip(("fx", "fy", "cx", "cy"), INTRINSICS, strict=True))))
    return folder


def write_generic_with_camera(folder: Path, shots: list[Shot]) -> Path:
    write_generic(folder, shots)
    (folder / "intrinsics.txt").write_text(" ".join(map(str, INTRINSICS)))
    np.savetxt(folder / "traj.txt", [shot.T_wc.ravel() for shot in shots])
    return folder


WRITERS: dict[str, Callable[[Path, list[Shot]], Path]] = {
    "7scenes": write_7scenes,
    "replica": write_replica,
    "tum": write_tum_with_camera,
    "scannet": write_scannet,
    "sens": lambda folder, shots: write_sens(folder / "scene.sens", shots),
    "generic": write_generic_with_camera,
}


def assert_frame(frame: Frame, shot: Shot, depth_step: float = 0.0005) -> None:
    """Colour within JPEG's error, depth within half a step of the file's unit (m), pose within float32."""
    assert frame.rgb.dtype == np.uint8 and frame.depth.dtype == np.float32
    assert np.abs(frame.rgb.astype(int) - shot.rgb).max() <= JPEG_LEVELS
    np.testing.assert_allclose(frame.depth, shot.depth, atol=depth_step)
    np.testing.assert_array_equal(frame.depth == 0, shot.depth == 0)
    assert frame.T_wc_ref is not None
    np.testing.assert_allclose(frame.T_wc_ref, shot.T_wc, atol=1e-6)


# --- layouts


@pytest.mark.parametrize("layout", WRITERS)
@pytest.mark.parametrize("format", ["auto", "named"])
def test_layout_reads_back(tmp_path: Path, layout: str, format: str) -> None:
    shots = make_shots()
    source = WRITERS[layout](tmp_path / "recording", shots)
    named = "scannet" if layout == "sens" else layout
    if layout == "sens" and format == "named":
        source = source.parent  # a folder with one .sens file is a scene too
    sequence = open_sequence(source, format="auto" if format == "auto" else named)
    check(sequence)
    assert len(sequence) == len(shots)
    for value, expected in zip(vars(sequence.camera).values(), vars(CAMERA).values(), strict=True):
        assert value == pytest.approx(expected, rel=1e-6)
    for n, shot in enumerate(shots):
        assert sequence[n].index == n
        assert_frame(sequence[n], shot)
    reference = sequence.reference()
    assert reference is not None
    np.testing.assert_allclose(reference, [shot.T_wc for shot in shots], atol=1e-6)
    times = [sequence[n].timestamp for n in range(len(shots))]
    np.testing.assert_allclose(np.diff(times), 1 / 30, atol=1e-5)


def test_iteration_ends(tmp_path: Path) -> None:
    sequence = open_sequence(write_7scenes(tmp_path / "r", make_shots(3)))
    assert [frame.index for frame in sequence] == [0, 1, 2]


def test_7scenes_as_png_without_poses(tmp_path: Path) -> None:
    shots = make_shots(3)
    folder = write_7scenes(tmp_path / "r", shots, suffix="png")
    for path in folder.glob("*.pose.txt"):
        path.unlink()
    sequence = open_sequence(folder)
    assert sequence.reference() is None and sequence[1].T_wc_ref is None
    np.testing.assert_array_equal(sequence[1].rgb, shots[1].rgb)


def test_replica_parameters_in_the_folder(tmp_path: Path) -> None:
    write_replica(tmp_path / "r", make_shots(3), parameters_above=False)
    assert open_sequence(tmp_path / "r").camera == CAMERA


def test_scannet_frames_subfolder_and_lost_poses(tmp_path: Path) -> None:
    shots = make_shots(4)
    frames = write_scannet(tmp_path / "scene0000_00" / "frames", shots)
    (frames / "pose" / "2.txt").write_text("-inf -inf -inf -inf\n" * 4)
    (frames / "pose" / "3.txt").unlink()
    sequence = open_sequence(tmp_path / "scene0000_00")
    reference = sequence.reference()
    assert sequence.name == "scene0000_00" and reference is not None
    assert np.isnan(reference[2:]).all() and np.isfinite(reference[:2]).all()
    assert sequence[2].T_wc_ref is None and sequence[1].T_wc_ref is not None


def test_scannet_large_colour_is_registered(tmp_path: Path) -> None:
    shots = make_shots(2)
    folder = write_scannet(tmp_path / "scene", shots)
    large = CAMERA.scaled(128, 96)
    for n, shot in enumerate(shots):
        write_color(folder / f"color/{n}.jpg", cv2.resize(shot.rgb, (128, 96), interpolation=cv2.INTER_LINEAR))
    K = np.eye(4)
    K[0, 0], K[1, 1], K[0, 2], K[1, 2] = large.fx, large.fy, large.cx, large.cy
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", K)
    frame = open_sequence(folder)[1]
    inside = slice(2, -2)  # resizing up and down again is exact for a linear image except at its border
    assert np.abs(frame.rgb.astype(int) - shots[1].rgb)[inside, inside].max() <= JPEG_LEVELS


def test_replica_poses_of_another_length(tmp_path: Path) -> None:
    folder = write_replica(tmp_path / "r", make_shots(4))
    lines = (folder / "traj.txt").read_text().splitlines()
    (folder / "traj.txt").write_text("\n".join([lines[0], " ".join(["nan"] * 16), lines[2]]))
    reference = open_sequence(folder).reference()
    assert reference is not None
    assert list(np.isfinite(reference).all(axis=(1, 2))) == [True, False, True, False]


def test_generic_lists_and_pose_folder(tmp_path: Path) -> None:
    shots = make_shots(3)
    folder = write_generic(tmp_path / "r", shots, color_name="left", scale=2000)
    order = [2, 0, 1]
    (folder / "color.txt").write_text("".join(f"left/{n:04d}.jpg\n" for n in order))
    (folder / "depth.txt").write_text("".join(f"depth/{n:04d}.png\n" for n in order))
    (folder / "poses").mkdir()
    for n in order:
        np.savetxt(folder / f"poses/{n:04d}.txt", shots[n].T_wc)
    sequence = open_sequence(folder, intrinsics="60, 61, 31.5, 24", depth_scale=2000)
    for k, n in enumerate(order):
        assert_frame(sequence[k], shots[n])


def test_generic_names_without_numbers(tmp_path: Path) -> None:
    shots = make_shots(2)
    for name, shot in zip("ab", shots, strict=True):
        write_color(tmp_path / f"rgb/{name}.png", shot.rgb)
        write_depth(tmp_path / f"depth/{name}.png", shot.depth, 1000)
    sequence = open_sequence(tmp_path, intrinsics=INTRINSICS)
    np.testing.assert_array_equal(sequence[1].rgb, shots[1].rgb)


# --- TUM


def test_associate_by_hand() -> None:
    color = np.array([0.00, 0.03, 0.06, 0.50])
    depth = np.array([0.015, 0.032, 0.049, 0.90])
    # 0.03 takes 0.032 (2 ms); 0.06 takes 0.049 (11 ms); 0.00 takes 0.015 (15 ms); 0.50 finds none.
    assert associate(color, depth, 0.02) == [(0, 0), (1, 1), (2, 2)]
    assert associate(color, depth, 0.012) == [(1, 1), (2, 2)]
    assert associate(color, depth[:0], 0.02) == []
    # 0.03 and 0.018 (12 ms) come before 0.00 and 0.018 (18 ms) and 0.03 and 0.049 (19 ms), which then have no partner.
    assert associate(np.array([0.00, 0.03]), np.array([0.018, 0.049]), 0.02) == [(1, 0)]
    assert associate(np.array([0.000, 0.011]), np.array([0.005]), 0.02) == [(0, 0)]


def test_tum_largest_difference_of_times(tmp_path: Path) -> None:
    folder = write_tum_with_camera(tmp_path / "r", make_shots(3), delay=0.05, period=0.5)
    refuse(folder, "raise max_time_difference")
    sequence = open_sequence(folder, max_time_difference=0.08)
    reference = sequence.reference()
    assert len(sequence) == 3 and reference is not None and np.isfinite(reference).all()


def test_tum_poses_missing_for_some_frames(tmp_path: Path) -> None:
    folder = write_tum_with_camera(tmp_path / "r", make_shots(4))
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    time = lines[4].split()[0]
    (folder / "groundtruth.txt").write_text("\n".join([*lines[:4], f"{time} nan nan nan 0 0 0 1", lines[5]]))
    reference = open_sequence(folder).reference()
    assert reference is not None
    assert list(np.isfinite(reference).all(axis=(1, 2))) == [True, False, True, False]


@pytest.mark.parametrize(
    "name, fx", [("rgbd_dataset_freiburg1_desk", 517.3), ("fr2_xyz", 520.9), ("x_fr3_office", 535.4)]
)
def test_tum_cameras_by_name(tmp_path: Path, name: str, fx: float) -> None:
    shots = make_shots(2, Camera(640, 480, 0, 0, 0, 0))
    sequence = open_sequence(write_tum(tmp_path / name, shots))
    assert sequence.camera.fx == fx
    rgb = sequence[0].rgb
    if fx == 535.4:
        np.testing.assert_array_equal(rgb, shots[0].rgb)
        return
    camera = sequence.camera
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    k = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633) if fx == 517.3 else (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    u, v = 100.0, 80.0  # the distortion model by hand at one pixel
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    r2 = x * x + y * y
    radial = 1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3
    xd = x * radial + 2 * k[2] * x * y + k[3] * (r2 + 2 * x * x)
    yd = y * radial + k[2] * (r2 + 2 * y * y) + 2 * k[3] * x * y
    source = cv2.getRectSubPix(shots[0].rgb, (1, 1), (xd * K[0, 0] + K[0, 2], yd * K[1, 1] + K[1, 2]))[0, 0]
    assert np.abs(rgb[80, 100].astype(int) - source).max() <= 1


# --- registration


@pytest.mark.parametrize("apart", [True, False])
def test_registration_of_a_known_offset(tmp_path: Path, apart: bool) -> None:
    """A wall at 2 m whose colour is a smooth function of its own x and y, seen by a turned and shifted camera."""
    depth_camera, color_camera = Camera(320, 240, 290, 290, 160, 120), Camera(320, 240, 255, 260, 158, 119)
    T_color_depth = se3_exp(np.array([-0.05, 0.02, 0.01, 0.01, -0.12, 0.015]))
    T_color_depth[:3, 3] *= apart
    T_depth_color = np.linalg.inv(T_color_depth)

    def wall_color(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack(
            [128 + 100 * np.sin(3 * x), 128 + 100 * np.sin(3 * y), 128 + 60 * np.cos(2 * x + 3 * y)], axis=-1
        )

    rays = color_camera.rays().astype(float) @ T_depth_color[:3, :3].T
    s = (2 - T_depth_color[2, 3]) / rays[..., 2]
    on_wall = rays * s[..., None] + T_depth_color[:3, 3]
    rgb = np.round(wall_color(on_wall[..., 0], on_wall[..., 1])).astype(np.uint8)
    depth = np.full((240, 320), 2, np.float32)
    write_7scenes(tmp_path / "r", [Shot(rgb, depth, np.eye(4))] * 2, suffix="png")
    (tmp_path / "r" / "calibration.yaml").write_text(
        yaml.safe_dump(
            {
                "depth": {"fx": 290, "fy": 290, "cx": 160, "cy": 120},
                "color": {"fx": 255, "fy": 260, "cx": 158, "cy": 119},
                "T_color_depth": T_color_depth.tolist(),
            }
        )
    )
    frame = open_sequence(tmp_path / "r")[0]
    seen = frame.depth > 0
    points = depth_camera.rays() * 2
    expected = wall_color(points[..., 0], points[..., 1])
    assert seen.mean() > 0.8
    assert np.abs(frame.rgb - expected)[seen].max() < 1.5  # rounding to uint8 plus bilinear interpolation
    pixels = color_camera.project(points @ T_color_depth[:3, :3].T.astype(np.float32) + T_color_depth[:3, 3])
    outside = (pixels < -0.6).any(-1) | (pixels[..., 0] > 319.6) | (pixels[..., 1] > 239.6)
    assert outside.any() and not seen[outside].any()


@pytest.mark.parametrize("fx, shifted", [(585, True), (590, False)])
def test_kinect_colour_camera_only_for_the_kinect(tmp_path: Path, fx: float, shifted: bool) -> None:
    camera = Camera(640, 480, fx, fx, 320, 240)
    v, u = np.mgrid[:480, :640]
    rgb = np.stack([u // 4, v // 4, u * 0 + 50], axis=-1).astype(np.uint8)
    shot = Shot(rgb, np.full((480, 640), 2, np.float32), np.eye(4))
    frame = open_sequence(write_7scenes(tmp_path / "r", [shot] * 2, camera, suffix="png"))[0]
    # At depth 2 m pixel (420, 240) sees x = 100/585 * 2 m; the colour camera has it at (x - 0.025) / 2 * 525 + 320.
    expected = ((100 / 585 * 2 - 0.025) / 2 * 525 + 320) / 4 if shifted else 105
    assert frame.rgb[240, 420, 0] == pytest.approx(expected, abs=1)  # the colour is u // 4


def test_holes_take_the_shift_of_their_surroundings(tmp_path: Path) -> None:
    camera = Camera(640, 480, 585, 585, 320, 240)
    u = np.arange(640)[None].repeat(480, 0)
    rgb = np.stack([u // 4] * 3, axis=-1).astype(np.uint8)
    depth = np.full((480, 640), 1, np.float32)
    whole = Shot(rgb, depth, np.eye(4))
    depth = depth.copy()
    depth[200:230, 300:330] = 0
    folder = write_7scenes(tmp_path / "r", [whole, Shot(rgb, depth, np.eye(4))], camera, suffix="png")
    sequence = open_sequence(folder)
    assert np.abs(sequence[0].rgb.astype(int) - sequence[1].rgb).max() <= 1


def test_redkitchen_registration(shared_data: Path) -> None:
    """Photometric correlation of frames 40 apart: 0.80 as recorded, at least 0.90 registered."""
    registered = open_sequence(shared_data / "redkitchen")
    K = (585, 585, 320, 240.001)  # another depth camera: counts as registered
    recorded = open_sequence(shared_data / "redkitchen", intrinsics=K)
    check(registered)
    assert len(registered) == 400 and registered[0].depth.max() < 10
    starts = range(0, 360, 90)
    assert np.mean([photometric_correlation(registered, i, i + 40) for i in starts]) > 0.90
    assert np.mean([photometric_correlation(recorded, i, i + 40) for i in starts]) < 0.84


def photometric_correlation(sequence: Sequence, i: int, j: int) -> float:
    """Of the grey values of frame i and of frame j where the points of i project to, occluded ones left out."""
    a, b = sequence[i], sequence[j]
    assert a.T_wc_ref is not None and b.T_wc_ref is not None
    valid = a.depth[::2, ::2] > 0
    points = (a.camera.rays(2) * a.depth[::2, ::2, None])[valid]
    T_ba = np.linalg.inv(b.T_wc_ref) @ a.T_wc_ref
    points = points @ T_ba[:3, :3].T + T_ba[:3, 3]
    u, v = np.rint(b.camera.project(points)).astype(int).T
    inside = (u >= 0) & (u < b.camera.width) & (v >= 0) & (v < b.camera.height)
    grey = a.rgb[::2, ::2].mean(axis=-1)[valid][inside]
    u, v, z = u[inside], v[inside], points[inside, 2]
    same = np.abs(b.depth[v, u] - z) < 0.03
    return float(np.corrcoef(grey[same], b.rgb.mean(axis=-1)[v, u][same])[0, 1])


# --- options


def test_start_frames_stride(tmp_path: Path) -> None:
    shots = make_shots(10)
    sequence = open_sequence(write_7scenes(tmp_path / "r", shots), start=1, frames=3, stride=2)
    assert len(sequence) == 3
    for k, n in enumerate((1, 3, 5)):
        assert sequence[k].index == k and sequence[k].timestamp == pytest.approx(n / 30)
        assert_frame(sequence[k], shots[n])
    reference = sequence.reference()
    assert reference is not None
    np.testing.assert_allclose(reference, [shots[n].T_wc for n in (1, 3, 5)])


def test_resize_then_crop_keep_the_geometry(tmp_path: Path) -> None:
    """Points of the plane z = 1 + a x keep to it whatever is done to the images."""
    camera = Camera(64, 48, 60, 60, 31.5, 23.5)
    a = 0.4
    depth = 1 / (1 - a * camera.rays()[..., 0])
    shot = Shot(make_shots(1)[0].rgb, depth.astype(np.float32), np.eye(4))
    folder = write_7scenes(tmp_path / "r", [shot] * 2, camera)
    sequence = open_sequence(folder, resize=(192, 144), crop=10)
    frame = sequence[0]
    assert frame.rgb.shape == (124, 172, 3) and frame.depth.shape == (124, 172)
    assert (frame.camera.width, frame.camera.height) == (172, 124) and frame.camera == sequence.camera
    points = frame.camera.rays() * frame.depth[..., None]
    # Tripled images repeat each reading for 3 pixels: their centre has it exactly, the neighbours are 1/3 pixel off.
    centre = points[:, (1 - 10) % 3 :: 3]
    assert np.abs(centre[..., 2] - 1 - a * centre[..., 0]).max() < 0.0011  # depth is stored in mm


def test_resize_invents_no_depth_between_two_surfaces(tmp_path: Path) -> None:
    shot = make_shots(1)[0]
    depth = np.where(np.arange(64) < 31, 1, 3).astype(np.float32)[None].repeat(48, 0)
    folder = write_7scenes(tmp_path / "r", [replace(shot, depth=depth)] * 2)
    for size in ((32, 24), (40, 30), (128, 96)):
        assert set(np.unique(open_sequence(folder, resize=size)[0].depth).round(3)) == {1, 3}


def test_depth_limit_and_saturation(tmp_path: Path) -> None:
    shots = make_shots(2)
    depth = shots[0].depth.copy()
    depth[0, 0] = 65.535
    folder = write_7scenes(tmp_path / "r", [replace(shots[0], depth=depth), shots[1]])
    assert open_sequence(folder)[0].depth[0, 0] == 0
    limited = open_sequence(folder, depth_max=1.2)[0].depth
    assert 1.1 < limited.max() <= 1.2 and limited[20, 40] == 0


@pytest.mark.parametrize(
    "options, sentence",
    [
        ({"stride": 0}, "stride >= 1"),
        ({"frames": 0}, "frames >= 1"),
        ({"crop": 24}, "leaves nothing"),
        ({"resize": (0, 5)}, "at least one pixel"),
        ({"depth_max": -1.0}, "above 0 m"),
        ({"format": "kitti"}, "format kitti is unknown"),
    ],
)
def test_bad_options(tmp_path: Path, options: dict, sentence: str) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(2))
    with pytest.raises(ConfigError, match=sentence):
        open_sequence(folder, **options)


# --- calibration files


@pytest.mark.parametrize(
    "name, text",
    [
        ("camera-intrinsics.txt", "60 0 31.5\n0 61 24\n0 0 1"),
        ("calibration.txt", "60 61 31.5 24"),
        ("camera.json", '{"fx": 60, "fy": 61, "cx": 31.5, "cy": 24}'),
        ("camera_intrinsic.json", '{"width": 64, "height": 48, "intrinsic_matrix": [60,0,0,0,61,0,31.5,24,1]}'),
        ("calibration.yaml", "depth: {fx: 60, fy: 61, cx: 31.5, cy: 24}"),
    ],
)
@pytest.mark.parametrize("place", [".", ".."])
def test_calibration_files(tmp_path: Path, name: str, text: str, place: str) -> None:
    folder = write_generic(tmp_path / "r", make_shots(2))
    (folder / place / name).write_text(text)
    assert open_sequence(folder).camera == CAMERA
    assert open_sequence(folder, intrinsics=folder / place / name).camera == CAMERA
    assert open_sequence(folder, intrinsics="70,71,30,20").camera.fx == 70


@pytest.mark.parametrize(
    "name, text, sentence",
    [
        ("calibration.yaml", "depth: {fx: 60, fy: 61, cx: 31}", "must give fx, fy, cx, cy"),
        ("calibration.yaml", "depth: {fx: 60, fy: 61, cx: 31, cy: 24}\nofset: [1, 2, 3]", "unknown key ofset"),
        ("calibration.yaml", "depth: {fx: 60, fy: 61, cx: 31, cy: 24}\noffset: [1, 2]", "offset takes 3 numbers"),
        ("calibration.yaml", "depth: {fx: 60", "cannot be read as a calibration"),
        ("calibration.yaml", "- 3", "holds no cameras"),
        ("calibration.yaml", "depth: {fx: 60, fy: 61, cx: 31, cy: 24}\ndepth_scale: mm", "units per metre"),
        ("camera.json", '{"fx": 0, "fy": 61, "cx": 31, "cy": 24}', "above 0 pixels"),
        ("camera.json", '{"w": 640, "h": 480, "fx": 60, "fy": 61, "cx": 31, "cy": 24}', "are for 640 x 480 pixels"),
        ("intrinsics.txt", "1 2 3", "holds 3 numbers"),
        ("intrinsics.txt", "fx fy", "not a number"),
    ],
)
def test_bad_calibration_files(tmp_path: Path, name: str, text: str, sentence: str) -> None:
    folder = write_generic(tmp_path / "r", make_shots(2))
    (folder / name).write_text(text)
    with pytest.raises(DataError, match=sentence):
        open_sequence(folder)


# --- built-in scene


def test_builtin_takes_the_same_options() -> None:
    sequence = open_sequence("builtin", start=200, frames=5, stride=3, resize=(64, 48), crop=2)
    assert len(sequence) == 5
    check(sequence)
    assert sequence[4].timestamp == pytest.approx(212 / 30) and sequence[4].rgb.shape == (44, 60, 3)
    assert open_sequence("builtin:2:kinect", frames=2).name == "builtin-2-kinect"


@pytest.mark.parametrize("source", ["builtin:9", "builtin:nothing"])
def test_builtin_that_does_not_exist(source: str) -> None:
    with pytest.raises(DataError):
        open_sequence(source)


def test_builtin_has_its_own_camera() -> None:
    with pytest.raises(ConfigError, match="its own camera"):
        open_sequence("builtin", intrinsics=INTRINSICS)


# --- bad input


def refuse(source: Path, sentence: str, **options: object) -> None:
    """Opening and checking ends in one line that holds `sentence`."""
    with pytest.raises(DataError, match=sentence) as caught:
        check(open_sequence(source, **options))  # type: ignore[arg-type]
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 600


def test_missing_folder(tmp_path: Path) -> None:
    refuse(tmp_path / "nothing", "does not exist")


def test_empty_folder(tmp_path: Path) -> None:
    refuse(tmp_path, "is empty")


def test_file_instead_of_folder(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").write_bytes(b"x")
    refuse(tmp_path / "video.mp4", "neither a folder nor")


def test_unknown_layout_names_what_was_looked_for(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(DataError) as caught:
        open_sequence(tmp_path)
    assert all(layout.LAYOUT in str(caught.value) for layout in FORMATS.values())


@pytest.mark.parametrize("kind", ["color.png", "depth.png"])
def test_images_of_two_sizes(tmp_path: Path, kind: str) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(9), suffix="png")
    path = folder / f"frame-000003.{kind}"
    small = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:24, :32]
    cv2.imwrite(str(path), small)
    refuse(folder, "frame-000003.* has 32 x 24 pixels.* have 64 x 48")
    with pytest.raises(FrameError, match="32 x 24") as caught:
        open_sequence(folder, start=2)[1]
    assert caught.value.index == 1


def test_colour_and_depth_of_two_sizes_without_calibration(tmp_path: Path) -> None:
    folder = write_generic(tmp_path / "r", make_shots(2))
    for path in (folder / "color").iterdir():
        write_color(path, make_shots(1)[0].rgb[:24, :32])
    refuse(folder, "differ in size; give a calibration file", intrinsics=INTRINSICS)


@pytest.mark.parametrize("layout", ["7scenes", "replica", "tum", "scannet", "generic"])
@pytest.mark.parametrize("kind", ["color", "depth"])
@pytest.mark.parametrize("keep", [0, 20, 0.5, -8])
def test_truncated_image(
    tmp_path: Path, layout: str, kind: str, keep: float, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = WRITERS[layout](tmp_path / "r", make_shots(7))
    path = open_sequence(folder).files(3)[kind == "depth"]
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep) if keep == 0.5 else int(keep)])
    sequence = open_sequence(folder)
    refuse(folder, f"{path.name} is (truncated|empty)")
    with pytest.raises(FrameError) as caught:
        sequence[3]
    assert caught.value.index == 3
    assert capfd.readouterr().err == ""  # the sentence is ours alone


def test_damaged_png_is_skipped_by_its_number(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(5))
    path = folder / "frame-000002.depth.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    sequence = open_sequence(folder, start=1)
    with pytest.raises(FrameError, match="damaged") as caught:
        sequence[1]
    assert caught.value.index == 1
    assert sequence[2].depth.any()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("layout", ["7scenes", "replica", "scannet", "generic"])
@pytest.mark.parametrize("kind", ["color", "depth"])
def test_colour_without_depth(tmp_path: Path, layout: str, kind: str) -> None:
    folder = WRITERS[layout](tmp_path / "r", make_shots(4))
    open_sequence(folder).files(2)[kind == "depth"].unlink()
    refuse(folder, f"has no {'colour' if kind == 'color' else 'depth'} image of the same number")


@pytest.mark.parametrize("layout", ["7scenes", "replica", "tum", "scannet", "generic"])
def test_colour_without_any_depth(tmp_path: Path, layout: str) -> None:
    folder = WRITERS[layout](tmp_path / "r", make_shots(3))
    for _, depth in [open_sequence(folder).files(n) for n in range(3)]:
        depth.unlink()
    if (folder / "depth").is_dir():
        (folder / "depth").rmdir()
    if layout == "tum":
        (folder / "depth.txt").unlink()
    refuse(folder, "depth")


def test_file_of_a_list_is_missing(tmp_path: Path) -> None:
    folder = write_tum_with_camera(tmp_path / "r", make_shots(4))
    path = open_sequence(folder).files(2)[1]
    path.unlink()
    refuse(folder, f"{path.name} cannot be read")


@pytest.mark.parametrize("scale, sentence", [(1.0, "reaches from 1e\\+03"), (1e6, "so the depth scale is wrong")])
def test_depth_scale_beyond_reason(tmp_path: Path, scale: float, sentence: str) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(3))
    refuse(folder, sentence, depth_scale=scale)
    refuse(folder, sentence, depth_scale=scale, depth_max=5)


@pytest.mark.parametrize("scale", [0, -1000, float("nan")])
def test_impossible_depth_scale(tmp_path: Path, scale: float) -> None:
    refuse(write_7scenes(tmp_path / "r", make_shots(3)), "positive number of units per metre", depth_scale=scale)


def test_frame_without_depth(tmp_path: Path) -> None:
    shots = make_shots(3)
    empty = replace(shots[1], depth=np.zeros_like(shots[1].depth))
    middle = open_sequence(write_7scenes(tmp_path / "middle", [shots[0], empty, shots[2]]))
    check(middle)
    assert not middle[1].depth.any()
    refuse(write_7scenes(tmp_path / "first", [empty, shots[1], shots[2]]), "first frame .* has no valid depth")
    refuse(tmp_path / "middle", "nearer than depth_max", depth_max=0.5)


def test_eight_bit_depth(tmp_path: Path) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(3))
    for path in folder.glob("*.depth.png"):
        cv2.imwrite(str(path), np.full((48, 64), 9, np.uint8))
    refuse(folder, "8-bit with 1 channel")


@pytest.mark.parametrize("layout", ["7scenes", "replica", "tum", "scannet", "generic"])
def test_intrinsics_missing(tmp_path: Path, layout: str) -> None:
    folder = WRITERS[layout](tmp_path / "r", make_shots(3))
    for name in (
        "camera-intrinsics.txt",
        "camera.yaml",
        "intrinsics.txt",
        "../cam_params.json",
        "intrinsic/intrinsic_depth.txt",
    ):
        (folder / name).unlink(missing_ok=True) if (folder / name).parent.is_dir() else None
    refuse(folder, "intrinsics of .* are missing")
    check(open_sequence(folder, intrinsics=INTRINSICS))


def test_wrong_intrinsics_option(tmp_path: Path) -> None:
    refuse(write_7scenes(tmp_path / "r", make_shots(3)), "neither fx,fy,cx,cy nor a file", intrinsics="kinect")
    refuse(tmp_path / "r", "holds 3 numbers", intrinsics="1,2,3")


def test_single_frame(tmp_path: Path) -> None:
    refuse(write_7scenes(tmp_path / "r", make_shots(1)), "a single frame")
    refuse(write_7scenes(tmp_path / "s", make_shots(3)), "a single frame", frames=1)
    refuse(tmp_path / "s", "has 3 frames; choose a start below", start=3)


def test_damaged_pose_files(tmp_path: Path) -> None:
    folder = write_7scenes(tmp_path / "r", make_shots(3))
    (folder / "frame-000001.pose.txt").write_text("1 2 3")
    refuse(folder, "must hold a 4 x 4")
    (folder / "frame-000001.pose.txt").write_text("-1.#IND 1 2 3\n" * 4)
    check(open_sequence(folder))


@pytest.mark.parametrize("keep", [0, 200, 400, -200])
def test_truncated_sens(tmp_path: Path, keep: int) -> None:
    path = write_sens(tmp_path / "scene.sens", make_shots(3))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DataError, match="is truncated or cannot be read"):
        open_sequence(path)


def test_sens_pose_with_an_infinite_number(tmp_path: Path) -> None:
    shots = make_shots(3)
    shots[1].T_wc[0, 3] = -np.inf
    sequence = open_sequence(write_sens(tmp_path / "scene.sens", shots))
    reference = sequence.reference()
    assert reference is not None and sequence[1].T_wc_ref is None
    assert np.isnan(reference[1]).all() and np.isfinite(reference[[0, 2]]).all()


def test_damaged_sens_frame(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens", make_shots(3))
    data = bytearray(path.read_bytes())
    data[-60:-40] = bytes(20)  # inside the depth of the last frame
    path.write_bytes(data)
    sequence = open_sequence(path)
    assert sequence[1].depth.any()
    with pytest.raises(FrameError, match="frame 2 of") as caught:
        sequence[2]
    assert caught.value.index == 2


def test_other_sens_versions(tmp_path: Path) -> None:
    path = write_sens(tmp_path / "scene.sens", make_shots(3))
    path.write_bytes(b"\x05" + path.read_bytes()[1:])
    refuse(path, "version 5")


def test_image_size_of_jpeg_and_png(tmp_path: Path) -> None:
    for name in ("a.jpg", "a.png"):
        write_color(tmp_path / name, np.zeros((17, 23, 3), np.uint8))
        assert image_size(tmp_path / name) == (23, 17)


# --- prefetch


class CountingSequence:
    """Frames without images; says which were asked for, by which thread; frame 3 is damaged."""

    name = "counting"
    camera = CAMERA

    def __init__(self) -> None:
        self.asked: list[int] = []
        self.threads: set[str] = set()

    def __len__(self) -> int:
        return 10

    def __getitem__(self, index: int) -> Frame:
        self.asked.append(index)
        self.threads.add(threading.current_thread().name)
        if index == 3:
            raise FrameError("frame 3 is damaged", 3)
        if index >= len(self):
            raise IndexError(index)
        return Frame(index, 0.0, np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1), np.float32), CAMERA)

    def reference(self) -> None:
        return None


def wait_until(condition: Callable[[], bool]) -> None:
    for _ in range(500):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("waited 5 s in vain")


def test_prefetch_order_and_damaged_frame_in_its_place() -> None:
    sequence = CountingSequence()
    items = list(prefetch(sequence, range(6)))
    assert [item.index for item in items] == [0, 1, 2, 3, 4, 5]
    assert [isinstance(item, FrameError) for item in items] == [False, False, False, True, False, False]
    assert threading.current_thread().name not in sequence.threads


def test_prefetch_raises_other_errors_at_their_frame() -> None:
    frames = prefetch(CountingSequence(), [0, 1, 99, 2])
    assert [next(frames).index, next(frames).index] == [0, 1]
    with pytest.raises(IndexError):
        next(frames)


def test_prefetch_runs_ahead_and_no_further() -> None:
    sequence = CountingSequence()
    frames = prefetch(sequence, [9, 8, 7, 6, 5, 4], ahead=2)
    assert next(frames).index == 9
    wait_until(lambda: len(sequence.asked) == 3)
    time.sleep(0.05)
    assert sequence.asked == [9, 8, 7]
    assert next(frames).index == 8
    wait_until(lambda: sequence.asked == [9, 8, 7, 6])


@pytest.mark.parametrize("way", ["close", "end", "forget", "error"])
def test_prefetch_stops_its_thread(way: str) -> None:
    before = threading.active_count()
    frames = prefetch(CountingSequence(), [0, 1, 2, 99] if way == "error" else [0, 1, 2])
    assert next(frames).index == 0
    assert threading.active_count() == before + 1
    if way == "close":
        frames.close()  # type: ignore[attr-defined]
    elif way == "end":
        assert [frame.index for frame in frames] == [1, 2]
    elif way == "error":
        with pytest.raises(IndexError):
            list(frames)
    else:
        del frames
    assert threading.active_count() == before


def test_prefetch_of_files(tmp_path: Path) -> None:
    shots = make_shots(6)
    sequence = open_sequence(write_7scenes(tmp_path / "r", shots))
    for frame, shot in zip(prefetch(sequence, range(6)), shots, strict=True):
        assert isinstance(frame, Frame)
        assert_frame(frame, shot)
