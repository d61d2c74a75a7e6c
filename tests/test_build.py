"""The build: what is missing is said in one sentence, the wheel works outside the repository, C++ can use the core."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
SITE = sysconfig.get_path("purelib")
NATIVE = ROOT / "build" / f"native-{sys.implementation.cache_tag}"


def program(name: str) -> str:
    """Path of a program of this environment, active or not, or else of the system."""
    path = shutil.which(name, path=os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]))
    assert path, f"{name} is missing"
    return path


def run(*command: str | Path, cwd: Path | None = None, **env: str) -> subprocess.CompletedProcess[str]:
    clean = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "LD_PRELOAD")}
    return subprocess.run(list(command), cwd=cwd, env={**clean, **env}, capture_output=True, text=True)


def output_of(*command: str | Path, **kwargs) -> str:
    result = run(*command, **kwargs)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture
def bare_python(tmp_path: Path) -> Path:
    """An interpreter whose folder, the only one on PATH, holds no tools; the packages of this one are importable."""
    python = tmp_path / "bin" / "python"
    python.parent.mkdir()
    python.symlink_to(Path(sys.executable).resolve())
    return python


def refusal(python: Path, fakes: Path | None = None, **env: str) -> str:
    """What setup.py says when it stops; `fakes` is a folder of packages that stand before the real ones."""
    path = os.pathsep.join([*([str(fakes)] if fakes else []), SITE])
    build = str(python.parent.parent / "build")
    result = run(
        python, "setup.py", "--quiet", "build_ext", "--build-lib", build,
        cwd=ROOT, **{"PATH": str(python.parent), "PYTHONPATH": path, "SNH_BUILD": build, **env},
    )  # fmt: skip
    assert result.returncode == 1, result.stdout + result.stderr
    sentences = [line for line in result.stderr.splitlines() if line.startswith("snh-slam cannot be built: ")]
    assert len(sentences) == 1 and "Traceback" not in result.stderr, result.stderr
    return sentences[0]


def fake_module(folder: Path, name: str, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / f"{name}.py").write_text(text)
    return folder


def put_on_path(folder: Path, *names: str) -> None:
    """Puts the real programs into the otherwise empty folder that is PATH."""
    for name in names:
        (folder / name).symlink_to(program(name))


@pytest.mark.parametrize(
    ("module", "text", "sentence"),
    [
        ("torch", "raise ImportError", "torch is missing; run: pip install 'torch>=2.10'"),
        ("torch", "__version__ = '2.9.1+cu128'", "torch 2.9.1+cu128 is too old; run: pip install --upgrade"),
        ("pybind11", "raise ImportError", "pybind11 is missing; run: pip install pybind11"),
    ],
)
def test_missing_package(bare_python, tmp_path, module, text, sentence):
    fakes = fake_module(tmp_path / "fakes", "torch", "__version__ = '2.10.0'")
    assert sentence in refusal(bare_python, fake_module(fakes, module, text))


@pytest.mark.parametrize(
    ("present", "env", "sentence"),
    [
        ([], {}, "the C++ compiler 'c++' is missing; run: sudo apt-get install g++"),
        (["c++"], {"CXX": "g++-99 -m64"}, "the C++ compiler 'g++-99' is missing"),
        (["c++"], {"SNH_CUDA": "yes"}, "SNH_CUDA=yes is none of auto, on, off"),
        (["c++"], {}, "cmake is missing; run: pip install cmake"),
        (["c++", "cmake"], {}, "ninja is missing; run: pip install ninja"),
    ],
)
def test_missing_tool(bare_python, tmp_path, present, env, sentence):
    put_on_path(bare_python.parent, *present)
    fakes = fake_module(tmp_path / "fakes", "torch", "__version__ = '2.10.0'")
    assert sentence in refusal(bare_python, fakes, **env)


@pytest.mark.parametrize(
    ("env", "sentence"),
    [
        (
            {"CMAKE_ARGS": "-DCMAKE_DISABLE_FIND_PACKAGE_Eigen3=ON"},
            "Eigen 3.3 or newer was not found; install it with: sudo apt-get install libeigen3-dev",
        ),
        ({"SNH_CUDA": "on", "CMAKE_ARGS": "-DCMAKE_CUDA_COMPILER=NOTFOUND"}, "SNH_CUDA=on but"),
    ],
)
def test_refusals_of_cmake_become_the_sentence(bare_python, tmp_path, env, sentence):
    put_on_path(bare_python.parent, "cmake", "ninja")
    fakes = fake_module(tmp_path / "fakes", "torch", "__version__ = '2.10.0'")
    assert sentence in refusal(bare_python, fakes, **{"PATH": os.environ["PATH"], **env})


@pytest.fixture(scope="module")
def fresh_python(tmp_path_factory) -> Path:
    """The interpreter of a new environment with the wheel installed; other packages are borrowed from this one."""
    folder = tmp_path_factory.mktemp("wheel")
    for stale in (ROOT / "build").glob("lib.*"):  # setuptools would pack what it built before and is gone since
        shutil.rmtree(stale)
    pip = [sys.executable, "-m", "pip", "--quiet"]
    output_of(*pip, "wheel", "--no-build-isolation", "--no-deps", "--wheel-dir", folder, ROOT)
    output_of(sys.executable, "-m", "venv", "--without-pip", folder / "venv")
    python = folder / "venv" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    output_of(*pip, "--python", python, "install", "--no-deps", "--no-index", wheel)
    site = Path(output_of(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
    (site / "borrowed.pth").write_text(SITE)
    return python


def test_wheel_works_outside_the_repository(fresh_python, tmp_path):
    program = """
