"""A training step as a CUDA graph (PyTorch documentation, *CUDA semantics*, section "CUDA Graphs").

A step is hundreds of small kernels, and launching one takes longer than running it. A graph launches them all at once.
"""

from collections.abc import Callable

import torch
from torch import Tensor

WARM_UP_CALLS = 3  # warm-up calls before the capture: libraries allocate their workspaces in them


class GraphedStep:
    """A function from GPU tensors of fixed shapes to a tensor, captured once and then replayed.

    Its control flow must not depend on their values.
    """

    def __init__(self, function: Callable[..., Tensor]) -> None:
        self.function = function
        self.calls = 0
        self.graph = torch.cuda.CUDAGraph()
        self.inputs: tuple[Tensor, ...] = ()
        self.result: Tensor

    def __call__(self, *inputs: Tensor) -> Tensor:
        """The function's result; valid until the next call."""
        self.calls += 1
        if self.calls <= WARM_UP_CALLS:
            return self._warm_up(inputs)
        if not self.inputs:
            self.inputs = tuple(each.clone() for each in inputs)
            with torch.cuda.graph(self.graph):
                self.result = self.function(*self.inputs)
        for captured, given in zip(self.inputs, inputs, strict=True):
            captured.copy_(given)
        self.graph.replay()
        return self.result

    def _warm_up(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """Calls the function on a stream of its own, as a capture does."""
        stream = torch.cuda.Stream()
        now = torch.cuda.current_stream()
        stream.wait_stream(now)
        with torch.cuda.stream(stream):
            result = self.function(*inputs)
        now.wait_stream(stream)
        return result
