"""Pictures: what is drawn where. How they look is judged by eye."""

import dataclasses
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest

from snh.errors import OutputError
from snh.frame import Camera
from snh.mesh import Mesh, box_blocks, dollhouse_view, extract_mesh, look_at, up_direction
from snh.viz import contact_sheet, map_picture, occupied_vertices, path_picture, render_mesh, save_png

WHITE, RED, BLUE = (255, 255, 255), (200, 30, 30), (30, 30, 200)
LOW, HIGH = np.array([-1.4, -0.9, -1.1]), np.array([1.4, 0.9, 1.1])
BALL = np.array([0.4, 0.5, 0.2])
UP = np.array([0.0, -1, 0])
CAMERA = Camera(60, 40, 30.0, 30.0, 29.5, 19.5)


def room_field(points: np.ndarray, with_color: bool):
    """A room with a blue ball on its floor and red walls; y points down."""
    points = points.astype(np.float64)
    walls = np.minimum(points - LOW, HIGH - points).min(axis=-1)
    ball = np.linalg.norm(points - BALL, axis=-1) - 0.4
    color = np.where((ball < walls)[:, None], BLUE, RED) / 255 if with_color else None
    return np.clip(np.minimum(walls, ball) / 0.06, -1, 1), color, np.ones(len(points), dtype=bool)


@pytest.fixture(scope="module")
def room() -> Mesh:
    return extract_mesh(room_field, box_blocks(LOW - 0.1, HIGH + 0.1, 0.04, 32), 0.04, 0.06, 32)


def square(z: float, half: float, color) -> Mesh:
    """Square that faces -z, towards a camera at the origin."""
    vertices = np.float32([[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]])
    return Mesh(vertices, np.int32([[0, 2, 1], [0, 3, 2]]), np.tile(np.uint8(color), (4, 1)))


def test_projection_of_a_square():
    """Half a metre at 1 m and f = 30: 30 pixels wide about the centre; colours as they are, seen head-on."""
    picture = render_mesh(square(1, 0.5, RED), CAMERA, np.eye(4), contact_shadows=False)
    drawn = (picture != 255).any(axis=-1)
    assert picture.shape == (40, 60, 3) and picture.dtype == np.uint8
    assert np.argwhere(drawn).min(axis=0).tolist() == [5, 15] and np.argwhere(drawn).max(axis=0).tolist() == [34, 44]
    assert drawn.sum() == 30 * 30
    assert np.abs(picture[20, 30].astype(int) - RED).max() <= 1
    shifted = render_mesh(square(1, 0.5, RED), CAMERA, look_at(np.array([0.5, 0, 0]), np.array([0.5, 0, 1]), UP))
    columns = np.nonzero((shifted != 255).any(axis=(0, 2)))[0]
    assert columns.min() == 0 and columns.max() == 29


def test_vertex_colors_are_interpolated():
    colors = np.uint8([[0, 0, 0], [200, 0, 0], [200, 200, 0], [0, 200, 0]])
    mesh = dataclasses.replace(square(1, 0.5, RED), colors=colors)
    picture = render_mesh(mesh, CAMERA, np.eye(4), contact_shadows=False).astype(float)
    light = 0.72 + 0.28 / np.sqrt(1 + (7 / 30) ** 2)
    left, right = picture[20, 22, 0] / light, picture[20, 37, 0] / light  # 7.5 of 30 pixels from each edge
    assert left == pytest.approx(50, abs=3) and right == pytest.approx(150, abs=3)


def test_back_faces_are_left_out_on_demand():
    behind = look_at(np.array([0, 0, 2.0]), np.zeros(3), UP)
    mesh = square(1, 0.5, RED)
    assert (render_mesh(mesh, CAMERA, behind) != 255).any()
    assert (render_mesh(mesh, CAMERA, behind, cull_back_faces=True) == 255).all()
    assert (render_mesh(mesh, CAMERA, np.eye(4), cull_back_faces=True) != 255).any()


def test_contact_shadows_darken_corners_only():
    """A wall of 0.3 m stands on the square: its foot is darker, the far side is not; two pictures are equal."""
    floor = square(1, 2, (200, 200, 200))
    wall = Mesh(
        np.float32([[0, -2, 1], [0, 2, 1], [0, 2, 0.7], [0, -2, 0.7]]), np.int32([[0, 1, 2], [0, 2, 3]]),
        np.full((4, 3), 200, np.uint8),
    )  # fmt: skip
    mesh = Mesh(
        np.concatenate([floor.vertices, wall.vertices]), np.concatenate([floor.faces, wall.faces + 4]),
        np.concatenate([floor.colors, wall.colors]),
    )  # fmt: skip
    plain, shaded, again = (render_mesh(mesh, CAMERA, np.eye(4), contact_shadows=on) for on in (False, True, True))
    loss = 1 - shaded.astype(float) / plain
    assert loss[10:30, 31:33].mean() > 0.15 and np.abs(loss[10:30, 50:]).max() < 0.02
    assert np.array_equal(shaded, again)


