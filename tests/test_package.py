"""The public names, and how little the package loads before they are used."""

import subprocess
import sys

import pytest

import snh


@pytest.mark.parametrize("name", snh.__all__)
def test_public_names(name):
    assert getattr(snh, name).__name__ == name


def test_unknown_name():
    with pytest.raises(AttributeError, match="module 'snh' has no attribute 'Slam'"):
        _ = snh.Slam


@pytest.mark.parametrize("start", ["import snh", "import snh.cli; snh.cli._parser().format_help()"])
def test_starting_loads_nothing_heavy(start):
    program = f"{start}; import sys; print(*sorted({{'torch', 'cv2', 'open3d', 'numpy', 'yaml'}} & set(sys.modules)))"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == []
