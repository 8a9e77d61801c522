"""A decoder's layers as matrix products: differentiable ones, and ones without derivatives in two reused buffers."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

Layer = tuple[Tensor, Tensor]
"""Weight [outputs, inputs], and bias [outputs] or, one for each shape or point, [..., outputs]."""

LINEAR_RELU = torch.ops.aten._addmm_activation  # one operation, and on a GPU one kernel
KEPT = 1 << 27  # numbers in a buffer that later calls use again: 537 MB, 131,072 points of an 8 × 512 decoder
_spare: list[Tensor] = []  # at most one buffer


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A layer; its bias is the same for all points, or broadcasts against them."""
    if bias.dim() == 1:
        return F.linear(x, weight, bias)
    return torch.addmm(bias, x, weight.t()) if bias.dim() == x.dim() == 2 else F.linear(x, weight) + bias


def joined(units: Tensor, points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A layer of units and points, the latter in full precision also under autocast."""
    if not torch.is_autocast_enabled(points.device.type):
        return linear(torch.cat([units, points], dim=-1), weight, bias)
    with torch.autocast(points.device.type, enabled=False):
        placed = (F.linear(points, weight[:, -3:].to(points)) + bias).to(torch.get_autocast_dtype(points.device.type))
    return F.linear(units, weight[:, :-3]) + placed if units.shape[-1] else placed


class Product(NamedTuple):
    """A layer as `torch.addmm` takes it: transposed views of the weights, those of units apart from those of points."""

    bias: Float[Tensor, "*shapes outputs"]
    units: Float[Tensor, "inputs outputs"] | None
    points: Float[Tensor, "3 outputs"] | None

    @staticmethod
    @torch.no_grad()
    def of(layer: Layer, fed: bool) -> "Product":
        """`fed`: whether the last three inputs are the point."""
        weight, bias = layer[0].t(), layer[1]
        if not fed:
            return Product(bias, weight, None)
        return Product(bias, weight[:-3] if len(weight) > 3 else None, weight[-3:])

    def bent(self, units: Tensor, points: Tensor, shape: Tensor | None, out: Tensor) -> Tensor:
        """The layer's outputs after a ReLU, with the bias of each point's shape, written to `out`."""
        outputs, (x, weight) = self._begun(units, points, shape, out)
        return LINEAR_RELU.out(outputs, x, weight, out=out)

    def ended(self, units: Tensor, points: Tensor, shape: Tensor | None) -> Float[Tensor, "n"]:
        """The one output of a last layer."""
        outputs, (x, weight) = self._begun(units, points, shape, None)
        return torch.addmm(outputs, x, weight)[:, 0]

    def _begun(
        self, units: Tensor, points: Tensor, shape: Tensor | None, out: Tensor | None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The bias, with all products but one, and what that one is of."""
        left = [(x, weight) for x, weight in ((points, self.points), (units, self.units)) if weight is not None]
        outputs = self.bias
        if self.bias.dim() == 2:
            assert shape is not None
            outputs = torch.index_select(self.bias, 0, shape, out=out)
        for x, weight in left[:-1]:
            outputs = torch.addmm(outputs, x, weight, out=out)
        return outputs, left[-1]


@torch.no_grad()
def evaluated(
    products: Sequence[Product], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None = None
) -> Float[Tensor, "n"]:
    """The outputs of ReLU layers before the tanh, on a CPU: about two operations a layer, however many points.

    `shape` numbers each point's shape, where biases are [shapes, outputs]. The result shares no memory with buffers.
    """
    *hidden, last = products
    count, widest = len(points), max((product.bias.shape[-1] for product in hidden), default=0)
    units = points
    with _buffer(points, 2 * count * widest) as buffer:
        views: dict[tuple[int, int], Tensor] = {}
        for number, product in enumerate(hidden):
            side, width = number % 2, product.bias.shape[-1]
            if (side, width) not in views:
                views[side, width] = buffer.as_strided((count, width), (width, 1), side * count * widest)
            units = product.bent(units, points, shape, views[side, width])
        return last.ended(units, points, shape)


@contextmanager
def _buffer(like: Tensor, size: int) -> Iterator[Float[Tensor, "_"]]:
    """Memory for `size` numbers, kept for later calls: the page faults of fresh memory take up to a sixth of the time.

    A call in another thread finds none to take, and allocates its own.
    """
    try:
        buffer = _spare.pop()
    except IndexError:
        buffer = None
    if buffer is None or buffer.dtype != like.dtype or len(buffer) < size:
        with torch.inference_mode(False):  # or it could not be written to outside of that mode
            buffer = torch.empty(size, dtype=like.dtype, device="cpu")
    try:
        yield buffer
    finally:
        if not _spare and len(buffer) <= KEPT:
            _spare.append(buffer)
