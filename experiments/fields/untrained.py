"""Networks without training whose surface is about a sphere (Atzmon and Lipman, *SAL*, CVPR 2020)."""

import torch
from torch import nn

from distrace.fields.base import SDF
from distrace.fields.decoder import Decoder, NetworkSpecs

RADIUS = 0.6


def ball(layers: int, width: int, device: torch.device | str = "cpu") -> SDF:
    """Returns the field of an untrained network, about the distance to a sphere of RADIUS."""
    specs = NetworkSpecs(dims=(width,) * layers, code_length=1, latent_in=(), norm_layers=())
    return ball_decoder(specs, RADIUS).to(device).field(torch.zeros(1, device=device))


def ball_decoder(specs: NetworkSpecs, radius: float) -> Decoder:
    """Returns an untrained decoder that is about the distance to a sphere."""
    decoder = Decoder(specs)
    generator = torch.Generator().manual_seed(0)
    linears = [module for module in decoder.modules() if isinstance(module, nn.Linear)]
    with torch.no_grad():
        for linear in linears[:-1]:
            linear.weight.normal_(0, (2 / linear.out_features) ** 0.5, generator=generator)
            linear.bias.zero_()
        linears[-1].weight.normal_((torch.pi / linears[-1].in_features) ** 0.5, 1e-5, generator=generator)
        linears[-1].bias.fill_(-radius)
    return decoder.requires_grad_(False)
