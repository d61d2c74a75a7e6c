"""Reconstruction errors on surfaces whose answer is known by hand, and against scipy, trimesh and Open3D."""

import numpy as np
import pytest

from snh.errors import DataError
from snh.eval import (
    depth_l1,
    evaluate_reconstruction,
    hidden_surface,
    icp_alignment,
    refined,
    sample_points,
    seen_vertices,
    surface_error,
    virtual_views,
)
from snh.frame import Camera
from snh.geometry import inverse, se3_exp
from snh.mesh import Mesh, look_at

N = 20_000
CAMERA = Camera(200, 200, 100.0, 100.0, 99.5, 99.5)  # 45 degrees to each side
UP = np.array([0.0, -1, 0])


def plate(z: float, x=(-0.5, 0.5), y=(-0.5, 0.5), cells: int = 20) -> Mesh:
    """Rectangle at height z, m, split into cells x cells x 2 triangles, facing -z."""
    u, v = np.meshgrid(np.linspace(*x, cells + 1), np.linspace(*y, cells + 1), indexing="ij")
    vertices = np.stack([u, v, np.full_like(u, z)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    a, b, c, d = corner, corner + cells + 1, corner + cells + 2, corner + 1
    faces = np.concatenate([np.stack([a, c, b], -1), np.stack([a, d, c], -1)]).astype(np.int32)
    return Mesh(vertices, faces, np.full((len(vertices), 3), 128, np.uint8))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]).astype(np.int32),
        np.concatenate([mesh.colors for mesh in meshes]),
    )


def box(low, high, cells: int = 20) -> Mesh:
    """Six sides of a box, facing inwards; order: z low, z high, then the same of y and of x."""
    sides = []
    for axis in (2, 1, 0):
        first, second = (k for k in (0, 1, 2) if k != axis)
        for value in (low[axis], high[axis]):
            side = plate(0.0, (low[first], high[first]), (low[second], high[second]), cells)
            vertices = np.empty_like(side.vertices)
            vertices[:, first], vertices[:, second], vertices[:, axis] = *side.vertices[:, :2].T, value
            inward = np.cross(*(vertices[side.faces[0, k]] - vertices[side.faces[0, 0]] for k in (1, 2)))[axis]
            faces = side.faces if (inward > 0) == (value == low[axis]) else side.faces[:, ::-1]
            sides.append(Mesh(vertices, faces, side.colors))
    return joined(*sides)


def seen_faces(mesh: Mesh, *arguments) -> np.ndarray:
    """Faces [F] bool with a vertex that is seen."""
    return seen_vertices(mesh, *arguments)[mesh.faces].any(axis=1)


@pytest.mark.parametrize(("gap", "f1"), [(0.02, 0.0), (0.008, 100.0)])
def test_two_planes_at_a_known_distance(gap, f1):
    error = surface_error(plate(gap), plate(0), N, "surface")
    assert error.accuracy_cm == pytest.approx(100 * gap, rel=1e-4)
    assert error.completion_cm == pytest.approx(100 * gap, rel=1e-4)
    assert error.completion_ratio_5cm_pct == 100 and error.f1_1cm_pct == pytest.approx(f1)


def test_half_of_the_reference():
    """Reference 1 m wide, mesh half of it: the missing points are 0..50 cm away, 10 % of them within 5 cm."""
    error = surface_error(plate(0, x=(-0.5, 0)), plate(0), N, "surface")
    noise = 100 * 0.5 / np.sqrt(N)  # one deviation of a share of N points
    assert error.accuracy_cm == pytest.approx(0, abs=1e-4)
    assert error.completion_cm == pytest.approx(12.5, abs=3 * noise)
    assert error.completion_ratio_5cm_pct == pytest.approx(55, abs=3 * noise)
    recall = 51.0
    assert error.f1_1cm_pct == pytest.approx(2 * 100 * recall / (100 + recall), abs=3 * noise)


def test_distance_between_points_has_the_floor_of_their_spacing():
    """Mean distance to the nearest of n random points per unit area is 0.5 / sqrt(n); triangles have no such floor."""
    error = surface_error(plate(0), plate(0), N, "points")
    assert error.accuracy_cm == pytest.approx(100 * 0.5 / np.sqrt(N), rel=0.05)
    assert surface_error(plate(0), plate(0), N, "surface").accuracy_cm < 1e-4
    assert error.f1_1cm_pct == 100  # always exact


