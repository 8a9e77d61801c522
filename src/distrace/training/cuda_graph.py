"""A training step that a GPU repeats by itself.

A step is some hundreds of small kernels, and starting one takes longer than what it does. So the step is recorded once,
as a CUDA graph, and then played with other numbers (PyTorch documentation, *CUDA semantics*, section "CUDA Graphs").
"""

from collections.abc import Callable

import torch
from torch import Tensor

PLAIN = 3  # calls before one is recorded: libraries choose and allocate what they need in them


class Recorded:
    """A function from tensors on a GPU to one, which always does the same with them and never looks at their values."""

    def __init__(self, function: Callable[..., Tensor]) -> None:
        self.function, self.calls, self.graph = function, 0, torch.cuda.CUDAGraph()
        self.inputs: tuple[Tensor, ...] = ()
        self.result: Tensor

    def __call__(self, *inputs: Tensor) -> Tensor:
        """The function's result; valid until the next call."""
        self.calls += 1
        if self.calls <= PLAIN:
            return self._aside(inputs)
        if not self.inputs:
            self.inputs = tuple(each.clone() for each in inputs)
            with torch.cuda.graph(self.graph):
                self.result = self.function(*self.inputs)
        for kept, given in zip(self.inputs, inputs, strict=True):
            kept.copy_(given)
        self.graph.replay()
        return self.result

    def _aside(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """Called on a stream of its own, as what is recorded will be."""
        stream, now = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(now)
        with torch.cuda.stream(stream):
            result = self.function(*inputs)
        now.wait_stream(stream)
        return result
