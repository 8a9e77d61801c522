"""A decoder's products in bfloat16: half the time where the processor has them, and as right as a fit can tell."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from distrace.decoder import CPU_CHUNK, Decoder, Layer
from distrace.field import SDF, chunked

ROWS = 32  # a product's kernel is made anew for each number of rows, which takes longer than the product

Asked = tuple[list[Layer], Float[Tensor, "_ 3"]]
"""A shape's layers, and points to have its values at."""


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

    def field(self, code: Float[Tensor, "length"]) -> SDF:
        """The field of one shape, without derivatives by what it was made from."""
        layers = self.layers(code)

        @torch.no_grad()
        def evaluate(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            return self.run([(layers, points.reshape(-1, 3))])[0].reshape(points.shape[:-1])

        return chunked(evaluate, CPU_CHUNK)

    @torch.no_grad()
    def layers(self, code: Float[Tensor, "length"]) -> list[Layer]:
        """Those of the field of one shape, rounded once, not at every product, but where points enter."""
        layers = enumerate(self.decoder.field(code).layers)
        return [(w if self._is_fed(number) else w.bfloat16(), b) for number, (w, b) in layers]

    def _is_fed(self, layer: int) -> bool:
        """Code and points, or points alone."""
        specs = self.decoder.specs
        return layer == 0 or layer in specs.latent_in or specs.xyz_in_all

    @torch.no_grad()
    def run(self, asked: Sequence[Asked]) -> list[Float[Tensor, "_"]]:
        """Values of several shapes, each at its points."""
        return [self._run_one(layers, filled(points))[: len(points)].float() for layers, points in asked]

    def _run_one(self, layers: list[Layer], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        with torch.autocast(points.device.type, torch.bfloat16):
            return self.decoder._run(layers, points)


def filled(rows: Float[Tensor, "n width"]) -> Float[Tensor, "m width"]:
    """With rows of zeros after them, up to a multiple of `ROWS`."""
    return pad(rows, (0, 0, 0, -len(rows) % ROWS))
