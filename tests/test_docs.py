"""Examples that readers copy, run as they stand."""

import doctest
import importlib
import pkgutil

import pytest

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
