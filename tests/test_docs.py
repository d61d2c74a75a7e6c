"""Examples that readers copy, run as they stand: docstrings of the ops, code blocks of the guide."""

import doctest
import importlib
import pkgutil
import re

import pytest
from conftest import ROOT

import snh.ops

MODULES = [f"snh.ops.{m.name}" for m in pkgutil.iter_modules(snh.ops.__path__) if not m.name.startswith("_")]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_guide_to_the_ops():
    """The blocks build on each other and end in assertions on what was learned."""
    guide = (ROOT / "docs" / "ops.md").read_text()
    blocks = re.findall(r"^```python\n(.*?)^```", guide, re.DOTALL | re.MULTILINE)
    assert len(blocks) == 3
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, "docs/ops.md", "exec"), names)
