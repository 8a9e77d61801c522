"""The examples in docstrings run, and every public name has a docstring."""

import doctest
import inspect
import pkgutil
from importlib import import_module

import pytest
import torch

import distrace as dt
from distrace import checkpoints, fields

OPTIONS = doctest.NORMALIZE_WHITESPACE
MODULES = [
    "distrace",
    *(f"distrace.{name}" for name in ("boundary", "camera", "equality", "errors", "losses", "mesh", "metrics", "pose")),
    *(f"distrace.{name}" for name in ("prior", "rays", "shading", "surface", "viewpoint")),
    *(
        module.name
        for part in (checkpoints, fields)
        for module in pkgutil.iter_modules(part.__path__, f"{part.__name__}.")
    ),
    "distrace.render",
    "distrace.tracing.sphere_tracing",
]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_run(name: str) -> None:
    module = import_module(name)
    result = doctest.testmod(module, globs={**vars(module), "torch": torch}, optionflags=OPTIONS)
    assert result.failed == 0


@pytest.mark.parametrize("name", dt.__all__)
def test_a_public_name_exists_and_is_explained(name: str) -> None:
    public = getattr(dt, name)
    assert name == "SDF" or inspect.getdoc(public)  # an alias, explained in its module
