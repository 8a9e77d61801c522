"""A plain decoder, of products, biases and ReLUs alone, as oneDNN multiplies fastest."""

from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.decoder import Decoder
from distrace.products import LINEAR_RELU, Layer
from distrace.rounded import ROWS, Rounded, filled

PRODUCTS = torch.ops.mkldnn  # oneDNN's, which Inductor uses


class LaidOut(Rounded):
    """As right as autocast, in half the time.

    Weights are laid out once, not at every product, and a product adds its bias and bends by itself.
    """

    @staticmethod
    def has(decoder: Decoder) -> bool:
        """Whether it has a decoder's layers: none normed, not all fed, nor the last; and PyTorch the products."""
        specs = decoder.specs
        normed = bool(specs.norm_layers) and not specs.weight_norm
        other = normed or specs.xyz_in_all or len(specs.dims) in specs.latent_in or decoder.training
        return not other and torch.backends.mkldnn.is_available() and hasattr(PRODUCTS, "_linear_pointwise")

    @torch.no_grad()
    def layers(self, code: Float[Tensor, "*shapes length"]) -> list[Layer]:
        """Those of a field; of the ones that code and points enter, only what multiplies points, transposed."""
        code = self.decoder.checked(code)
        return [self._folded(*layer, code) if self.decoder.is_fed(k) else layer for k, layer in enumerate(self._layers)]

    def _folded(self, weight: Tensor, bias: Tensor, code: Tensor) -> Layer:
        by_code = weight[:, -self._fed : -3]
        folded = F.linear(code, by_code, bias) if code.dim() > 1 else torch.addmv(bias, by_code, code)
        return weight[:, -3:].t(), folded

    def _run(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None
    ) -> Float[Tensor, "n"]:
        x, last = _placed(layers[0], points, shape, then="relu"), len(layers) - 1
        for number, weight in enumerate(self._weights, 1):
            if self.decoder.is_fed(number):
                placed = _placed(layers[number], points, shape)
                x = PRODUCTS._linear_pointwise.binary(x, placed, weight, None, "add").relu_()
            else:
                x = _product(x, weight, layers[number][1], "relu" if number < last else "none")
        return self.decoder.ended(x[:, 0])

    @torch.no_grad()
    def slopes(
        self, points: Float[Tensor, "n 3"], code: Float[Tensor, "length"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n length"]]:
        """Exact values, and their derivatives by the point and by the code, rounded on the way back alone."""
        layers, on, rows = self.decoder.folded(self.decoder.checked(code)), [], filled(points)
        x = rows[:, :0]
        for number, layer in enumerate(layers):
            x = F.linear(torch.cat([x, rows], dim=1) if self.decoder.is_fed(number) else x, *layer)
            if number < len(layers) - 1:
                on.append(x.relu_().sign().bfloat16())
        x, by_units = x[:, 0], layers[-1][0].expand(len(rows), -1)
        for _ in range(2 if self.decoder.specs.use_tanh else 1):
            x = x.tanh()
            by_units = by_units * (1 - x.square())[:, None]
        by_fed = rows.new_zeros(len(rows), self._fed)
        for number in range(len(on) - 1, -1, -1):
            by_units = by_units.bfloat16().mul_(on[number])
            units, fed = self._weights_back[number]
            if fed is not None:
                by_fed += _product(by_units, fed)
            if units is not None:
                by_units = _product(by_units, units)
        by_code, by_point = by_fed[: len(points)].split([self._fed - 3, 3], dim=1)
        return x[: len(points)], by_point, by_code

    @cached_property
    def _layers(self) -> list[Layer]:
        """Weights, and biases in the precision that they are added in."""
        linears = [getattr(self.decoder, f"lin{layer}") for layer in range(self.decoder.depth)]
        layers = [(linear.weight, linear.bias) for linear in linears]
        return [(w, b if self.decoder.is_fed(layer) else b.bfloat16()) for layer, (w, b) in enumerate(layers)]

    @cached_property
    def _weights(self) -> list[Tensor]:
        """Of all layers but the first, without what multiplies code and points, as oneDNN has them for a product."""
        return [_laid_out(self._of_units(layer)) for layer in range(1, self.decoder.depth)]

    @cached_property
    def _weights_back(self) -> list[tuple[Tensor | None, Tensor | None]]:
        """Of all layers but the last, from its outputs to the units before it, and to code and points."""
        layers = range(self.decoder.depth - 1)
        units = [_laid_out(self._of_units(layer).T) if layer else None for layer in layers]
        fed = [
            _laid_out(self._layers[layer][0][:, -self._fed :].T) if self.decoder.is_fed(layer) else None
            for layer in layers
        ]
        return list(zip(units, fed, strict=True))

    @property
    def _fed(self) -> int:
        return self.decoder.specs.code_length + 3

    def _of_units(self, layer: int) -> Tensor:
        """A layer's weights of the units before it."""
        weight = self._layers[layer][0]
        return weight[:, : -self._fed] if self.decoder.is_fed(layer) else weight


def _laid_out(weight: Tensor) -> Tensor:
    return PRODUCTS._reorder_linear_weight(weight.bfloat16().contiguous(), 4 * ROWS)


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None, then: str = "none") -> Tensor:
    return PRODUCTS._linear_pointwise(x, weight, bias, then, [], "")


def _placed(
    layer: Layer, points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None, then: str = "none"
) -> Float[Tensor, "n width"]:
    """What points, and the codes that are folded into biases, give to a layer; computed in full precision."""
    weight, bias = layer
    if shape is not None:
        bias = bias.index_select(0, shape)
    product = LINEAR_RELU if then == "relu" else torch.addmm
    return product(bias, points, weight).bfloat16()
