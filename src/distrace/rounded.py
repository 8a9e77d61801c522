"""A decoder's products in bfloat16: half the time where the processor has them, and as right as a fit can tell."""

from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from distrace.decoder import CPU_CHUNK, Decoder
from distrace.field import SDF, chunked

ROWS = 32  # a product's kernel is made anew for each number of rows, which takes longer than the product


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
        with torch.no_grad():
            first, *others = self.decoder.field(code).layers  # points enter the first, in full precision
            layers = [first, *((weight.bfloat16(), bias) for weight, bias in others)]

        @torch.no_grad()
        def evaluate(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            flat = points.reshape(-1, 3)
            rows = pad(flat, (0, 0, 0, -len(flat) % ROWS))
            with torch.autocast(points.device.type, torch.bfloat16):
                values = self.decoder._run(layers, rows)
            return values[: len(flat)].float().reshape(points.shape[:-1])

        return chunked(evaluate, CPU_CHUNK)


def quickest(decoder: Decoder) -> Decoder | Rounded:
    """The decoder as it is, or rounded: on a CPU that multiplies in bfloat16. Others emulate that, and take longer.

    A decoder of another class is asked as it is: it may have another field.
    """
    parameter = next(decoder.parameters())
    if type(decoder) is not Decoder or parameter.device.type != "cpu" or parameter.dtype != torch.float32:
        return decoder
    return Rounded(decoder) if _multiplies_in_bfloat16() else decoder


@lru_cache
def _multiplies_in_bfloat16() -> bool:
    """As the processor says it, not a stopwatch: so that a fit that is run again ends where it did."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()  # PyTorch before 2.10 does not tell
    return any(capabilities.get(name) for name in ("avx512_bf16", "amx_bf16"))
