"""SNH-SLAM: tracking and mapping, frame by frame."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch

from snh import ops
from snh.config import Config
from snh.errors import DataError
from snh.frame import Camera, Frame
from snh.geometry import inverse, orthonormal
from snh.nn import SceneField
from snh.slam.alignment import main_directions
from snh.slam.keyframes import KeyframeLibrary
from snh.slam.mapper import Mapper
from snh.slam.pyramid import Pyramid
from snh.slam.rays import clean_depth
from snh.slam.tracker import Reference, Tracked, Tracker

DARK = 4  # mean of an 8-bit colour image below which it carries no information


@dataclass(frozen=True)
class FrameResult:
    """What became of one frame."""

    index: int
    T_wc: np.ndarray  # [4, 4] as known when the frame was tracked
    status: str  # ok | first | no depth | no colour | lost
    is_keyframe: bool
    residual_cm: float
    inlier_share: float
    track_ms: float
    map_ms: float


class SLAM:
    """Dense neural RGB-D SLAM.

        slam = SLAM(camera)
        for rgb, depth in stream:            # [H, W, 3] uint8, [H, W] float32 m, 0 = no reading
            T_wc = slam.track(rgb, depth)    # [4, 4] camera to world; the first camera is at its origin

    Two instances with equal config, seed, number of threads and frames give equal results, bit for bit.
    """

    def __init__(self, camera: Camera, config: Config | None = None, seed: int = 0):
        self.camera = camera
        self.config = config or Config()
        rng = np.random.default_rng(seed)
        self.field = SceneField(field_spec(self.config), seed=seed)
        self.keyframes = KeyframeLibrary(self.config.keyframes, camera, rng)
        self.tracker = Tracker(self.config, self.field, camera, rng)
        self.mapper = Mapper(self.config, self.field, self.keyframes, rng)
        self.results: list[FrameResult] = []
        self._anchors: list[tuple[int, np.ndarray]] = []  # per frame: keyframe k and T_kc
        self._reference: Reference | None = None

    def track(self, rgb: np.ndarray, depth: np.ndarray, timestamp: float | None = None) -> np.ndarray:
        """Takes the next frame and returns its pose T_wc [4, 4].

        rgb [H, W, 3] uint8, depth [H, W] float32 z-depth in metres, 0 = no reading.
        """
        index = len(self.results)
        frame = Frame(index, index / 30 if timestamp is None else timestamp, rgb, depth, self.camera)
        return self.step(frame).T_wc

    def step(self, frame: Frame) -> FrameResult:
        """One frame through the method (figure 1 of the paper)."""
        start = time.perf_counter()
        depth = clean_depth(frame.depth, self.config.input)
        if not self.results:
            return self._first_frame(frame, depth, start)

        # Where is the camera? Constant motion (eq. 12), then the map's surface and the newest keyframe (eq. 13-14).
        status = self._usable(frame, depth)
        starts = self._predictions()
        if status == "no depth":
            tracked = Tracked(starts[0], float("nan"), 0.0, Pyramid(frame.rgb, self.camera))
        else:
            tracked = self.tracker.track(frame, depth, starts, None if status == "no colour" else self._reference)
            if tracked.inlier_share < 0.2:
                status = "lost"
        k = len(self.keyframes) - 1
        self._anchors.append((k, inverse(self.keyframes.T_wc[k]) @ tracked.T_wc))
        track_ms = 1000 * (time.perf_counter() - start)

        # Every few frames: make room in the map (eq. 1-3), then field and poses together (eq. 4-11).
        is_keyframe = status == "ok" and self._mapping_is_due(frame)
        if is_keyframe:
            self._map(frame, depth, tracked, self.config.mapping.iterations)
        map_ms = 1000 * (time.perf_counter() - start) - track_ms
        return self._record(frame, status, tracked, is_keyframe, track_ms, map_ms)

    def _first_frame(self, frame: Frame, depth: np.ndarray, start: float) -> FrameResult:
        if not depth.any():
            raise DataError(
                f"frame {frame.index} is the first and has no depth reading between {self.config.input.depth_min} and "
                f"{self.config.input.depth_max} m; start at a later frame or check the depth scale"
            )
        T_wc = np.eye(4)
        if self.config.map.level_axes:
            T_wc[:3, :3] = main_directions(depth, self.camera)
        self._anchors.append((0, np.eye(4)))
        tracked = Tracked(T_wc, 0.0, 1.0, Pyramid(frame.rgb, self.camera))
        self._map(frame, depth, tracked, self.config.mapping.first_iterations)
        map_ms = 1000 * (time.perf_counter() - start)
        return self._record(frame, "first", tracked, True, 0.0, map_ms)

    def _usable(self, frame: Frame, depth: np.ndarray) -> str:
        if np.count_nonzero(depth[::4, ::4]) < 16:
            return "no depth"
        return "no colour" if frame.rgb[::8, ::8].mean() < DARK else "ok"

    def _predictions(self) -> list[np.ndarray]:
        """Initial poses: constant motion T_{t-1} T_{t-2}^-1 T_{t-1} (eq. 12), and standing still."""
        last = self._pose(len(self._anchors) - 1)
        if len(self._anchors) < 2:
            return [last]
        before = self._pose(len(self._anchors) - 2)
        return [orthonormal(last @ inverse(before) @ last), last]

    def _mapping_is_due(self, frame: Frame) -> bool:
        return frame.index - self.keyframes.frame_index[-1] >= self.config.mapping.every

    def _map(self, frame: Frame, depth: np.ndarray, tracked: Tracked, n_iterations: int) -> None:
        T_wc = tracked.T_wc
        points_c = self.camera.rays() * depth[..., None]
        points_w = points_c[depth > 0] @ T_wc[:3, :3].T.astype(np.float32) + T_wc[:3, 3].astype(np.float32)
        self.field.encoding.allocate_hull(
            torch.from_numpy(points_w), torch.from_numpy(T_wc[:3, 3].astype(np.float32)), self.config.map.hull_scale
        )
        k = self.keyframes.add(frame, depth, T_wc, self.config.mapping.edge_depth)
        self._anchors[-1] = (k, np.eye(4))
        self.mapper.optimise(self.keyframes.window(), n_iterations)
        self._reference = Reference(tracked.colors, self.keyframes.T_wc[k])

    def _record(
        self, frame: Frame, status: str, tracked: Tracked, is_keyframe: bool, track_ms: float, map_ms: float
    ) -> FrameResult:
        result = FrameResult(
            frame.index, self._pose(len(self._anchors) - 1), status, is_keyframe,
            tracked.residual_cm, tracked.inlier_share, track_ms, map_ms,
        )  # fmt: skip
        self.results.append(result)
        return result

    def _pose(self, i: int) -> np.ndarray:
        k, T_kc = self._anchors[i]
        return self.keyframes.T_wc[k] @ T_kc

    def trajectory(self) -> np.ndarray:
        """Poses T_wc [N, 4, 4] of all frames so far; frames between keyframes follow their corrected keyframe."""
        return np.stack([self._pose(i) for i in range(len(self._anchors))])


def field_spec(config: Config) -> ops.FieldSpec:
    """The part of the configuration that the field and its ops need."""
    c = config.map
    return ops.FieldSpec(
        cell_sizes=c.cell_sizes, n_features=c.n_features, n_octaves=c.n_octaves, base_wavelength=c.base_wavelength,
        hidden=c.hidden, n_geometry=c.n_geometry, truncation=c.truncation,
        sharpness=c.sharpness or 1 / c.truncation, cut_behind=c.cut_behind,
    )  # fmt: skip
