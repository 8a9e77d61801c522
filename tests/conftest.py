"""One thread, few examples; and where the contract says 30, an annotated `float` takes it."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import cache

import beartype
import jaxtyping
import jaxtyping._array_types
import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("light", deadline=None, max_examples=12, derandomize=True)
settings.load_profile("light")

_checked = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))  # PEP 484 lets an int pass for a float
_kept: dict[tuple, Callable] = {}


def _check(stub: Callable) -> Callable:
    """What checks a function's types; of a function within another, made anew in each call of that, only once."""
    if "<locals>" not in stub.__qualname__ or stub.__defaults__ or stub.__kwdefaults__:
        return _checked(stub)
    key = (stub.__module__, stub.__qualname__, stub.__code__, *stub.__annotations__.items())
    if key not in _kept:
        _kept[key] = _checked(stub)
    return _kept[key]


beartype.beartype = _check  # the import hook looks this name up when it checks a module
jaxtyping._array_types._make_array = cache(jaxtyping._array_types._make_array)  # so that equal annotations are equal


@contextmanager
def _without_checks() -> Iterator[None]:
    jaxtyping.config.update("jaxtyping_disable", True)
    try:
        yield
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the checks of shapes and types, half of a long test's time; for those whose parts other tests check."""
    with _without_checks():
        yield


@pytest.fixture(scope="session")
def without_checks() -> Callable[[], AbstractContextManager[None]]:
    """The same within a fixture of a module, of what would be set up before `unchecked`."""
    return _without_checks
