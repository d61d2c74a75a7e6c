"""tools/render_sequence.py on a tiny room that the test writes itself."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image

from snh.datasets import open_sequence
from snh.errors import DataError

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tools"))
import render_sequence
from glb_scene import GlbScene, MipTextures

COLORS = np.uint8([[[250, 0, 0], [0, 250, 0]], [[0, 0, 250], [250, 250, 0]]])  # upper row, lower row


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """4 x 2.6 x 3 m around the origin, y up, plain; on the wall at z = -1.5 a picture 1 m wide in four colours."""
    box = trimesh.creation.box((4, 2.6, 3))
    box.invert()
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(baseColorFactor=[200, 190, 180, 255])
    )
    corners = np.array([[-0.5, -0.5, -1.49], [0.5, -0.5, -1.49], [0.5, 0.5, -1.49], [-0.5, 0.5, -1.49]])
    texture = Image.fromarray(COLORS.repeat(64, 0).repeat(64, 1))
    picture = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    picture.visual = trimesh.visual.TextureVisuals(
        uv=[[0, 0], [1, 0], [1, 1], [0, 1]], material=trimesh.visual.material.PBRMaterial(baseColorTexture=texture)
    )
    path = tmp_path_factory.mktemp("scene") / "room.glb"
    trimesh.Scene({"room": box, "picture": picture}).export(path)
    return path


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Path:
    """Eight poses with the axes of a camera: y down, a step of 5 cm to the right each, turning by 2 degrees."""
    lines = []
    for k in range(8):
        half = np.radians(2 * k) / 2
        lines.append(f"{k} {0.05 * k} 0 0 0 {np.sin(half)} 0 {np.cos(half)}")
    path = tmp_path_factory.mktemp("path") / "walk.txt"
    path.write_text("# index x y z qx qy qz qw\n" + "\n".join(lines) + "\n")
    return path


def run(room, walk, out, *options):
    render_sequence.main([str(room), str(walk), str(out), "--size", "64x48", "--frames", "6", *options])
    return out


def wall_depth(T_wc, camera) -> np.ndarray:
    """Depth to the inside of the box by hand: along each axis a ray meets the wall that it flies toward."""
    rays = camera.rays().astype(np.float64) @ T_wc[:3, :3].T
    with np.errstate(divide="ignore"):
        return ((np.sign(rays) * [2, 1.3, 1.5] - T_wc[:3, 3]) / rays).min(-1)


@pytest.fixture(scope="module")
def rendered(room, walk, tmp_path_factory) -> Path:
    return run(room, walk, tmp_path_factory.mktemp("out") / "sequence")


def test_layout_is_what_the_reader_reads(rendered):
    names = sorted(p.name for p in (rendered / "results").iterdir())
    assert names == [f"depth{k:06d}.png" for k in range(6)] + [f"frame{k:06d}.jpg" for k in range(6)]
    camera = json.loads((rendered / "cam_params.json").read_text())["camera"]
    assert camera == {"w": 64, "h": 48, "fx": 52.5, "fy": 52.5, "cx": 31.5, "cy": 23.5, "scale": 6553.5}
    sequence = open_sequence(rendered)
    assert len(sequence) == 6
    np.testing.assert_allclose(sequence.reference(), np.loadtxt(rendered / "traj.txt").reshape(-1, 4, 4))
    assert len(trimesh.load(rendered / "mesh.ply").faces) == 14


def test_depth_is_exact(rendered):
    sequence = open_sequence(rendered)
    for frame in (sequence[0], sequence[5]):
        expected = wall_depth(frame.T_wc_ref, frame.camera)
        error = np.abs(frame.depth - expected)
        assert np.mean(error < 0.6 / 6553.5) > 0.7  # half a count
        # The picture hangs 1 cm in front of the wall, so seen at up to 60 degrees it is at most 2 cm nearer.
        assert error.max() < 0.02 + 1 / 6553.5


def test_path_keeps_its_shape_and_its_clearance(rendered, walk):
    poses = np.loadtxt(rendered / "traj.txt").reshape(-1, 4, 4)
    given = render_sequence.read_path(walk)[:6]
    for k in range(5):  # motions from frame to frame are those of the path
        np.testing.assert_allclose(
            np.linalg.inv(poses[k]) @ poses[k + 1], np.linalg.inv(given[k]) @ given[k + 1], atol=1e-7
        )
    assert (np.abs(poses[:, :3, 3]) <= np.array([2, 1.3, 1.5]) - 0.4).all()
    np.testing.assert_allclose(-poses[:, 1, 1], 1, atol=1e-9)  # level: the camera's y points against the scene's up


def test_picture_is_the_right_way_round(room):
    scene = GlbScene(room)
    camera = render_sequence.make_camera("64x48")
    T = np.diag([1.0, -1, -1, 1])  # from the origin toward -z, x to the right
    rgb, _ = scene.render(camera, T)
    for v, u, color in ((14, 22, COLORS[0, 0]), (14, 41, COLORS[0, 1]), (33, 22, COLORS[1, 0]), (33, 41, COLORS[1, 1])):
        assert np.argmax(rgb[v, u]) == np.argmax(color) and rgb[v, u].min() < 5
    ratio = rgb[33, 41].astype(float)
    assert ratio[0] == pytest.approx(ratio[1], rel=0.02)  # yellow keeps its tone under the light


def test_texture_sampling_by_hand():
    textures = MipTextures([COLORS, np.full((1, 1, 3), 7, np.uint8)])
    sample = lambda t, u, v, f: textures.sample(  # noqa: E731
        np.array([t]), np.float32([[u, v]]), np.float32([f])
    )[0]
    np.testing.assert_allclose(sample(0, 0.25, 0.75, 0.5), COLORS[0, 0])  # middle of the upper left texel
    np.testing.assert_allclose(sample(0, 0.5, 0.75, 0.5), (COLORS[0, 0] * 0.5 + COLORS[0, 1] * 0.5))
    np.testing.assert_allclose(sample(0, 1.25, -0.25, 0.5), COLORS[0, 0])  # wraps around
    mean = COLORS.reshape(-1, 3).mean(0)
    np.testing.assert_allclose(sample(0, 0.25, 0.75, 2.0), mean, atol=1)  # a pixel as wide as the texture
    np.testing.assert_allclose(
        sample(0, 0.25, 0.75, np.sqrt(2)), (mean + COLORS[0, 0]) / 2, atol=1
    )  # half way between two levels
    np.testing.assert_allclose(sample(1, 0.3, 0.9, 100.0), 7)


def test_turning_upright_from_any_world():
    tilted = render_sequence.AXES
    for axis in tilted:  # the camera's down along each axis of the old world
        forward = np.roll(np.abs(axis), 1)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([np.cross(axis, forward), axis, forward], axis=1)
        for up in (1, 2):
            turned = render_sequence.turn_upright(pose[None], up)
            np.testing.assert_allclose(turned[0, :3, 1], -np.eye(3)[up], atol=1e-12)
            assert np.linalg.det(turned[0, :3, :3]) == pytest.approx(1)


def test_clearance_of_a_lopsided_path(room):
    """Most of this path lies to one side of its centre, so a mirrored one would have another clearance."""
    grid = render_sequence.ClearanceGrid(GlbScene(room))
    offsets = np.array([[-0.2, 0, 0], [0.5, 0.1, -0.3], [0.6, 0, -0.4]])
    clearance = grid.of_path(offsets)
    for position in ([1.0, 0.2, 0.3], [-1.0, -0.3, 0.9], [0.1, 0.2, 0.1]):
        index = np.rint((np.array(position) - grid.low) / render_sequence.GRID).astype(int)
        points = grid.low + index * render_sequence.GRID + offsets
        expected = (np.array([2, 1.3, 1.5]) - np.abs(points)).min()
        assert clearance[tuple(index)] == pytest.approx(expected, abs=0.012)  # the picture is 1 cm thick
    assert clearance[-5, 10, 20] == 0  # reaches out of the room


def test_a_path_that_does_not_fit_says_what_is_reachable(room, walk, tmp_path):
    with pytest.raises(DataError, match=r"does not fit .* clearance of 1\.40 m; about 1\.[012]\d m is reachable"):
        run(room, walk, tmp_path / "out", "--clearance", "1.4")
    assert not (tmp_path / "out").exists()
    wide = tmp_path / "wide.txt"
    wide.write_text("".join(f"{k} {0.8 * k} 0 0 0 0 0 1\n" for k in range(6)))
    with pytest.raises(DataError, match="does not fit"):
        run(room, wide, tmp_path / "out")
    run(room, wide, tmp_path / "out", "--shrink", "0.5")
    poses = np.loadtxt(tmp_path / "out" / "traj.txt").reshape(-1, 4, 4)
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) == pytest.approx([0.4] * 5)


def test_sensors_and_selection(room, walk, tmp_path):
    a, b = (run(room, walk, tmp_path / n, "--kinect", "--blur", "--exposure", "--seed", "3") for n in "ab")
    for name in ("depth000004.png", "frame000004.jpg"):
        assert (a / "results" / name).read_bytes() == (b / "results" / name).read_bytes()
    depth = cv2.imread(str(a / "results" / "depth000000.png"), cv2.IMREAD_UNCHANGED) / 6553.5
    expected = wall_depth(np.loadtxt(a / "traj.txt")[0].reshape(4, 4), render_sequence.make_camera("64x48"))
    seen = depth > 0
    assert 0.7 < seen.mean() < 1
    assert 2e-4 < np.median(np.abs(depth - expected)[seen]) < 0.1  # exact depth is good to 0.8e-4
    run(room, walk, tmp_path / "c", "--start", "2", "--stride", "3")
    assert len(np.loadtxt(tmp_path / "c" / "traj.txt")) == 2


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("none.glb", "walk"), "scene .*none.glb does not exist"),
        (("room", "none.txt"), "camera path .*none.txt does not exist"),
        (("room", "short.txt"), "needs 8 numbers a line"),
        (("room", "words.txt"), "is not a table of numbers"),
        (("words.txt", "walk"), "cannot be read as GLB"),
        (("room", "walk", "--start", "100"), "past the end"),
        (("room", "walk", "--size", "640"), "is not WIDTHxHEIGHT"),
    ],
)
def test_bad_input_is_one_sentence(room, walk, tmp_path, arguments, sentence):
    (tmp_path / "short.txt").write_text("0 1 2 3\n")
    (tmp_path / "words.txt").write_text("not numbers\n")
    known = {"room": room, "walk": walk}
    scene, path = (str(known.get(name, tmp_path / name)) for name in arguments[:2])
    with pytest.raises(DataError, match=sentence):
        render_sequence.main([scene, path, str(tmp_path / "out"), *arguments[2:]])
    assert not (tmp_path / "out").exists()
