"""A differentiable renderer for neural signed distance functions, by sphere tracing.

>>> import distrace as dt
>>> model = dt.load_model("sofas")
>>> camera = dt.Camera.orbit(azimuth=30, elevation=20, distance=4.97, height=64, width=64)
>>> buffers = dt.render(model.field(0), camera)
>>> buffers.depth.shape, buffers.normal.shape
(torch.Size([64, 64]), torch.Size([64, 64, 3]))
"""

import sys
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING, Any

from distrace import threads as threads
from distrace.imports import quickly

if TYPE_CHECKING:
    from distrace.public import *  # noqa: F403

__version__ = "0.1.0"  # pyproject.toml reads it here


class _Package(ModuleType):
    """The package; its `render` is the function, also once the module of that name is imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name != "render" or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


def __getattr__(name: str) -> Any:
    """Imports a public name, or a module, when it is used: the command line starts without torch."""
    if name == "__all__":
        return quickly("distrace.public").__all__
    if not name.startswith("_"):
        if name != "render" and find_spec(f"distrace.{name}"):
            return quickly(f"distrace.{name}")
        if name in __dir__():
            value = getattr(quickly("distrace.public"), name)
            globals()[name] = value  # later uses find it without a search for a module of that name
            return value
    raise AttributeError(f"module 'distrace' has no attribute {name!r}")


def __dir__() -> list[str]:
    return quickly("distrace.public").__all__


sys.modules[__name__].__class__ = _Package
