"""A decoder's products in bfloat16: half the time where the processor has them, and as right as a fit can tell."""

from functools import partial

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import pad

from distrace.batch_field import BatchField
from distrace.decoder import CHUNK, Decoder
from distrace.field import SDF, flattened, in_chunks
from distrace.products import Layer

ROWS = 32  # a product's kernel is made anew for each number of rows, which takes longer than the product
MANY = 1 << 16  # … of fewer rows than these


class Rounded:
    """The same shapes; values near the surface of an 8 × 512 decoder are off by 1e-4 to 3e-4, and by 1e-3 at most."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder

    def __call__(
        self, points: Float[Tensor, "*batch 3"], code: Float[Tensor, "*#batch length"]
    ) -> Float[Tensor, "*batch"]:
        """Values, and derivatives as rounded. Points and codes keep their precision."""
        with torch.autocast(points.device.type, torch.bfloat16):
            return self.decoder(points, code).float()

    def field(self, code: Float[Tensor, "*shapes length"]) -> SDF | BatchField[SDF]:
        """The field of one shape or, from codes [B, length], of B shapes; without derivatives.

        Raises `ValueError` for a code of another length.
        """
        return self.fields(code) if code.dim() == 2 else self._single(code)

    def fields(self, codes: Float[Tensor, "shapes length"]) -> BatchField[SDF]:
        """The field of several shapes, as `field` gives it."""
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
        """Those of a field, with biases [*shapes, outputs], in bfloat16, except those that points enter."""
        layers = enumerate(self.decoder.folded(self.decoder.checked(code)))
        return [(w if self.decoder.is_fed(number) else w.bfloat16(), b) for number, (w, b) in layers]

    @torch.no_grad()
    def _values(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None = None
    ) -> Float[Tensor, "n"]:
        if shape is not None:
            shape = filled(shape)
        values = self._run(layers, filled(points), shape).float()
        return values if len(values) == len(points) else values[: len(points)]

    def _run(
        self, layers: list[Layer], points: Float[Tensor, "n 3"], shape: Int[Tensor, "n"] | None
    ) -> Float[Tensor, "n"]:
        if shape is not None:
            layers = [(weight, bias if bias.dim() == 1 else bias[shape]) for weight, bias in layers]
        with torch.autocast(points.device.type, torch.bfloat16):
            return self.decoder._run(layers, points)


def filled(rows: Shaped[Tensor, "n *_"]) -> Shaped[Tensor, "m *_"]:
    """With rows of zeros after them, up to a multiple of `ROWS`, where they are not `MANY`."""
    missing = -len(rows) % ROWS if len(rows) < MANY else 0
    return pad(rows, (0, 0) * (rows.dim() - 1) + (0, missing)) if missing else rows
