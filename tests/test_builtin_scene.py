"""The built-in scene: depth of rays worked by hand, mesh against depth, paths that a person could walk, determinism."""

import numpy as np
import open3d as o3d
import pytest

from snh import _core
from snh.datasets import open_sequence
from snh.datasets.builtin import N_VARIANTS, BuiltinSequence, builtin_path
from snh.errors import DataError
from snh.geometry import inverse


@pytest.fixture(scope="module")
def rooms():
    return [_core.BuiltinRoom(0), _core.BuiltinRoom(1)]


def pose(position, forward, right) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T


def depth_of(room, T_wc, focal=500.0, size=9):
    """Small image whose middle pixel looks along the camera's axis."""
    return room.render(T_wc, size, size, focal, focal, size // 2, size // 2)[1]


HAND_WORKED = {
    "ceiling": ((0, 0.9, 1.5), (0, 0, 1), (1, 0, 0), 2.7 - 1.5),
    "floor": ((0.9, 1.0, 1.5), (0, 0, -1), (1, 0, 0), 1.5),
    "screen, a box 3.5 cm thick with its middle at y = 1.82": ((0.25, 0.5, 0.84), (0, 1, 0), (1, 0, 0), 1.8025 - 0.5),
}


@pytest.mark.parametrize("case", HAND_WORKED)
def test_flat_faces_have_one_depth_in_the_whole_image(rooms, case):
    position, forward, right, expected = HAND_WORKED[case]
    np.testing.assert_allclose(depth_of(rooms[0], pose(position, forward, right)), expected, atol=1e-6)


def test_sphere_by_hand(rooms):
    # The lamp: radius 0.16 around (1.35, -0.55, 1.95), seen from 1 m in front of its middle.
    depth = depth_of(rooms[0], pose((1.35, -1.55, 1.95), (0, 1, 0), (1, 0, 0)), focal=40.0)
    assert depth[4, 4] == pytest.approx(0.84, abs=1e-6)
    # One pixel aside: |(t/40, t - 1)| = 0.16, the smaller root of (1 + 1/1600) t^2 - 2 t + 1 - 0.0256 = 0.
    a = 1 + 1 / 1600
    assert depth[4, 5] == pytest.approx((1 - np.sqrt(1 - a * (1 - 0.0256))) / a, abs=1e-6)


def test_cylinder_by_hand(rooms):
    # The lamp's pole: radius 1.2 cm around the vertical through (-2.15, -1.62); at z = 1 nothing stands before it.
    depth = depth_of(rooms[0], pose((-1.0, -1.62, 1.0), (-1, 0, 0), (0, 1, 0)))
    assert depth[4, 4] == pytest.approx(1.15 - 0.012, abs=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_every_ray_hits_and_ends_on_the_surface(rooms, number):
    for forward in np.concatenate([np.eye(3), -np.eye(3)]):
        right = np.roll(np.abs(forward), 1)
        T = pose((0.0, 0.3, 1.4), forward, right)
        _, depth = rooms[number].render(T, 40, 40, 19.5, 19.5, 19.5, 19.5)  # 90 degrees wide: six of these see all
        assert (depth > 0).all()
        u, v = np.meshgrid(np.arange(40), np.arange(40))
        rays = np.stack([(u - 19.5) / 19.5, (v - 19.5) / 19.5, np.ones_like(u)], axis=-1).reshape(-1, 3)
        ends = (rays * depth.reshape(-1, 1)) @ T[:3, :3].T + T[:3, 3]
        # float32 depth of at most 5 m: 3e-7 m, times the rays' length of at most 1.8.
        assert np.abs(rooms[number].signed_distance(ends)).max() < 2e-6
        halfway = (rays * depth.reshape(-1, 1) * 0.5) @ T[:3, :3].T + T[:3, 3]
        assert (rooms[number].signed_distance(halfway) > 0).all()


@pytest.mark.parametrize("variant", [0, 2])
def test_mesh_agrees_with_depth_and_faces_the_viewer(variant):
    sequence = BuiltinSequence(variant, n_frames=200, width=160, height=120)
    vertices, faces = sequence.ground_truth_mesh()
    caster = o3d.t.geometry.RaycastingScene(nthreads=1)
    caster.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(faces.astype(np.uint32)))
    for index in (0, 70, 140):
        T, (_, depth) = sequence.reference()[index], sequence.render(sequence.reference()[index])
        rays_d = sequence.camera.rays().reshape(-1, 3) @ T[:3, :3].T
        rays = np.concatenate([np.broadcast_to(T[:3, 3], rays_d.shape), rays_d], axis=1).astype(np.float32)
        hits = caster.cast_rays(o3d.core.Tensor(rays), nthreads=1)
        along_normal = (hits["primitive_normals"].numpy() * rays_d).sum(1)
        error = np.abs((np.minimum(hits["t_hit"].numpy(), 9) - depth.reshape(-1)) * along_normal)
        assert np.mean(error < 1e-3) > 0.998  # the rest: outlines of curved parts, whose chords lie inside
        assert np.median(error) < 1e-6
        assert np.mean(along_normal < 0) > 0.999


@pytest.mark.parametrize("number", [0, 1])
def test_mesh_lies_on_free_surface(rooms, number):
    vertices, faces = rooms[number].mesh()
    low, high = rooms[number].bounds
    middle = vertices[faces].mean(1).astype(np.float64)
    assert (middle > low - 1e-4).all() and (middle < high + 1e-4).all()
    a, b, c = vertices[faces].transpose(1, 0, 2).astype(np.float64)
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1) / 2
    distance = rooms[number].signed_distance(middle)
    assert distance.max() < 1e-5  # chords never bulge out
    assert area[distance > -1e-3].sum() > 0.99 * area.sum()
    ahead = rooms[number].signed_distance(middle + 3e-3 * normal / (2 * area[:, None]))
    assert area[ahead > 0].sum() > 0.97 * area.sum()  # the rest: triangles of a centimetre half under another solid
    low_sides, high_sides = high - low, np.roll(high - low, 1)
    assert 2 * (low_sides * high_sides).sum() < area.sum() < 200  # m^2: more than the empty room, less than everything


