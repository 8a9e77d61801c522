"""Counts PyTorch's operations and the calls of the network."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from distrace.tracing.evaluator import Evaluator


class Operations(TorchDispatchMode):
    """A context that counts PyTorch's operations."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def recorded() -> Iterator[list[partial[Tensor]]]:
    """A context that lists the tracer's calls of the field; each can be called once more."""
    calls: list[partial[Tensor]] = []
    at = Evaluator.at

    def recording(self: Evaluator, points: Tensor, shape: Tensor | None, *, rough: bool = False) -> Tensor:
        calls.append(partial(at, self, points, shape, rough=rough))
        return calls[-1]()

    Evaluator.at = recording
    try:
        yield calls
    finally:
        Evaluator.at = at
