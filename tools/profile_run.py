"""Where each millisecond of a frame goes: one run under Python's profiler, summed by part.

    python tools/profile_run.py SOURCE [-c PRESET] [-n FRAMES]

Prints milliseconds per tracked frame of each part (the first frame is left out), and per call. Frames are decoded
ahead, in the background thread that a run uses, so decoding shows only as waiting.
"""

import argparse
import cProfile
import os
import pstats
import time

import torch

from snh.config import load_config
from snh.datasets import FrameError, open_sequence, prefetch
from snh.slam import SLAM

# Part, and the end of the function names whose own time it collects; the first match counts.
PARTS = (
    ("field_map_: fused mapping step", ("snh.field_map_>",)),
    ("sparse_adam_, adam_: update of the field", ("snh.sparse_adam_>", "snh.adam_>")),
    ("hull_cells, table: room for a keyframe", ("snh.hull_cells>", "snh.hash_table_insert>", "snh.hash_table_build>")),
    ("field_track: fused tracking step", ("snh.field_track>",)),
    ("interframe: colour against the keyframe", ("snh.interframe>",)),
    ("waiting for the next frame", ("method 'acquire' of '_thread.lock' objects>",)),
    ("normal equations, poses", ("_weighted", "se3_exp", "twist_gradient", "numpy.linalg")),
    ("drawing pixels and rays", ("rays.py", "keyframes.py", "Generator")),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source")
    parser.add_argument("-c", "--config", default="fast")
    parser.add_argument("-n", "--frames", type=int, default=100)
    a = parser.parse_args()

    torch.set_num_threads(os.cpu_count() or 1)
    sequence = open_sequence(a.source, frames=a.frames)
    slam = SLAM(sequence.camera, load_config([a.config]))
    frames = (frame for frame in prefetch(sequence, range(len(sequence))) if not isinstance(frame, FrameError))
    slam.step(next(frames))

    profile = cProfile.Profile()
    start = time.perf_counter()
    profile.enable()
    for frame in frames:
        slam.step(frame)
    profile.disable()
    report(profile, len(slam.results) - 1, time.perf_counter() - start)


def report(profile: cProfile.Profile, n_frames: int, seconds: float) -> None:
    total = {name: [0.0, 0] for name, _ in PARTS}
    total["everything else in Python"] = [0.0, 0]
    stats = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    for (file, _, function), (_, n_calls, own, _, _) in stats.items():
        name = next((part for part, ends in PARTS if _is_one_of(file, function, ends)), "everything else in Python")
        total[name][0] += own
        total[name][1] += n_calls
    print(f"{n_frames} frames, {n_frames / seconds:.1f} frames/s under the profiler")
    print("| part | ms a frame | calls a frame | ms a call |\n|---|---|---|---|")
    for name, (own, n_calls) in sorted(total.items(), key=lambda item: -item[1][0]):
        print(
            f"| {name} | {1000 * own / n_frames:.2f} | {n_calls / n_frames:.1f} | {1000 * own / max(n_calls, 1):.3f} |"
        )


def _is_one_of(file: str, function: str, ends: tuple[str, ...]) -> bool:
    return any(end in function or file.endswith(end) for end in ends)


if __name__ == "__main__":
    main()