import torch, snh
from snh.ops import ray_sample
print(ray_sample(torch.tensor([2.0]), torch.full((1, 4), 0.5), n_base=2, n_surface=2).tolist())
print(snh.__file__)
"""
    z, place = output_of(fresh_python, "-c", program, cwd=tmp_path).splitlines()
    assert z.startswith("[[0.6150")
    assert Path(place).is_relative_to(fresh_python.parent.parent)


def test_wheel_has_the_presets(fresh_python, tmp_path):
    program = "import importlib.resources as r; print(*sorted(p.name for p in (r.files('snh') / 'configs').iterdir()))"
    packaged = output_of(fresh_python, "-c", program, cwd=tmp_path).split()
    assert packaged == sorted(path.name for path in (ROOT / "configs").glob("*.yaml"))


def test_command_of_the_wheel(fresh_python, tmp_path):
    assert "usage" in output_of(fresh_python.parent / "snh-slam", "--help", cwd=tmp_path).lower()


def test_cpp_program_uses_the_installed_core(tmp_path):
    cmake = program("cmake")
    output_of(cmake, "--install", NATIVE, "--prefix", tmp_path / "prefix", "--component", "cpp")
    folder = tmp_path / "consumer"
    output_of(cmake, "-S", ROOT / "tests" / "cpp", "-B", folder, f"-DCMAKE_PREFIX_PATH={tmp_path / 'prefix'}")
    output_of(cmake, "--build", folder)
    assert output_of(folder / "consumer") == "0.6150 1.8050 1.9700 2.0300\n13 -1\n"


def test_simd_objects_define_symbols_of_their_own_namespace_only():
    """An inline function of everybody's that was compiled for AVX-512 and not inlined is a weak symbol; the linker may
    choose it for all callers, and an older processor crashes."""
    objects = sorted(NATIVE.glob("CMakeFiles/snh_simd_*.dir/**/*.o"))
    if not objects:
        pytest.skip("no op has a SIMD variant")
    strangers = []
    for path in objects:
        instruction_set = re.search(r"snh_simd_(\w+)\.dir", str(path))[1]
        defined = re.findall(r"^\S+ [TWVuDB] (.*)$", output_of("nm", "-C", path), re.MULTILINE)
        strangers += [
            (path.name, name) for name in defined if f"snh::{instruction_set}::" not in name.partition("(")[0]
        ]
    assert not strangers
