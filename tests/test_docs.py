"""Examples that readers copy, run as they stand: docstrings of ops and modules, code blocks of the guide."""

import doctest
import importlib
import pkgutil
import re

import pytest
from conftest import ROOT

import snh.nn
import snh.ops

MODULES = [
    f"{package.__name__}.{module.name}"
    for package in (snh.ops, snh.nn)
    for module in pkgutil.iter_modules(package.__path__)
    if not module.name.startswith("_")
]


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
