"""One thread, few examples, types checked in a test's first calls; where the contract says 30, a `float` takes it."""

from collections import Counter
from functools import partial, wraps
from types import FunctionType
from typing import Any

import beartype
import jaxtyping
import pytest
import torch
from hypothesis import settings

CHECKED = 5  # calls of each function, in a test and what is set up for it: to check all takes half of its time
LONG = ("cli", "gradcheck", "reconstruct", "tracing", "train", "commands", "gradients", "fit_camera", "decoder", "fit")

torch.set_num_threads(1)
settings.register_profile("light", deadline=None, max_examples=12, derandomize=True)
settings.load_profile("light")

_checked = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))  # PEP 484 lets an int pass for a float
_jaxtyped = jaxtyping.jaxtyped
_calls: Counter[object] = Counter()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long come first, or one process would still be at them when the other has nothing left."""
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONG)


def pytest_runtest_setup(item: pytest.Item) -> None:
    _calls.clear()


def _at_first(function: Any = None, *, typechecker: Any) -> Any:
    """A function, or a class, whose types are checked, a function's CHECKED times in each test."""
    if function is None:
        return partial(_at_first, typechecker=typechecker)
    if not isinstance(function, FunctionType):
        return _jaxtyped(function, typechecker=typechecker)
    code = function.__code__  # a function within another is made anew in each call of that
    if _calls[code] >= CHECKED:
        return function
    checked: Any = None

    @wraps(function)
    def called(*args: Any, **named: Any) -> Any:
        nonlocal checked
        _calls[code] += 1
        if _calls[code] > CHECKED:
            return function(*args, **named)
        if checked is None:  # a check takes milliseconds to write, and most functions are called in few files
            checked = _jaxtyped(function, typechecker=typechecker)
        return checked(*args, **named)

    return called


# The import hook looks these names up when it checks a module.
jaxtyping.jaxtyped = _at_first
beartype.beartype = _checked
