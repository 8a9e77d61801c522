"""A decoder in bfloat16: half the time on processors that multiply in it, and accurate enough for a search."""

from functools import cached_property, lru_cache, partial

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn import functional as F
from torch.nn.functional import pad

from distrace.fields.base import SDF, Counted, flattened, in_chunks
from distrace.fields.batch import BatchField
from distrace.fields.decoder import CHUNK, Decoder, ShapeField
from distrace.fields.products import LINEAR_RELU, Layer

PRODUCTS = torch.ops.mkldnn  # oneDNN's, which Inductor uses
ROWS = 32  # rows are padded to a multiple: oneDNN compiles a kernel for each number, longer than a product takes
MANY = 1 << 16  # rows: from here on the product takes longer


class BFloat16Decoder:
    """A decoder in bfloat16: near the surface of an 8 × 512 decoder values are off by 1e-4 to 3e-4, at most by 1e-3."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder

    def __call__(
        self, points: Float[Tensor, "*batch 3"], code: Float[Tensor, "*#batch length"]
    ) -> Float[Tensor, "*batch"]:
        """Returns values, with derivatives as rounded. Points and codes keep their precision."""
        with torch.autocast(points.device.type, torch.bfloat16):
            return self.decoder(points, code).float()

    def field(self, code: Float[Tensor, "*shapes length"]) -> SDF | BatchField:
        """Returns the field of one shape or, from codes [B, length], of B shapes; without derivatives.

        Raises `ValueError` for a code of another length.
        """
        return self.fields(code) if code.dim() == 2 else self._single(code)

    def fields(self, codes: Float[Tensor, "shapes length"]) -> BatchField:
        """Returns the field of several shapes."""
        layers = self.layers(codes)

        def evaluate(points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
            return in_chunks(partial(self._values, layers), CHUNK, points, shape)

        return BatchField(codes, evaluate, self._single)

    def _single(self, code: Float[Tensor, "length"]) -> SDF:
        layers = self.layers(code)

        def evaluate(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            return flattened(lambda flat: in_chunks(partial(self._values, layers), CHUNK, flat), points)

        return evaluate

    @torch.no_grad()
    def layers(self, code: Float[Tensor, "*shapes length"]) -> list[Layer]:
        """Returns a field's layers, with biases [*shapes, outputs], in bfloat16 except those that points enter."""
        layers = enumerate(self.decoder.folded(self.decoder.checked(code)))
        return [(w if self.decoder.is_fed(number) else w.bfloat16(), b) for number, (w, b) in layers]

    @torch.no_grad()
    def _values(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None = None
    ) -> Float[Tensor, "n"]:
        if shape is not None:
            shape = padded_rows(shape)
        with torch.autocast(points.device.type, enabled=False):  # products are in bfloat16 as it is
            values = self._run(layers, padded_rows(points), shape).float()
        return values if len(values) == len(points) else values[: len(points)]

    def _run(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None
    ) -> Float[Tensor, "n"]:
        if shape is not None:
            layers = [(weight, bias if bias.dim() == 1 else bias[shape]) for weight, bias in layers]
        with torch.autocast(points.device.type, torch.bfloat16):
            return self.decoder._run(layers, points)


def padded_rows(rows: Shaped[Tensor, "n *_"]) -> Shaped[Tensor, "m *_"]:
    """Returns rows with zeros after them, up to a multiple of `ROWS`, where they are fewer than `MANY`."""
    missing = -len(rows) % ROWS if len(rows) < MANY else 0
    return pad(rows, (0, 0) * (rows.dim() - 1) + (0, missing)) if missing else rows


