"""Exact derivatives of a field by its code, which all residuals of a code are made from."""

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.decoder import RECORDED_CHUNK, Decoder
from distrace.fields.precision import BFloat16Decoder, PackedDecoder

PRIOR_SCALE = 1e-6  # × a code's coordinate is its residual: far below any scale, where the loss is a square
PART = RECORDED_CHUNK // 2  # rows of a Jacobian that are made at once


def derivatives(
    decoder: Decoder | BFloat16Decoder, points: Float[Tensor, "n 3"], code: Float[Tensor, "length"]
) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"], Float[Tensor, "n length"]]:
    """Exact values, and their derivatives by the point and by the code: as right as the decoder has them."""
    parts = [_derivatives(decoder, part, code) for part in points.split(PART)]
    values, by_point, by_code = (torch.cat(part) for part in zip(*parts))
    return values, by_point, by_code


@torch.enable_grad()
def _derivatives(decoder: Decoder | BFloat16Decoder, points: Tensor, code: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    if isinstance(decoder, PackedDecoder):
        return decoder.slopes(points, code)
    if isinstance(decoder, BFloat16Decoder):
        decoder = decoder.decoder
    points, codes = points.detach().requires_grad_(), code.detach().repeat(len(points), 1).requires_grad_()
    values = decoder(points, codes)  # every point has a copy of the code for its own
    by_point, by_code = torch.autograd.grad(values.sum(), (points, codes))
    return values.detach(), by_point, by_code
