"""An untrained decoder whose shapes are bumpy balls, for tests of fitting."""

import torch
from torch import nn

from distrace.decoder import Decoder, NetworkSpecs


def bumpy_balls() -> Decoder:
    """About the distance to a ball before any training (Atzmon and Lipman, *SAL*, CVPR 2020); codes bend it."""
    decoder = Decoder(NetworkSpecs(dims=(64,) * 3, code_length=4, latent_in=(), norm_layers=()))
    generator = torch.Generator().manual_seed(0)
    linears = [module for module in decoder.modules() if isinstance(module, nn.Linear)]
    with torch.no_grad():
        for linear in linears[:-1]:
            linear.weight.normal_(0, (2 / linear.out_features) ** 0.5, generator=generator)
            linear.bias.zero_()
        linears[0].weight[:, :4] *= 0.4
        linears[-1].weight.normal_((torch.pi / linears[-1].in_features) ** 0.5, 1e-5, generator=generator)
        linears[-1].bias.fill_(-0.6)
    return decoder.requires_grad_(False)