class PackedDecoder(BFloat16Decoder):
    """A decoder in bfloat16 with packed weights: as accurate as autocast, in half the time.

    oneDNN packs the weights once, not at every product, and adds bias and ReLU in the product.
    """

    @staticmethod
    def has(decoder: Decoder) -> bool:
        """Returns whether it can pack a decoder's layers: no layer norms, and points enter neither all nor the last."""
        specs = decoder.specs
        unusual = decoder.has_layer_norms or specs.xyz_in_all or len(specs.dims) in specs.latent_in
        return (
            not (unusual or decoder.training)
            and torch.backends.mkldnn.is_available()
            and hasattr(PRODUCTS, "_linear_pointwise")
        )

    @torch.no_grad()
    def layers(self, code: Float[Tensor, "*shapes length"]) -> list[Layer]:
        """Returns a field's layers; of those that code and points enter, the transposed weights of points alone."""
        code = self.decoder.checked(code)
        return [self._folded(*layer, code) if self.decoder.is_fed(k) else layer for k, layer in enumerate(self._layers)]

    def _folded(self, weight: Tensor, bias: Tensor, code: Tensor) -> Layer:
        by_code = weight[:, -self._fed : -3]
        folded = F.linear(code, by_code, bias) if code.dim() > 1 else torch.addmv(bias, by_code, code)
        return weight[:, -3:].t(), folded

    def _run(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None
    ) -> Float[Tensor, "n"]:
        x = _from_points(layers[0], points, shape, then="relu")
        last = len(layers) - 1
        for number, weight in enumerate(self._weights, 1):
            if self.decoder.is_fed(number):
                addend = _from_points(layers[number], points, shape)
                x = PRODUCTS._linear_pointwise.binary(x, addend, weight, None, "add").relu_()
            else:
                x = _product(x, weight, layers[number][1], "relu" if number < last else "none")
        return self.decoder.output(x[:, 0])

    @torch.no_grad()
    def slopes(
        self, points: Float[Tensor, "n 3"], code: Float[Tensor, "length"]
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n length"]]:
        """Returns exact values, and their derivatives by point and code; only the backward pass is in bfloat16."""
        layers = self.decoder.folded(self.decoder.checked(code))
        rows = padded_rows(points)
        active: list[Tensor] = []
        x = rows[:, :0]
        for number, layer in enumerate(layers):
            x = F.linear(torch.cat([x, rows], dim=1) if self.decoder.is_fed(number) else x, *layer)
            if number < len(layers) - 1:
                active.append(x.relu_().sign().bfloat16())
        x = x[:, 0]
        by_units = layers[-1][0].expand(len(rows), -1)
        for _ in range(2 if self.decoder.specs.use_tanh else 1):
            x = x.tanh()
            by_units = by_units * (1 - x.square())[:, None]
        by_fed = rows.new_zeros(len(rows), self._fed)
        for number in range(len(active) - 1, -1, -1):
            by_units = by_units.bfloat16().mul_(active[number])
            units, fed = self._weights_back[number]
            if fed is not None:
                by_fed += _product(by_units, fed)
            if units is not None:
                by_units = _product(by_units, units)
        by_code, by_point = by_fed[: len(points)].split([self._fed - 3, 3], dim=1)
        return x[: len(points)], by_point, by_code

    @cached_property
    def _layers(self) -> list[Layer]:
        """The weights, and the biases in the precision of the sums that they enter."""
        linears = [getattr(self.decoder, f"lin{layer}") for layer in range(self.decoder.depth)]
        layers = [(linear.weight, linear.bias) for linear in linears]
        return [(w, b if self.decoder.is_fed(layer) else b.bfloat16()) for layer, (w, b) in enumerate(layers)]

    @cached_property
    def _weights(self) -> list[Tensor]:
        """The packed weights of all layers but the first, without the columns of code and points."""
        return [_packed(self._of_units(layer)) for layer in range(1, self.decoder.depth)]

    @cached_property
    def _weights_back(self) -> list[tuple[Tensor | None, Tensor | None]]:
        """The packed transposed weights of all layers but the last: to the units before it, and to code and points."""
        layers = range(self.decoder.depth - 1)
        units = [_packed(self._of_units(layer).T) if layer else None for layer in layers]
        fed = [
            _packed(self._layers[layer][0][:, -self._fed :].T) if self.decoder.is_fed(layer) else None
            for layer in layers
        ]
        return list(zip(units, fed, strict=True))

    @property
    def _fed(self) -> int:
        return self.decoder.specs.code_length + 3

    def _of_units(self, layer: int) -> Tensor:
        """Returns a layer's weights of the units before it."""
        weight = self._layers[layer][0]
        return weight[:, : -self._fed] if self.decoder.is_fed(layer) else weight


def _packed(weight: Tensor) -> Tensor:
    return PRODUCTS._reorder_linear_weight(weight.bfloat16().contiguous(), 4 * ROWS)


def _product(x: Tensor, weight: Tensor, bias: Tensor | None = None, then: str = "none") -> Tensor:
    return PRODUCTS._linear_pointwise(x, weight, bias, then, [], "")


def _from_points(
    layer: Layer, points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None, then: str = "none"
) -> Float[Tensor, "n width"]:
    """Returns a layer's outputs from points and the codes in its biases alone; computed in full precision."""
    weight, bias = layer
    if shape is not None:
        bias = bias.index_select(0, shape)
    product = LINEAR_RELU if then == "relu" else torch.addmm
    return product(bias, points, weight).bfloat16()


def fastest(decoder: Decoder) -> Decoder | BFloat16Decoder:
    """Returns the decoder in bfloat16 on a CPU that multiplies in it, or else as it is: emulation takes longer.

    A subclass of `Decoder` stays as it is: it may override the field.
    """
    parameter = next(decoder.parameters())
    if type(decoder) is not Decoder or parameter.device.type != "cpu" or parameter.dtype != torch.float32:
        return decoder
    if not _multiplies_in_bfloat16():
        return decoder
    return PackedDecoder(decoder) if PackedDecoder.has(decoder) else BFloat16Decoder(decoder)


def fastest_field(sdf: SDF | BatchField) -> SDF | BatchField | None:
    """Returns a decoder's field in bfloat16 where that is faster on this machine, or else None."""
    if isinstance(sdf, Counted):
        return fastest_field(sdf.sdf)
    code = sdf.codes if isinstance(sdf, BatchField) else getattr(sdf, "code", None)
    decoder = getattr(sdf.evaluate, "decoder", None) if isinstance(sdf, BatchField | ShapeField) else None
    if decoder is None or code is None:
        return None
    fast_decoder = fastest(decoder)
    return None if fast_decoder is decoder else fast_decoder.field(code.detach())


@lru_cache
def _multiplies_in_bfloat16() -> bool:
    """Returns what the processor reports, not what a stopwatch says, so that fits are reproducible."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # PyTorch before 2.10 does not report them
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))
