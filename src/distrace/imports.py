"""Imports of modules that load PyTorch."""

import gc
from importlib import import_module
from types import ModuleType


def quickly(name: str) -> ModuleType:
    """Returns a module, imported without garbage collection: one pass over PyTorch's many objects takes 0.15 s."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        return import_module(name)
    finally:
        if enabled:
            gc.enable()
