"""The `snh-slam` command. Heavy imports happen inside the commands, so that --help answers at once."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from snh import __version__
from snh.errors import SNHError


def main(argv: list[str] | None = None) -> int:
    arguments = _parser().parse_args(argv)
    try:
        return arguments.command(arguments)
    except SNHError as error:
        print(f"snh-slam: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="snh-slam", description="Dense neural RGB-D SLAM: trajectory and coloured mesh from an RGB-D recording."
    )
    parser.add_argument("--version", action="version", version=f"snh-slam {__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="run SLAM on a recording", formatter_class=argparse.RawTextHelpFormatter,
                              epilog="example: snh-slam run recordings/kitchen -c fast -o outputs/kitchen")  # fmt: skip
    run.add_argument("source", help="folder of a recording (7-Scenes, Replica, TUM RGB-D, ScanNet, or two image\n"
                                    "folders), a .sens file, or 'builtin' for the built-in room")  # fmt: skip
    _run_options(run)
    _input_options(run)
    run.set_defaults(command=_run)

    demo = commands.add_parser("demo", help="run on the built-in room and compare with its exact ground truth")
    _run_options(demo, out="outputs/demo", frames=200)
    demo.set_defaults(command=_demo)

    mesh = commands.add_parser("mesh", help="extract the mesh of a finished run again, for example finer")
    mesh.add_argument("run", type=Path, help="output folder of 'snh-slam run'")
    mesh.add_argument("--voxel", type=float, help="edge of a marching-cubes cell, metres (default: as in the run)")
    mesh.add_argument("-o", "--out", type=Path, help="file to write, .ply or .glb (default: RUN/mesh.ply)")
    mesh.set_defaults(command=_mesh)

    evaluate = commands.add_parser("eval", help="compare a trajectory or a mesh with a reference")
    evaluate.add_argument("estimate", type=Path, help="output folder of a run, or a TUM trajectory")
    evaluate.add_argument("reference", type=Path, help="TUM trajectory, mesh file, or folder of the recording")
    evaluate.add_argument("--source", help="recording whose reference poses place a run's mesh in the reference mesh")
    evaluate.add_argument("--protocol", default="occlusion", choices=["frustum", "occlusion", "virtual"],
                          help="how both meshes are culled (default: occlusion)")  # fmt: skip
    evaluate.add_argument("--json", type=Path, help="also write the figures to this file")
    evaluate.set_defaults(command=_eval)

    doctor = commands.add_parser("doctor", help="print what is built, found and usable on this machine")
    doctor.set_defaults(command=_doctor)
    return parser


def _run_options(parser: argparse.ArgumentParser, out: str | None = None, frames: int | None = None) -> None:
    parser.add_argument("-c", "--config", action="append", default=[], metavar="PRESET",
                        help="preset or YAML file (default: fast); may be repeated, later ones win")  # fmt: skip
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE",
                        help="one setting, for example --set tracking.n_rays=512")  # fmt: skip
    parser.add_argument("-n", "--frames", type=int, default=frames, help="use at most this many frames")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, help="CPU threads (default: all cores)")
    parser.add_argument("-o", "--out", type=Path, default=out and Path(out),
                        help=f"output folder (default: {out or 'outputs/<name of the source>'})")  # fmt: skip
    parser.add_argument("--no-mesh", action="store_true", help="write the trajectory only")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress bar")


def _input_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("input")
    group.add_argument("--format", default="auto", help="auto, 7scenes, replica, tum, scannet, generic (default: auto)")
    group.add_argument("--start", type=int, help="first frame")
    group.add_argument("--stride", type=int, help="use every n-th frame")
    group.add_argument("--intrinsics", metavar="FX,FY,CX,CY|FILE", help="pinhole camera, pixels, or a calibration file")
    group.add_argument("--depth-scale", type=float, help="depth image units per metre")
    group.add_argument("--depth-max", type=float, help="ignore readings beyond so many metres")
    group.add_argument("--max-time-difference", type=float, help="seconds between colour and depth of a pair (TUM)")
    group.add_argument("--resize", metavar="WxH", help="resize the images")
    group.add_argument("--crop", type=int, help="cut this many pixels from each side")


def _sequence(a: argparse.Namespace):
    from snh.datasets import open_sequence

    names = ("start", "stride", "frames", "crop", "intrinsics", "depth_scale", "depth_max", "max_time_difference")
    options = {name: getattr(a, name) for name in names if getattr(a, name) is not None}
    if a.resize:
        width, by, height = a.resize.lower().partition("x")
        if not (by and width.isdigit() and height.isdigit()):
            raise SNHError(f"--resize must look like 640x480, got '{a.resize}'")
        options["resize"] = (int(width), int(height))
    return open_sequence(a.source, format=a.format, **options)


def _config(a: argparse.Namespace):
    from snh.config import load_config

    return load_config(a.config or ["fast"], a.set)


def _run(a: argparse.Namespace) -> int:
    from snh.run import run_sequence

    config = _config(a)
    sequence = _sequence(a)
    out = a.out or Path("outputs") / sequence.name
    return run_sequence(sequence, config, out, a.seed, a.threads, with_mesh=not a.no_mesh, quiet=a.quiet)


def _demo(a: argparse.Namespace) -> int:
    from snh.run import run_demo

    return run_demo(_config(a), a.out, a.frames, a.seed, a.threads, with_mesh=not a.no_mesh, quiet=a.quiet)


def _mesh(a: argparse.Namespace) -> int:
    from snh.run import mesh_again

    return mesh_again(a.run, a.voxel, a.out)


def _eval(a: argparse.Namespace) -> int:
    from snh.compare import compare

    return compare(a.estimate, a.reference, a.source, a.protocol, a.json)


def _doctor(a: argparse.Namespace) -> int:
    from snh.doctor import doctor

    return doctor()


if __name__ == "__main__":
    sys.exit(main())
