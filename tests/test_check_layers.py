"""tools/check_layers.py refuses what it is for."""

import importlib.util
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parent.parent / "tools" / "check_layers.py"


@pytest.fixture
def layers(tmp_path, monkeypatch):
    spec = importlib.util.spec_from_file_location("check_layers", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "PACKAGE", tmp_path / "snh")
    return module


def write(folder: Path, name: str, text: str) -> None:
    path = folder / "snh" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("slam/tracker.py", "from snh.ops import field_track\nfrom snh.slam.window import Window\nimport torch"),
        ("cli.py", "def main():\n    from snh.slam import SLAM"),
        ("datasets/replica.py", "import cv2\nfrom ..frame import Frame\nfrom . import sequence"),
        ("__init__.py", "from snh.slam import SLAM"),
    ],
)
def test_downward_imports_pass(layers, tmp_path, capsys, name, text):
    write(tmp_path, name, text)
    assert layers.main() == 0, capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("ops/field.py", "from snh.nn import Decoder", "ops must not import nn"),
        ("ops/field.py", "from .. import slam", "ops must not import slam"),
        ("slam/system.py", "def save():\n    import snh.viz.render", "slam must not import viz"),
        ("slam/system.py", "import cv2", "cv2 is for datasets, viz only"),
        ("geometry.py", "import torch", "torch is for"),
        ("eval/paths.py", "from snh.helpers import x", "snh.helpers has no place in LAYERS"),
        ("helpers.py", "", "helpers has no place in LAYERS"),
        ("nn/field.py", "torch.ops.snh.ray_sample", "reached through snh.ops"),
    ],
)
def test_other_imports_are_refused(layers, tmp_path, capsys, name, text, said):
    write(tmp_path, name, text)
    assert layers.main() == 1
    assert said in capsys.readouterr().out
