"""Loads the native ops into torch.ops.snh. Imported by the modules of snh.ops and by nothing else."""

from pathlib import Path

import torch

from snh.errors import SNHError

_path = Path(__file__).resolve().parent.parent / "_ops.so"
if not _path.exists():
    raise SNHError(f"the native library {_path} is missing; build it with: pip install --no-build-isolation .")
torch.ops.load_library(str(_path))

native = torch.ops.snh
