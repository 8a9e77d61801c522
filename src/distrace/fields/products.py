"""A decoder's layers as matrix products: differentiable ones, and ones without derivatives in two reused buffers."""

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

Layer = tuple[Tensor, Tensor]
"""Weight [outputs, inputs], and bias [outputs] or, one for each shape or point, [..., outputs]."""

LINEAR_RELU = torch.ops.aten._addmm_activation  # one operation, and on a GPU one kernel
LARGEST_BUFFER = 1 << 27  # numbers in a buffer that is kept: 537 MB, 131,072 points of an 8 × 512 decoder
_spare: list[Tensor] = []  # at most one buffer


def linear(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Returns a layer's outputs; the bias is the same for all points, or broadcasts against them."""
    if bias.dim() == 1:
        return F.linear(x, weight, bias)
    return torch.addmm(bias, x, weight.t()) if bias.dim() == x.dim() == 2 else F.linear(x, weight) + bias


def linear_of_units_and_points(units: Tensor, points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Returns the outputs of a layer of units and points; points keep full precision under autocast."""
    if not torch.is_autocast_enabled(points.device.type):
        return linear(torch.cat([units, points], dim=-1), weight, bias)
    with torch.autocast(points.device.type, enabled=False):
        from_points = (F.linear(points, weight[:, -3:].to(points)) + bias).to(
            torch.get_autocast_dtype(points.device.type)
        )
    return F.linear(units, weight[:, :-3]) + from_points if units.shape[-1] else from_points


class Product(NamedTuple):
    """A layer as `torch.addmm` takes it: transposed views of the weights, those of units apart from those of points."""

    bias: Float[Tensor, "*shapes outputs"]
    units: Float[Tensor, "inputs outputs"] | None
    points: Float[Tensor, "3 outputs"] | None

    @staticmethod
    @torch.no_grad()
    def of(layer: Layer, fed: bool) -> "Product":
        """Returns a layer's product; `fed` says that the last three inputs are the point."""
        bias = layer[1]
        weight = layer[0].t()
        if not fed:
            return Product(bias, weight, None)
        return Product(bias, weight[:-3] if len(weight) > 3 else None, weight[-3:])

    def relu(self, units: Tensor, points: Tensor, shape: Tensor | None, out: Tensor) -> Tensor:
        """Returns a hidden layer's outputs after its ReLU, written to `out`."""
        addend, (x, weight) = self._last_product(units, points, shape, out)
        return LINEAR_RELU.out(addend, x, weight, out=out)

    def output(self, units: Tensor, points: Tensor, shape: Tensor | None) -> Float[Tensor, "n"]:
        """Returns the single output of the last layer."""
        addend, (x, weight) = self._last_product(units, points, shape, None)
        return torch.addmm(addend, x, weight)[:, 0]

    def _last_product(
        self, units: Tensor, points: Tensor, shape: Tensor | None, out: Tensor | None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Returns the layer's last product, and its addend: the bias of each point's shape, and all other products."""
        factors = [(x, weight) for x, weight in ((points, self.points), (units, self.units)) if weight is not None]
        outputs = self.bias
        if self.bias.dim() == 2:
            assert shape is not None
            outputs = torch.index_select(self.bias, 0, shape, out=out)
        for x, weight in factors[:-1]:
            outputs = torch.addmm(outputs, x, weight, out=out)
        return outputs, factors[-1]


@torch.no_grad()
def evaluate_layers(
    products: Sequence[Product], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None = None
) -> Float[Tensor, "n"]:
    """Returns the outputs of ReLU layers before the tanh, on a CPU: about two operations a layer.

    `shape` numbers each point's shape, where biases are [shapes, outputs]. The result shares no memory with buffers.
    """
    *hidden, last = products
    count = len(points)
    widest = max((product.bias.shape[-1] for product in hidden), default=0)
    units = points
    with _buffer(points, 2 * count * widest) as buffer:
        views: dict[tuple[int, int], Tensor] = {}
        for number, product in enumerate(hidden):
            side = number % 2
            width = product.bias.shape[-1]
            if (side, width) not in views:
                views[side, width] = buffer.as_strided((count, width), (width, 1), side * count * widest)
            units = product.relu(units, points, shape, views[side, width])
        return last.output(units, points, shape)


@contextmanager
def _buffer(like: Tensor, size: int) -> Generator[Float[Tensor, "_"], None, None]:
    """Lends memory for `size` numbers, kept for later calls: page faults of fresh memory take a sixth of the time.

    A concurrent call in another thread allocates its own.
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
        if not _spare and len(buffer) <= LARGEST_BUFFER:
            _spare.append(buffer)
