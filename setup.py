"""Builds the native parts with CMake and ninja; everything else is in pyproject.toml.

Environment: SNH_CUDA=auto|on|off (kernels where nvcc is found; default auto), SNH_SANITIZE=address,undefined.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
OLDEST_TORCH = (2, 10)


def stop(reason: str) -> None:
    sys.exit(f"snh-slam cannot be built: {reason}")


def check_tools() -> None:
    """One sentence, with the command that fixes it, for each thing that is missing."""
    try:
        import torch
    except ImportError:
        stop("torch is missing; run: pip install 'torch>=2.10', then pip install --no-build-isolation .")
    found = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if found < OLDEST_TORCH:
        stop(f"torch {torch.__version__} is too old; run: pip install --upgrade 'torch>=2.10'")
    if shutil.which("cmake") is None:
        stop("cmake is missing; run: pip install cmake")
    compiler = os.environ.get("CXX", "c++").split()[0]
    if shutil.which(compiler) is None:
        stop(f"the C++ compiler '{compiler}' is missing; run: sudo apt-get install g++")


class CMakeBuild(build_ext):
    def run(self) -> None:
        check_tools()
        build = ROOT / "build" / f"native-{sys.implementation.cache_tag}"
        ninja = shutil.which("ninja") or str(Path(sys.executable).parent / "ninja")
        configure = [
            "cmake", "-S", str(ROOT), "-B", str(build), "-G", "Ninja",
            f"-DCMAKE_MAKE_PROGRAM={ninja}",
            f"-DPython3_EXECUTABLE={sys.executable}",
            f"-DPython_EXECUTABLE={sys.executable}",
            f"-DSNH_CUDA={os.environ.get('SNH_CUDA', 'auto')}",
            f"-DSNH_SANITIZE={os.environ.get('SNH_SANITIZE', '')}",
        ]  # fmt: skip
        for command in (configure, ["cmake", "--build", str(build)]):
            if subprocess.call(command) != 0:
                stop(f"'{' '.join(command[:4])} ...' failed; its message stands above")
        target = ROOT / "snh" if self.inplace else Path(self.build_lib) / "snh"
        target.mkdir(parents=True, exist_ok=True)
        for library in build.glob("_*.so"):
            shutil.copy2(library, target)


setup(ext_modules=[Extension("snh._core", sources=[])], cmdclass={"build_ext": CMakeBuild})
