"""Errors of depth cameras: noise, quantisation, outliers and holes."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import max_pool2d

from distrace.data.observation import View

SIZE = 2.0  # diameter of the unit sphere
STEP = 0.02  # × SIZE, of quantised depths
OUTLIERS = 0.1  # share of wrong depths
REACH = 0.25  # × SIZE, their largest error
GRAZING = 0.3  # cosine below which a surface reflects too little light
JUMP = 8.0  # pixel widths between neighbours: a depth camera loses both sides
SPOTS = 4  # holes at shiny or dark parts
SPOT = 0.06  # × the image's width, the radius of a hole
NOISES = ("0%", "1%", "2%", "3%", "5%", "quantised", "outliers", "holes")


def noisy(view: View, noise: str, seed: int) -> View:
    """Returns the view with noise on its depths; mask and normals stay. `noise` is one of NOISES, or another `…%`.

    Raises `ValueError` for an unknown noise, or for holes without normals.
    """
    random = torch.Generator().manual_seed(seed)
    depth = view.depth
    if noise.endswith("%"):
        deviation = float(noise.removesuffix("%")) / 100 * SIZE
        return replace(view, depth=depth + deviation * torch.randn(depth.shape, generator=random))
    if noise == "quantised":
        return replace(view, depth=(depth / STEP / SIZE).round() * STEP * SIZE)
    if noise == "outliers":
        wrong = torch.rand(depth.shape, generator=random) < OUTLIERS
        off = (2 * torch.rand(depth.shape, generator=random) - 1) * REACH * SIZE
        return replace(view, depth=torch.where(wrong, depth + off, depth))
    if noise == "holes":
        return replace(view, depth=depth.masked_fill(_holes(view, random), torch.inf))
    raise ValueError(f"there is no noise {noise!r}; give one of {', '.join(NOISES)}, or a share such as 4%")


def _holes(view: View, random: torch.Generator) -> Bool[Tensor, "height width"]:
    """Returns grazing surfaces, both sides of jumps in depth, and a few spots."""
    if view.normal is None:
        raise ValueError("holes need a view with normals, for grazing surfaces")
    towards = -view.camera.rays().directions
    grazing = (view.normal * towards).sum(-1) < GRAZING
    finite = view.depth.masked_fill(~view.seen, 0.0)[None]
    spread = max_pool2d(finite, 3, 1, 1) + max_pool2d(-finite, 3, 1, 1)
    jump = spread[0] > JUMP * finite[0] / view.camera.intrinsics[0, 0]
    pixels = view.seen.nonzero()
    centres = pixels[torch.randint(len(pixels), (SPOTS,), generator=random)]
    grid = torch.stack(torch.meshgrid(*(torch.arange(n) for n in view.depth.shape), indexing="ij"), dim=-1)
    distance = (grid[:, :, None] - centres).float().norm(dim=-1).amin(-1)
    return grazing | jump | (distance < SPOT * view.depth.shape[1])
