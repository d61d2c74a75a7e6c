"""Errors of a mesh against a reference mesh.

The literature evaluates the part of both meshes that could be seen, by one of three protocols whose numbers must not
be mixed. A face is kept when a vertex of it is

    frustum     inside the view of a frame, 1 cm to 10 m deep                                    (NICE-SLAM)
    occlusion   and not more than 3 cm behind what the frame sees of the same mesh               (Neural RGB-D, GO-Surf)
    virtual     or seen so by one of some extra cameras, which look where no frame did           (Co-SLAM)

Reference and reconstruction are culled the same way. The extra cameras of Co-SLAM are files that exist for Replica
only; ours are drawn by `virtual_views`, so numbers of this protocol are only roughly comparable across papers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np

from snh.errors import DataError
from snh.frame import Camera
from snh.mesh.mesh import Mesh
from snh.mesh.raycast import RayScene
from snh.mesh.views import look_at, up_direction

Protocol = Literal["frustum", "occlusion", "virtual"]
Distance = Literal["points", "surface"]

_NEAR, _FAR = 0.01, 10.0  # m, depth range of a view when culling
_OCCLUSION_EPS = 0.03  # m
_VIRTUAL_CAMERA = Camera(250, 250, 150.0, 150.0, 124.5, 124.5)  # the literature's, 500 x 500, at half resolution
_VIRTUAL_FAR = 19.0  # m; deeper reference pixels are not counted
_MIN_PIXELS = 25  # a virtual view with fewer counted pixels (100 of 500 x 500) says nothing
_NEAR_OBSERVED = 0.2  # m, how far a field can be asked to continue the surface it saw


@dataclass(frozen=True)
class SurfaceError:
    """Distances between two surfaces from `n_points` points drawn on each.

    accuracy: mean distance from the reconstruction to the reference; completion: the other way; completion ratio:
    share of the reference within 5 cm. By `distance`: to the nearest drawn point of the other ("points", what the
    literature prints; its floor is about half the spacing of the points, 1.4 cm for 200,000 on 150 m^2), or to
    the other's triangles ("surface", exact). F1 at 1 cm is always by "surface".
    """

    accuracy_cm: float
    completion_cm: float
    completion_ratio_5cm_pct: float
    f1_1cm_pct: float
    distance: Distance
    n_points: int


@dataclass(frozen=True)
class HiddenSurface:
    """How much of the reference that lies inside the views of frames but that none sees is within 5 cm of the mesh.

    share_pct: how much of the reference inside the views that is. near_...: only of hidden surface within
    20 cm of seen surface. NaN where there is no such surface.
    """

    completion_ratio_5cm_pct: float
    near_completion_ratio_5cm_pct: float
    share_pct: float


@dataclass(frozen=True)
class DepthError:
    """Mean |depth difference| over the counted pixels of virtual views; a pixel where the reconstruction has nothing
    counts with its whole depth, as in the literature. missing_pct: share of these pixels."""

    depth_l1_cm: float
    missing_pct: float
    n_views: int


def evaluate_reconstruction(
    mesh: Mesh,
    reference: Mesh,
    camera: Camera,
    T_wc: np.ndarray,
    protocol: Protocol = "occlusion",
    distance: Distance = "points",
    icp: bool = False,
    n_points: int = 200_000,
    n_views: int = 200,
    seed: int = 0,
) -> dict[str, float | int | str | bool]:
    """All errors of `mesh` against `reference`, both in the reference's world, by name.

    camera, T_wc [M, 4, 4]: the reference views of the frames; the literature takes every second. icp: align the mesh
    by `icp_alignment` first. n_views: virtual views of depth L1, 1000 in the literature. Surface errors are those of
    both meshes culled by `protocol`. Depth and hidden surface are measured on the whole mesh, depth where all of the
    reference's face is seen: occlusion culling cuts holes into a noisy mesh and fringes its border.
    """
    T_wc = T_wc[np.isfinite(T_wc).all(axis=(1, 2))]
    if len(mesh.faces) == 0 or len(reference.faces) == 0 or len(T_wc) == 0:
        raise DataError("Nothing to evaluate: a mesh without faces, or no frame with a valid reference pose.")
    mesh, reference = refined(mesh), refined(reference)
    if icp:
        mesh = mesh.transformed(icp_alignment(mesh, reference, n_points, seed))
    up = up_direction(reference, T_wc)
    extra = virtual_views(reference, T_wc, 30, up, seed + 1) if protocol == "virtual" else None
    seen_mesh = seen_vertices(mesh, camera, T_wc, protocol, extra)[mesh.faces]
    seen_reference = seen_vertices(reference, camera, T_wc, protocol, extra)[reference.faces]
    if not seen_mesh.any() or not seen_reference.any():
        raise DataError(f"No frame sees the mesh and the reference, by protocol {protocol}; are they in one world?")
    culled, culled_reference = (
        m.select_faces(s.any(axis=1)) for m, s in ((mesh, seen_mesh), (reference, seen_reference))
    )
    surface = surface_error(culled, culled_reference, n_points, distance, seed)
    hidden = hidden_surface(mesh, reference, camera, T_wc, n_points, seed)
    views = virtual_views(reference, T_wc, n_views, up, seed)
    depth = depth_l1(mesh, reference, views, counted=seen_reference.all(axis=1))
    return {
        "protocol": protocol,
        "icp": icp,
        **asdict(surface),
        **asdict(depth),
        **{f"hidden_{name}": value for name, value in asdict(hidden).items()},
    }


def refined(mesh: Mesh, max_edge: float = 0.05) -> Mesh:
    """The same surface, without colour, with edges of at most `max_edge` m, so that culling by vertices is fine."""
    import trimesh

    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, max_edge, max_iter=20)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.zeros((len(vertices), 3), np.uint8))


def sample_points(mesh: Mesh, n_points: int, seed: int) -> np.ndarray:
    """Points [n_points, 3] float64 drawn uniformly by area."""
    random = np.random.default_rng(seed)
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=-1))
    face = np.searchsorted(area, random.uniform(0, area[-1], n_points), side="right")
    face = np.minimum(face, len(area) - 1)
    s, t = random.uniform(size=(2, n_points, 1))
    s = np.sqrt(s)  # makes (s, t) uniform over the triangle
    return (1 - s) * a[face] + s * (1 - t) * b[face] + s * t * c[face]


def surface_error(
    mesh: Mesh, reference: Mesh, n_points: int = 200_000, distance: Distance = "points", seed: int = 0
) -> SurfaceError:
    """Accuracy, completion, completion ratio at 5 cm and F1 at 1 cm of two meshes as they are, not culled."""
    points, points_ref = sample_points(mesh, n_points, seed), sample_points(reference, n_points, seed + 1)
    exact, exact_ref = reference.scene.distance(points), mesh.scene.distance(points_ref)
    if distance == "points":
        to_reference, to_mesh = _nearest(points, points_ref), _nearest(points_ref, points)
    else:
        to_reference, to_mesh = exact, exact_ref
    precision, recall = np.mean(exact < 0.01), np.mean(exact_ref < 0.01)
    return SurfaceError(
        accuracy_cm=float(100 * to_reference.mean()),
        completion_cm=float(100 * to_mesh.mean()),
        completion_ratio_5cm_pct=float(100 * np.mean(to_mesh < 0.05)),
        f1_1cm_pct=float(100 * 2 * precision * recall / max(precision + recall, 1e-12)),
        distance=distance,
        n_points=n_points,
    )


def _nearest(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance of each point [N, 3] to the nearest of `others` [M, 3], m."""
    return np.asarray(_cloud(points).compute_point_cloud_distance(_cloud(others)))


