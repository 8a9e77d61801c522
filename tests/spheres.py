"""A decoder in closed form whose shapes are spheres, for tests of fitting and training."""

import torch

from distrace.fields.batch import BatchField
from distrace.fields.decoder import Decoder, NetworkSpecs


class Spheres(Decoder):
    """The code is the radius and the centre."""

    def __init__(self) -> None:
        super().__init__(NetworkSpecs(dims=(8,), code_length=4, latent_in=(), norm_layers=()))

    def forward(self, points: torch.Tensor, code: torch.Tensor) -> torch.Tensor:
        return (points - code[..., 1:]).norm(dim=-1) - code[..., 0]

    def field(self, code: torch.Tensor):
        return lambda points: self(points, code)

    def fields(self, codes: torch.Tensor) -> BatchField:
        return BatchField(codes, lambda points, shape: self(points, codes[shape]), self.field)