@pytest.mark.parametrize("variant", range(N_VARIANTS))
def test_path_is_one_that_a_hand_could_hold(rooms, variant):
    poses = builtin_path(variant, 600)
    R = poses[:, :3, :3]
    np.testing.assert_allclose(R.transpose(0, 2, 1) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert (np.linalg.det(R) > 0).all()
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = np.degrees(np.arccos(np.clip((np.einsum("nij,nij->n", R[:-1], R[1:]) - 1) / 2, -1, 1)))
    assert steps.max() < 0.03 and turns.max() < 1.5
    assert turns[:199].sum() > 120  # 200 frames look around the room
    assert R[:, 2, 1].max() < -0.5  # the camera stays upright: its y axis points down
    assert rooms[variant // 2].signed_distance(poses[:, :3, 3]).min() > 0.3
    np.testing.assert_array_equal(poses[:50], builtin_path(variant, 50))  # length changes nothing


def test_frames_repeat_and_threads_change_nothing(rooms):
    one, two = (BuiltinSequence(1, n_frames=4, width=96, height=72, noise="kinect", seed=5) for _ in range(2))
    for a, b in zip((one[3], one[1]), (two[3], two[1]), strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
    other = BuiltinSequence(1, n_frames=4, width=96, height=72, noise="kinect", seed=6)
    assert (other[3].depth != one[3].depth).mean() > 0.3  # quantised: many readings coincide
    T = builtin_path(0, 1)[0]
    single, several = (rooms[0].render(T, 96, 72, 80, 80, 47.5, 35.5, n_threads=n) for n in (1, 3))
    np.testing.assert_array_equal(single[0], several[0])
    np.testing.assert_array_equal(single[1], several[1])


def test_frames_agree_with_each_other():
    """Depth and colour of one frame, moved by the poses, are those of another: poses, depth and axes fit together."""
    sequence = BuiltinSequence(0, n_frames=21, width=320, height=240)
    a, b = sequence[0], sequence[20]
    points = a.camera.rays() * a.depth[..., None]
    T = inverse(b.T_wc_ref) @ a.T_wc_ref
    moved = points @ T[:3, :3].T + T[:3, 3]
    uv = np.rint(a.camera.project(moved)).astype(int)
    inside = (uv >= 0).all(-1) & (uv[..., 0] < 320) & (uv[..., 1] < 240) & (moved[..., 2] > 0)
    u, v = uv[inside].T
    error = np.abs(b.depth[v, u] - moved[inside][:, 2])
    assert inside.mean() > 0.5
    assert np.mean(error < 0.02) > 0.9  # the rest is hidden in one of the frames
    difference = np.abs(b.rgb[v, u].astype(int) - a.rgb[inside].astype(int)).mean(1)
    assert np.median(difference[error < 0.02]) < 4  # grey levels: half a pixel of rounding on textures


def test_protocol_and_text_variants():
    sequence = BuiltinSequence("2:kinect", n_frames=3, width=64, height=48)
    assert (len(sequence), sequence.name, sequence.reference().shape) == (3, "builtin-2-kinect", (3, 4, 4))
    frame = sequence[2]
    assert (frame.index, frame.timestamp) == (2, pytest.approx(2 / 30))
    assert frame.rgb.shape == (48, 64, 3) and frame.rgb.dtype == np.uint8
    assert frame.depth.shape == (48, 64) and frame.depth.dtype == np.float32
    np.testing.assert_array_equal(frame.T_wc_ref, sequence.reference()[2])
    assert sequence.camera.fx == 52.5
    assert open_sequence("builtin:kinect").name == "builtin-0-kinect"
    with pytest.raises(IndexError):
        sequence[3]


@pytest.mark.parametrize(
    "arguments", [{"variant": 4}, {"variant": "x:kinect"}, {"noise": "snow"}, {"n_frames": 0}, {"width": 4}]
)
def test_what_does_not_exist_is_refused_in_one_sentence(arguments):
    with pytest.raises(DataError, match=r"^the [^\n]*$"):
        BuiltinSequence(**arguments)


def test_native_arguments_are_checked(rooms):
    with pytest.raises(ValueError, match="two built-in rooms"):
        _core.BuiltinRoom(2)
    with pytest.raises(ValueError, match=r"T_wc must have shape \[4, 4\]"):
        rooms[0].render(np.eye(3), 8, 8, 8, 8, 4, 4)
    with pytest.raises(ValueError, match=r"points must have shape \[N, 3\]"):
        rooms[0].signed_distance(np.zeros((2, 2)))
    with pytest.raises(ValueError, match=r"at least 0\.005 m"):
        rooms[0].mesh(0)