def _cloud(points: np.ndarray):
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))


def icp_alignment(
    mesh: Mesh, reference: Mesh, n_points: int = 200_000, seed: int = 0, reach: float = 0.1
) -> np.ndarray:
    """Rigid motion [4, 4] of `mesh` towards `reference` by point-to-point ICP over pairs within `reach` m."""
    import open3d as o3d

    points, points_ref = sample_points(mesh, n_points, seed), sample_points(reference, n_points, seed + 1)
    return o3d.pipelines.registration.registration_icp(
        _cloud(points), _cloud(points_ref), reach, np.eye(4)
    ).transformation.copy()


def visibility(
    points: np.ndarray, scene: RayScene | None, camera: Camera, T_wc: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which points [N, 3] are (inside a view [N] bool, seen by a view [N] bool) of the frames T_wc [M, 4, 4].

    Seen: at most 3 cm deeper than the first surface of `scene` on the ray to the point; scene None: inside is seen.
    """
    inside, seen = np.zeros(len(points), dtype=bool), np.zeros(len(points), dtype=bool)
    for T in T_wc:
        asked = np.nonzero(~seen)[0]  # a point that a frame has seen is settled
        points_c = points[asked] @ T[:3, :3] - T[:3, 3] @ T[:3, :3]
        within = _in_view(points_c, camera)
        asked, z = asked[within], points_c[within, 2]
        inside[asked] = True
        if scene is not None:
            first = scene.cast(T[:3, 3], points[asked] - T[:3, 3]).t  # 1 at the point itself
            asked = asked[(1 - first) * z <= _OCCLUSION_EPS]
        seen[asked] = True
    return inside, seen


def _in_view(points_c: np.ndarray, camera: Camera) -> np.ndarray:
    """Which points [N, 3] of the camera frame are in its image and depth range, [N] bool."""
    within = (points_c[:, 2] > _NEAR) & (points_c[:, 2] < _FAR)
    pixels = camera.project(points_c[within])
    within[within] = ((pixels > -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=-1)
    return within


def seen_vertices(
    mesh: Mesh, camera: Camera, T_wc: np.ndarray, protocol: Protocol, T_wc_virtual: np.ndarray | None = None
) -> np.ndarray:
    """Vertices [V] bool that the frames T_wc [M, 4, 4] see in the sense of a protocol.

    T_wc_virtual [K, 4, 4]: the extra cameras of protocol "virtual", and of no other.
    """
    if (protocol == "virtual") != (T_wc_virtual is not None):
        raise ValueError("extra cameras belong to protocol 'virtual', and it needs them")
    scene = None if protocol == "frustum" else mesh.scene
    _, seen = visibility(mesh.vertices, scene, camera, T_wc)
    if T_wc_virtual is not None:
        seen |= visibility(mesh.vertices, scene, _VIRTUAL_CAMERA, T_wc_virtual)[1]
    return seen


def hidden_surface(
    mesh: Mesh, reference: Mesh, camera: Camera, T_wc: np.ndarray, n_points: int = 200_000, seed: int = 0
) -> HiddenSurface:
    """Completion of the reference surface inside the views of the frames T_wc [M, 4, 4] that no frame sees."""
    points = sample_points(reference, n_points, seed)
    inside, seen = visibility(points, reference.scene, camera, T_wc)
    hidden = points[inside & ~seen]
    if len(hidden) == 0:
        return HiddenSurface(np.nan, np.nan, 0.0)
    complete = mesh.scene.distance(hidden) < 0.05
    near = _nearest(hidden, points[seen]) < _NEAR_OBSERVED
    return HiddenSurface(
        completion_ratio_5cm_pct=float(100 * complete.mean()),
        near_completion_ratio_5cm_pct=float(100 * complete[near].mean()) if near.any() else np.nan,
        share_pct=float(100 * len(hidden) / inside.sum()),
    )


def virtual_views(reference: Mesh, T_wc: np.ndarray, n_views: int, up: np.ndarray, seed: int = 0) -> np.ndarray:
    """Poses [n_views, 4, 4] of cameras in random directions from random places of the reference.

    Places as in the literature: the upright box of the reference scaled by 0.7 (height 0.3) and lifted by 0.4 m; of
    these only places that a frame of T_wc [M, 4, 4] sees, so that none is inside a wall or a cupboard. up [3]: unit.
    Raises DataError when such places are too rare to be found.
    """
    random = np.random.default_rng(seed)
    scene = reference.scene
    center, axes, extents = _upright_box(
        reference.vertices[:: 1 + len(reference.vertices) // 20_000].astype(np.float64), up
    )
    poses: list[np.ndarray] = []
    for _ in range(100):
        offsets = random.uniform(-0.5, 0.5, (n_views, 3)) * extents * [0.7, 0.7, 0.3]
        places = center + offsets @ axes + 0.4 * up
        directions = random.normal(size=(n_views, 3))
        for place, direction in zip(places[_open_to_frames(places, scene, T_wc, random)], directions, strict=False):
            poses.append(look_at(place, place + direction, up))
        if len(poses) >= n_views:
            return np.array(poses[:n_views])
    raise DataError("Virtual views need open space in the middle of the reference that a frame sees; there is none.")


def _open_to_frames(places: np.ndarray, scene: RayScene, T_wc: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Which places [N, 3] a straight line joins with the centre of one of 20 frames drawn from T_wc; [N] bool."""
    centers = T_wc[random.integers(len(T_wc), size=20), :3, 3]
    lines = centers[None] - places[:, None]
    return np.any(scene.cast(places[:, None], lines).t >= 1, axis=1)


def _upright_box(points: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(centre [3], axes [3, 3] in rows with `up` last, extents [3]) of the upright box of least ground area."""
    side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    side /= np.linalg.norm(side)
    forward = np.cross(up, side)
    best = None
    for angle in np.radians(np.arange(0, 90, 2)):
        axes = np.stack(
            [np.cos(angle) * side + np.sin(angle) * forward, np.cos(angle) * forward - np.sin(angle) * side, up]
        )
        local = points @ axes.T
        low, high = local.min(axis=0), local.max(axis=0)
        area = np.prod((high - low)[:2])
        if best is None or area < best[0]:
            best = area, (low + high) / 2 @ axes, axes, high - low
    assert best is not None
    return best[1:]


def depth_l1(mesh: Mesh, reference: Mesh, T_wc: np.ndarray, counted: np.ndarray | None = None) -> DepthError:
    """Depth L1 of the virtual views T_wc [M, 4, 4] (79.6 degrees wide).

    counted: faces [F] bool of the reference whose pixels count, by default all; the others still hide what is
    behind them. Views with fewer than 25 such pixels (0.04 %) are left out. Raises DataError when all are.
    """
    if counted is None:
        counted = np.ones(len(reference.faces), dtype=bool)
    errors, missing = [], []
    for T in T_wc:
        directions = _VIRTUAL_CAMERA.rays() @ T[:3, :3].T
        hits = reference.scene.cast(T[:3, 3], directions)
        pixels = (hits.face >= 0) & (hits.t < _VIRTUAL_FAR) & counted[hits.face]
        if pixels.sum() < _MIN_PIXELS:
            continue
        t = mesh.scene.cast(T[:3, 3], directions[pixels]).t
        found = np.isfinite(t)
        errors.append(np.abs(np.where(found, t, 0) - hits.t[pixels]).mean())
        missing.append(np.mean(~found))
    if not errors:
        raise DataError("No virtual view sees enough of the reference to measure depth L1.")
    return DepthError(float(100 * np.mean(errors)), float(100 * np.mean(missing)), len(errors))
