"""Builds the native parts with CMake and ninja; everything else is in pyproject.toml.

Environment:
  SNH_CUDA=auto|on|off            kernels where nvcc is found (default auto)
  SNH_CUDA_ARCHITECTURES=all|90|...  devices that the kernels are built for (default: this machine's; where it has none,
                                  75, which newer devices translate at the first start)
  SNH_SANITIZE=address,undefined  sanitizers, for the tests
  SNH_BUILD=FOLDER                where CMake builds (default build/native-<python>), kept for the next build
  CMAKE_ARGS="-D... -D..."        passed on to CMake, for example -DEigen3_DIR=...
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NoReturn

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).resolve().parent
OLDEST_TORCH = (2, 10)
CUDA = os.environ.get("SNH_CUDA") or "auto"
OWN_ARCHITECTURE = "native" if Path("/dev/nvidiactl").exists() else "75"
ARCHITECTURES = os.environ.get("SNH_CUDA_ARCHITECTURES") or OWN_ARCHITECTURE


def stop(reason: str) -> NoReturn:
    sys.exit(f"snh-slam cannot be built: {reason}")


def tool(name: str) -> str:
    """Path of a program that pip can install: the one of this environment, active or not, before any other."""
    own = Path(sys.executable).parent / name
    found = str(own) if own.exists() else shutil.which(name)
    return found or stop(f"{name} is missing; run: pip install {name}")


def check_requirements() -> None:
    """One sentence, with the command that fixes it, for each thing that is missing."""
    try:
        import torch
    except ImportError:
        stop("torch is missing; run: pip install 'torch>=2.10', then pip install --no-build-isolation .")
    found = tuple(int(part) for part in torch.__version__.split("+")[0].split(".")[:2])
    if found < OLDEST_TORCH:
        stop(f"torch {torch.__version__} is too old; run: pip install --upgrade 'torch>=2.10'")
    try:
        import pybind11  # noqa: F401
    except ImportError:
        stop("pybind11 is missing; run: pip install pybind11")
    compilers = [os.environ["CXX"].split()[0]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    if not any(shutil.which(compiler) for compiler in compilers):
        stop(f"the C++ compiler '{compilers[0]}' is missing; run: sudo apt-get install g++")
    if CUDA not in ("auto", "on", "off"):
        stop(f"SNH_CUDA={CUDA} is none of auto, on, off; run: export SNH_CUDA=auto")


def run(command: list[str]) -> None:
    """Runs CMake; what CMakeLists.txt itself refuses becomes our one sentence, anything else keeps its own message."""
    result = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    if result.returncode == 0:
        sys.stderr.write(result.stderr)
        return
    refusal = re.search(r"SNH: (.+?)\n\n", result.stderr, re.DOTALL)
    if refusal:
        stop(" ".join(refusal[1].split()))
    sys.stderr.write(result.stderr)
    stop(f"'{shlex.join(command[:3])} ...' failed; its message stands above")


class CMakeBuild(build_ext):
    def run(self) -> None:
        check_requirements()
        cmake, ninja = tool("cmake"), tool("ninja")
        build = Path(os.environ.get("SNH_BUILD") or ROOT / "build" / f"native-{sys.implementation.cache_tag}")
        shim = bool(self.inplace or os.environ.get("SNH_SANITIZE"))  # for tests, never for a wheel
        run([
            cmake, "-S", str(ROOT), "-B", str(build), "-G", "Ninja", "--log-level=NOTICE",
            f"-DCMAKE_MAKE_PROGRAM={ninja}",
            f"-DPython3_EXECUTABLE={sys.executable}",
            f"-DSNH_CUDA={CUDA}",
            f"-DSNH_CUDA_ARCHITECTURES={ARCHITECTURES}",
            f"-DSNH_SHIM={'ON' if shim else 'OFF'}",
            f"-DSNH_SANITIZE={os.environ.get('SNH_SANITIZE', '')}",
            *shlex.split(os.environ.get("CMAKE_ARGS", "")),
        ])  # fmt: skip
        run([cmake, "--build", str(build)])
        target = ROOT / "snh" if self.inplace else Path(self.build_lib) / "snh"
        target.mkdir(parents=True, exist_ok=True)
        for library in build.glob("_*.so"):
            if library.name == "_shim.so" and not shim:
                continue
            # A new file, not new contents: a process that has the old library loaded goes on undisturbed.
            (target / library.name).unlink(missing_ok=True)
            shutil.copy2(library, target)


setup(ext_modules=[Extension("snh._core", sources=[])], cmdclass={"build_ext": CMakeBuild})
