"""What depth cameras do to depths: noise, steps, outliers and holes."""

from dataclasses import replace

import torch
from jaxtyping import Bool
from torch import Tensor
from torch.nn.functional import max_pool2d

from distrace.data.observation import View

SIZE = 2.0  # of an object: the diameter of the unit sphere
STEP = 0.02  # of quantised depths, as a part of SIZE
OUTLIERS, REACH = 0.1, 0.25  # the share of wrong depths, and how far they are off at most, as a part of SIZE
GRAZING = 0.3  # cosines of surfaces that send too little light back
JUMP = 8.0  # in pixels' widths, between neighbours: a camera of depth sees neither side
SPOTS, SPOT = 4, 0.06  # holes of shiny or dark parts, and their radius as a part of the image's width
NOISES = ("0%", "1%", "2%", "3%", "5%", "quantised", "outliers", "holes")


def noisy(view: View, noise: str, seed: int) -> View:
    """The view with its depths disturbed; mask and normals stay. `noise` is one of NOISES, or another `…%`.

    Raises `ValueError` for another word, or for holes without normals.
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
        return replace(view, depth=depth.masked_fill(_unseen(view, random), torch.inf))
    raise ValueError(f"there is no noise {noise!r}; give one of {', '.join(NOISES)}, or a share such as 4%")


def _unseen(view: View, random: torch.Generator) -> Bool[Tensor, "height width"]:
    """Grazing surfaces, both sides of a jump in depth, and a few spots."""
    if view.normal is None:
        raise ValueError("holes lie where surfaces graze; they need a view with normals")
    towards = -view.camera.rays().directions
    grazing = (view.normal * towards).sum(-1) < GRAZING
    finite = view.depth.masked_fill(~view.seen, 0.0)[None]
    spread = max_pool2d(finite, 3, 1, 1) + max_pool2d(-finite, 3, 1, 1)
    jump = spread[0] > JUMP * finite[0] / view.camera.intrinsics[0, 0]
    seen = view.seen.nonzero()
    centres = seen[torch.randint(len(seen), (SPOTS,), generator=random)]
    grid = torch.stack(torch.meshgrid(*(torch.arange(n) for n in view.depth.shape), indexing="ij"), dim=-1)
    away = (grid[:, :, None] - centres).float().norm(dim=-1).amin(-1)
    return grazing | jump | (away < SPOT * view.depth.shape[1])
