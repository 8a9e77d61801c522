"""Networks without the ReLU units that are off wherever they are evaluated."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.fields.products import Layer

OFF_MARGIN = 0.5  # standard deviations below zero at which a unit counts as off
WIDTH_MULTIPLE = 16  # of pruned layers: processors multiply such matrices faster
SAMPLE_STRIDE = 8  # deviations are measured at every so many points


class Activity:
    """The highest input of each hidden ReLU unit at the points of an evaluation, and its standard deviation."""

    def __init__(self, layers: Sequence[Layer]) -> None:
        self.layers = layers
        self.highest = [torch.full_like(bias, -torch.inf) for _, bias in layers[:-1]]
        self.deviation = [torch.zeros_like(bias) for _, bias in layers[:-1]]

    def watch(self, layer: int, x: Float[Tensor, "n units"]) -> None:
        """Takes the inputs of a layer's units into account."""
        self.highest[layer] = self.highest[layer].maximum(x.amax(0))
        self.deviation[layer] = self.deviation[layer].maximum(x[::SAMPLE_STRIDE].std(0, correction=0))

    def pruned(self) -> list[Layer]:
        """Returns the layers without the rows of their inactive units, and without the columns of those before."""
        active = [_active_units(*both) for both in zip(self.highest, self.deviation, strict=True)]
        layers: list[Layer] = []
        for number, (weight, bias) in enumerate(self.layers):
            if number:
                point = torch.arange(len(self.layers[number - 1][1]), weight.shape[1], device=weight.device)
                weight = weight[:, torch.cat([active[number - 1], point])]
            rows = active[number] if number < len(active) else None
            layers.append((weight.contiguous(), bias) if rows is None else (weight[rows], bias[rows]))
        return layers


def _active_units(highest: Float[Tensor, "n"], deviation: Float[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Returns the units that come near zero or above, and a few more for a round width."""
    level = highest / deviation.clamp_min(1e-12)
    count = -(-int((level > -OFF_MARGIN).sum()) // WIDTH_MULTIPLE) * WIDTH_MULTIPLE
    return level.topk(min(max(count, WIDTH_MULTIPLE), len(level))).indices.sort().values
