"""One thread, few examples; and where the contract says 30, an annotated `float` takes it."""

from collections.abc import Iterator

import beartype
import jaxtyping
import pytest
import torch
from hypothesis import settings

torch.set_num_threads(1)
settings.register_profile("light", deadline=None, max_examples=12, derandomize=True)
settings.load_profile("light")

# The import hook looks this name up when it checks a module; PEP 484 lets an int pass for a float.
beartype.beartype = beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Without the checks of shapes and types, half of a long test's time; for those whose parts other tests check."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
