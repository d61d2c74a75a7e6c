"""The CUDA kernels and their torch face on CPU tensors, by the host shim (csrc/common/host_shim.h).

    with shim.kernels(schedule=2):
        plane_lookup(...)  # the same Python function; what runs are the kernels

In a build without the shim, as in an installed wheel, the tests that ask for it are skipped with the reason.
"""

import contextlib
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

import snh.ops

_LIBRARY = Path(snh.ops.__file__).parents[1] / "_shim.so"
SCHEDULES = [0, 1, 2, 3]  # ascending, descending, two seeds of shuffled blocks, warps and lanes


def require() -> None:
    """Loads the shim; skips the test that asks for it where it was not built."""
    if not _LIBRARY.exists():
        pytest.skip(f"{_LIBRARY} is missing; `make build` makes it")
    torch.ops.load_library(str(_LIBRARY))


@contextlib.contextmanager
def kernels(schedule: int = 0) -> Iterator[None]:
    """Inside, the functions of snh.ops run the kernels, their threads in the order that `schedule` names."""
    require()
    modules = [importlib.import_module(f"snh.ops.{m.name}") for m in pkgutil.iter_modules(snh.ops.__path__)]
    users = [module for module in modules if hasattr(module, "native")]
    natives = [module.native for module in users]
    torch.ops.snh_shim.set_schedule(schedule)
    try:
        for module in users:
            module.native = torch.ops.snh_shim
        yield
    finally:
        for module, native in zip(users, natives, strict=True):
            module.native = native