def test_nothing_to_see_is_background():
    for mesh in (Mesh.empty(), square(-1, 0.5, RED)):
        assert (render_mesh(mesh, CAMERA, np.eye(4), background=(9, 8, 7)) == [9, 8, 7]).all()


def test_dollhouse_view_shows_the_inside(room):
    shift = np.eye(4)
    shift[:3, 3] = 3, 1, -2
    room = room.transformed(shift)
    view = dollhouse_view(room, UP, 160, 120)
    assert view.T_wc[1, 3] < LOW[1] + 1  # above the ceiling; y is down
    assert np.allclose(view.T_wc[:3, :3].T @ view.T_wc[:3, :3], np.eye(3))
    points_c = (room.vertices - view.T_wc[:3, 3]) @ view.T_wc[:3, :3]
    pixels = view.camera.project(points_c)
    assert pixels.min() > 0 and (pixels < [160, 120]).all()
    assert min(np.ptp(pixels[:, 0]) / 160, 1) > 0.9 or np.ptp(pixels[:, 1]) / 120 > 0.9  # fills the picture
    picture = render_mesh(room, view.camera, view.T_wc, cull_back_faces=True).astype(int)
    blue = (picture[..., 2] > picture[..., 0] + 50).sum()
    assert blue > 200  # the ball is seen through ceiling and walls
    hidden = render_mesh(room, view.camera, view.T_wc).astype(int)
    assert (hidden[..., 2] > hidden[..., 0] + 50).sum() == 0


def test_up_is_that_of_the_floor(room):
    tilted = look_at(np.zeros(3), np.array([1.0, 0.4, 0.3]), np.array([0.1, -1, 0.2]))
    assert np.allclose(up_direction(room, tilted[None]), UP, atol=1e-3)


def test_path_picture_draws_both_paths():
    T_ref = np.tile(np.eye(4), (50, 1, 1))
    T_ref[:, 0, 3], T_ref[:, 2, 3] = np.linspace(0, 2, 50), np.sin(np.linspace(0, 3, 50))
    T_est = T_ref.copy()
    T_est[:, 2, 3] += 0.05
    errors = np.full(50, 5.0)
    errors[10:15] = np.nan
    T_ref[10:15] = np.nan
    plain = path_picture(T_est)
    both = path_picture(T_est, T_ref, errors, UP, title="a path")
    assert plain.shape == (560, 720, 3) and both.shape == (560, 1280, 3)
    grey = (both == 0xB8).all(axis=-1)
    assert grey.sum() > 1000 > 50 > (plain == 0xB8).all(axis=-1).sum()  # antialiased letters have some grey too


def pack_key(level: int, plane: int, i: int, j: int) -> int:
    return ((level << 2 | plane) << 56) | ((i + (1 << 27)) << 28) | (j + (1 << 27))


def test_occupied_vertices_by_hand():
    keys = np.array([pack_key(0, 1, -1, 2), pack_key(3, 2, 0, 0)])
    masks = np.array([1 | 1 << 10, -(1 << 63)])
    level, plane, vertices = occupied_vertices(keys, masks)
    assert level.tolist() == [0, 0, 3] and plane.tolist() == [1, 1, 2]
    assert vertices.tolist() == [[-8, 16], [-6, 17], [7, 7]]


def test_map_picture_shows_every_plane():
    keys = np.array([pack_key(level, plane, 0, 0) for level in range(2) for plane in range(3)])
    vertices = occupied_vertices(keys, np.full(6, -1))
    picture = map_picture([vertices], [0.02, 0.04], hulls=[np.array([[0, 0], [0.1, 0], [0, 0.1]])] * 3)
    colored = np.ptp(picture.astype(int), axis=-1) > 60
    thirds = np.array_split(colored[:, :1150], 3, axis=1)
    assert all(third.sum() > 1000 for third in thirds)


def test_contact_sheet_copies_pixels():
    random = np.random.default_rng(0)
    pictures = [random.integers(0, 256, (30, 40, 3), dtype=np.uint8) for _ in range(3)]
    sheet = contact_sheet(pictures, columns=2)
    assert sheet.shape == (2 * 42 + 12, 2 * 52 + 12, 3)
    for n, picture in enumerate(pictures):
        top, left = 12 + n // 2 * 42, 12 + n % 2 * 52
        assert np.array_equal(sheet[top : top + 30, left : left + 40], picture)
    assert contact_sheet(pictures, ["a", "b", "c"], columns=3).shape == (30 + 26 + 24, 3 * 52 + 12, 3)


def test_png_is_written_whole_or_not_at_all(tmp_path):
    picture = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    save_png(tmp_path / "a.png", picture)
    read = matplotlib.image.imread(tmp_path / "a.png")[..., :3]
    assert np.array_equal(np.round(255 * read), picture)
    with pytest.raises(OutputError, match=r"missing/a\.png"):
        save_png(tmp_path / "missing" / "a.png", picture)


def test_importing_draws_in_no_heavy_package():
    code = (
        "import sys, snh.mesh, snh.eval, snh.viz; print(*{'torch', 'open3d', 'trimesh', 'matplotlib'} & {*sys.modules})"
    )
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == ""