def test_distances_agree_with_independent_code():
    trimesh = pytest.importorskip("trimesh")
    spatial = pytest.importorskip("scipy.spatial", reason="scipy is not installed; it only judges this test")
    room, other = box([0, 0, 0], [1, 2, 1.5], 4), box([0.03, -0.01, 0], [1, 2, 1.46], 3)
    points, points_ref = sample_points(other, 3000, 7), sample_points(room, 3000, 8)
    error = surface_error(other, room, 3000, "points", seed=7)
    nearest, _ = spatial.cKDTree(points_ref).query(points)
    nearest_ref, _ = spatial.cKDTree(points).query(points_ref)
    assert error.accuracy_cm == pytest.approx(100 * nearest.mean(), rel=1e-9)
    assert error.completion_cm == pytest.approx(100 * nearest_ref.mean(), rel=1e-9)
    assert error.completion_ratio_5cm_pct == pytest.approx(100 * np.mean(nearest_ref < 0.05))
    shape = trimesh.Trimesh(room.vertices, room.faces, process=False)
    _, exact, _ = trimesh.proximity.closest_point_naive(shape, points[:500])
    assert np.allclose(room.scene.distance(points[:500]), exact, atol=1e-6)  # float32 at 2 m


def test_points_are_drawn_by_area_and_repeatably():
    mesh = joined(plate(0, cells=3), plate(1, x=(-1.5, 1.5), cells=50))
    points = sample_points(mesh, N, 0)
    assert np.mean(points[:, 2] < 0.5) == pytest.approx(0.25, abs=0.01)
    assert np.allclose(points[points[:, 2] > 0.5].std(axis=0)[:2], [3 / np.sqrt(12), 1 / np.sqrt(12)], rtol=0.02)
    assert np.array_equal(points, sample_points(mesh, N, 0)) and not np.array_equal(points, sample_points(mesh, N, 1))
    one = Mesh(np.float32([[0, 0, 0], [3, 0, 0], [0, 3, 0]]), np.int32([[0, 1, 2]]), np.zeros((3, 3), np.uint8))
    assert np.allclose(sample_points(one, N, 0).mean(axis=0), [1, 1, 0], atol=0.02)


def test_icp_brings_a_shifted_room_back():
    room = box([-1, -0.7, -0.5], [1, 0.7, 0.8])
    T = se3_exp(np.array([0.03, -0.02, 0.02, 0.005, 0.01, -0.01]))
    found = icp_alignment(room.transformed(inverse(T)), room, N)
    left = inverse(found) @ T  # sampling noise of the pairs is some millimetres
    assert np.linalg.norm(left[:3, 3]) < 0.006 and np.linalg.norm(left[:3, :3] - np.eye(3)) < 0.006


def hiding_plates() -> Mesh:
    """Seen from the origin: a plate of 1 m at z = 1 hides the plate of 1 m at z = 2, and a plate stands outside."""
    return joined(plate(1), plate(2), plate(1, x=(3, 4)))


def test_protocols_keep_what_they_say():
    mesh, eye = hiding_plates(), np.eye(4)[None]
    front, back, outside = np.split(np.arange(len(mesh.faces)), 3)
    keeps = {name: seen_faces(mesh, CAMERA, eye, name) for name in ("frustum", "occlusion")}
    assert keeps["frustum"][front].all() and keeps["frustum"][back].all() and not keeps["frustum"][outside].any()
    assert keeps["occlusion"][front].all() and not keeps["occlusion"][back].any()
    between = look_at(np.array([0.0, 0, 1.2]), np.array([0.0, 0, 2]), UP)[None]
    virtual = seen_faces(mesh, CAMERA, eye, "virtual", between)
    assert virtual[front].all() and virtual[back].all() and not virtual[outside].any()
    for protocol, extra in (("virtual", None), ("occlusion", between)):
        with pytest.raises(ValueError, match="virtual"):
            seen_faces(mesh, CAMERA, eye, protocol, extra)


def test_a_moved_and_turned_camera_sees_what_is_before_it():
    mesh = hiding_plates()
    front, back, outside = np.split(np.arange(len(mesh.faces)), 3)
    moved = look_at(np.array([3.5, 0, 0]), np.array([3.5, 0, 1]), UP)[None]
    keeps = seen_faces(mesh, CAMERA, moved, "frustum")
    assert keeps[outside].all() and not keeps[front].any()
    turned = look_at(np.array([-1.0, 0, 1]), np.array([0, 0, 1.0]), UP)[None]  # along the plates, from their side
    keeps = seen_faces(mesh, CAMERA, turned, "frustum")
    assert keeps[front].all() and keeps[outside].all() and 0 < keeps[back].sum() < len(back)


