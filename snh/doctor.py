"""`snh-slam doctor`: what is built, found and usable on this machine."""

from __future__ import annotations

import importlib.metadata
import os
import platform

import torch

from snh import __version__, _core
from snh.config import preset_folder, presets


def doctor() -> int:
    """Prints one line for each thing that a problem report needs."""
    rows = [
        ("snh-slam", __version__),
        ("python", platform.python_version()),
        ("torch", f"{torch.__version__}, {torch.get_num_threads()} of {os.cpu_count()} threads"),
        *((name, _version(name)) for name in ("numpy", "opencv-python-headless", "open3d", "trimesh")),
        (
            "CUDA kernels",
            "built" if _core.built_with_cuda else "not built (SNH_CUDA=on builds them where nvcc is found)",
        ),
        ("CUDA device", torch.cuda.get_device_name() if torch.cuda.is_available() else "none that torch can use"),
        ("presets", f"{', '.join(presets())} in {preset_folder()}"),
    ]
    width = max(len(name) for name, _ in rows)
    print("\n".join(f"  {name:<{width}}  {value}" for name, value in rows))
    return 0


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "missing"
