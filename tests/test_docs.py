"""Examples that readers copy, run as they stand."""

import doctest
import importlib
import pkgutil

import pytest

import snh.ops

MODULES = [f"snh.ops.{m.name}" for m in pkgutil.iter_modules(snh.ops.__path__) if not m.name.startswith("_")]


@pytest.mark.parametrize("name", MODULES)
def test_docstring_examples(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0