def test_occlusion_leaves_three_centimetres():
    eye = np.eye(4)[None]
    for gap, kept in ((0.025, True), (0.035, False)):
        mesh = joined(plate(1), plate(1 + gap, x=(-0.3, 0.3), y=(-0.3, 0.3)))
        faces = seen_faces(mesh, CAMERA, eye, "occlusion")[len(plate(1).faces) :]
        assert faces.all() if kept else not faces.any()


def test_depth_range_of_a_view():
    for z, kept in ((-1, False), (0.005, False), (9.9, True), (10.1, False)):
        assert seen_faces(plate(z, cells=100), CAMERA, np.eye(4)[None], "frustum").any() == kept


def test_hidden_surface_by_hand():
    """Half of what is inside the view is hidden; the reconstruction has a part of it."""
    reference, eye = joined(plate(1), plate(2), plate(1, x=(3, 4))), np.eye(4)[None]
    noise = 100 * 0.5 / np.sqrt(N / 3)
    for mesh, expected in ((plate(1), 0), (joined(plate(1), plate(2, x=(-0.5, 0))), 55), (reference, 100)):
        hidden = hidden_surface(mesh, reference, CAMERA, eye, N)
        assert hidden.share_pct == pytest.approx(50, abs=4 * noise)
        assert hidden.completion_ratio_5cm_pct == pytest.approx(expected, abs=4 * noise)
        assert np.isnan(hidden.near_completion_ratio_5cm_pct)  # 1 m behind what is seen


def test_hidden_surface_near_seen_surface():
    """Back plates 10 cm and 1 m behind the seen one; only the near one is reconstructed."""
    reference = joined(plate(1), plate(1.1), plate(2))
    hidden = hidden_surface(joined(plate(1), plate(1.1)), reference, CAMERA, np.eye(4)[None], N)
    assert hidden.completion_ratio_5cm_pct == pytest.approx(50, abs=2)
    assert hidden.near_completion_ratio_5cm_pct == 100
    assert hidden.share_pct == pytest.approx(200 / 3, abs=2)


def test_nothing_hidden_is_said_so():
    hidden = hidden_surface(plate(1), plate(1), CAMERA, np.eye(4)[None], 1000)
    assert hidden.share_pct == 0 and np.isnan(hidden.completion_ratio_5cm_pct)


def wide(z: float) -> Mesh:
    return plate(z, (-9, 9), (-9, 9), 2)


def test_depth_l1_by_hand():
    eye = np.eye(4)[None]
    error = depth_l1(wide(2.03), wide(2), eye)
    assert error.depth_l1_cm == pytest.approx(3, rel=1e-4) and error.missing_pct == 0 and error.n_views == 1
    half = plate(2.03, (-9, 0), (-9, 9), 2)  # the other half counts with its depth of 2 m
    error = depth_l1(half, wide(2), eye)
    assert error.missing_pct == pytest.approx(50, abs=0.2)
    assert error.depth_l1_cm == pytest.approx((3 + 200) / 2, rel=0.005)


def test_depth_l1_counts_the_given_faces_only():
    reference = joined(plate(1, (-9, 0), (-9, 9), 2), plate(2, (0, 9), (-9, 9), 2))
    counted = np.arange(len(reference.faces)) >= len(reference.faces) // 2
    error = depth_l1(wide(2.03), reference, np.eye(4)[None], counted)
    assert error.depth_l1_cm == pytest.approx(3, rel=1e-4)
    away = look_at(np.zeros(3), np.array([0.0, 0, -1]), UP)
    assert depth_l1(wide(2.03), wide(2), np.stack([np.eye(4), away])).n_views == 1
    with pytest.raises(DataError, match="No virtual view"):
        depth_l1(wide(2), wide(2), away[None])


def test_virtual_views_stand_in_the_open_middle():
    room = joined(box([0, 0, 0], [4, 2.5, 3], 4), box([1.5, 1.5, 1], [2.5, 2.5, 2], 4))
    frame = look_at(np.array([0.5, 0.5, 0.5]), np.array([2.0, 1.5, 1.5]), UP)[None]
    poses = virtual_views(room, frame, 200, UP, seed=3)
    places = poses[:, :3, 3]
    assert poses.shape == (200, 4, 4) and np.allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.eye(3))
    # Box 4 x 2.5 (height, y down) x 3: 0.7 of the ground, 0.3 of the height, lifted by 0.4 m.
    assert places.min(axis=0) == pytest.approx([0.6, 0.475, 0.45], abs=0.1)
    assert places.max(axis=0) == pytest.approx([3.4, 1.225, 2.55], abs=0.1)
    assert np.abs(poses[:, :3, 2].mean(axis=0)).max() < 0.15  # every direction
    assert np.array_equal(poses, virtual_views(room, frame, 200, UP, seed=3))
    with pytest.raises(DataError, match="open space"):
        virtual_views(room, frame + 99 * np.eye(4)[3] * np.eye(4)[:, :1], 5, UP)


def test_large_triangles_are_refined_without_moving():
    fine = refined(wide(2), 0.5)
    edges = fine.vertices[fine.faces] - fine.vertices[np.roll(fine.faces, 1, axis=1)]
    assert np.linalg.norm(edges, axis=-1).max() <= 0.5
    assert fine.area() == pytest.approx(18 * 18, rel=1e-5) and np.all(fine.vertices[:, 2] == 2)


@pytest.mark.parametrize("protocol", ["frustum", "occlusion", "virtual"])
def test_all_errors_of_a_room_with_a_missing_side(protocol):
    """A perfect room without its ceiling: nothing is inaccurate, what is missing is counted."""
    reference = box([0, 0, 0], [4, 2.5, 3])
    ceiling = np.isclose(reference.vertices[reference.faces][..., 1], 0).all(axis=1)
    centers = np.array([[1.5, 1.2, 1], [2.5, 1.2, 2], [2, 1, 1.5], [1.5, 1.3, 2]])
    targets = np.array([[4, 1.2, 3], [0, 1.2, 0], [2, 0.4, 3], [3, 2.5, 0]])
    T_wc = np.array([look_at(center, target, UP) for center, target in zip(centers, targets, strict=True)])
    T_wc = np.concatenate([T_wc, np.full((1, 4, 4), np.nan)])
    mesh = reference.select_faces(~ceiling)
    whole = evaluate_reconstruction(reference, reference, CAMERA, T_wc, protocol, "surface", True, N, n_views=4)
    assert whole["accuracy_cm"] < 0.2 and whole["completion_ratio_5cm_pct"] == 100  # ICP of samples moves millimetres
    assert whole["f1_1cm_pct"] > 99.9 and whole["depth_l1_cm"] < 0.5 and whole["n_views"] == 4
    error = evaluate_reconstruction(mesh, reference, CAMERA, T_wc, protocol, "surface", False, N, n_views=4)
    assert error["accuracy_cm"] < 1e-3 and error["protocol"] == protocol
    kept = seen_faces(reference, CAMERA, T_wc[:4], "occlusion")
    if protocol == "occlusion":
        lost = reference.select_faces(kept & ceiling).area() / reference.select_faces(kept).area()
        assert 100 - error["completion_ratio_5cm_pct"] == pytest.approx(100 * lost, abs=2.5)  # a strip of 5 cm is near
    assert error["missing_pct"] > 1 and error["depth_l1_cm"] > 1


def test_border_of_what_is_seen():
    """A face counts for the surface if any corner is seen and for the depth if all are. Of the mesh, which has the
    latter faces only, the fringe is missing, but no pixel."""
    reference = refined(box([0, 0, 0], [4, 2.5, 3], 4))
    T_wc = look_at(np.array([1, 1.2, 1]), np.array([4, 1.2, 2.5]), UP)[None]
    mesh = reference.select_faces(seen_vertices(reference, CAMERA, T_wc, "frustum")[reference.faces].all(axis=1))
    error = evaluate_reconstruction(mesh, reference, CAMERA, T_wc, "frustum", "surface", n_points=N, n_views=10)
    assert error["accuracy_cm"] < 1e-3
    assert 0.005 < error["completion_cm"] < 0.2
    assert error["missing_pct"] < 1e-2 and error["depth_l1_cm"] < 1e-2


def test_nothing_to_evaluate_is_refused():
    room = box([0, 0, 0], [4, 2.5, 3])
    with pytest.raises(DataError, match="Nothing to evaluate"):
        evaluate_reconstruction(Mesh.empty(), room, CAMERA, np.eye(4)[None])
    with pytest.raises(DataError, match="Nothing to evaluate"):
        evaluate_reconstruction(room, room, CAMERA, np.full((3, 4, 4), np.inf))
    with pytest.raises(DataError, match="one world"):
        evaluate_reconstruction(
            room.transformed(se3_exp(np.array([99.0, 0, 0, 0, 0, 0]))),
            room,
            CAMERA,
            look_at(np.ones(3), np.array([2.0, 1, 2]), UP)[None],
            n_points=100,
        )
