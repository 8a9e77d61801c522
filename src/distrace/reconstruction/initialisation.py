"""What a reconstruction begins with: outlines say where nothing is, depths of photographs where the surface is.

Colours find neither: what fills a court can be painted, and so would stay.
"""

import time
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, value_and_gradient
from distrace.photos.multiview_depth import NO_DEPTHS, AgreedDepths, contradicted
from distrace.photos.plane_sweep import swept
from distrace.reconstruction.reconstruct import ReconstructConfig, Reconstruction
from distrace.reconstruction.surface_network import CountedSurface, Surface
from distrace.reconstruction.terms import SHELL, unit_length

SURVEYED = 400_000  # points, of which those near the hull's surface are kept
UNIT = 0.02  # how much the length of the gradient counts beside the hull …
EVEN = 1.0  # … and beside what depths contradict: nothing else keeps what lies between them smooth
SEEN = 2.0  # how much depths count beside outlines
DEEP, MANY = 0.1, 0.1  # radii within the hull, and the share of depths there, that outlines do not tell


def telling(photographs: Sequence[Photograph], hull: SDF) -> AgreedDepths:
    """Depths that photographs agree on where they tell what outlines, and so the hull, do not, of courts and hollows;
    none otherwise: then they would only hold the surface to what few pixels tell.

    Raises `ValueError` for photographs without masks.
    """
    depths = AgreedDepths.of(swept(photographs))
    within = hull(depths.rays.at(depths.distance)) < -DEEP
    return depths if within.sum() > MANY * len(within) else NO_DEPTHS


def begin(state: Reconstruction, hull: SDF, config: ReconstructConfig, depths: AgreedDepths) -> None:
    """Teaches the surface the visual hull, and then, if there are any, depths: where they say nothing it stays."""
    began, device = time.perf_counter(), state.surface.last.weight.device
    surface = CountedSurface(state.surface)
    random = torch.Generator().manual_seed(config.seed)
    points = 2 * torch.rand(SURVEYED, 3, generator=random) - 1
    near = points[hull(points).abs() < SHELL]
    optimiser = torch.optim.Adam(state.surface.parameters())
    outlines = config.beginning // 3 if len(depths) else config.beginning
    for step in range(config.beginning):
        optimiser.param_groups[0]["lr"] = config.learning_rate * (1 - step / config.beginning)
        asked = _about(near, config.rays, random).to(device)
        if step < outlines:
            loss = _unlike(surface, hull, asked)
        else:
            loss = _beyond(surface, hull, asked, depths.drawn(config.rays // 2, random).to(device))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    state.evaluations += surface.evaluations
    state.seconds += time.perf_counter() - began


def _about(near: Float[Tensor, "m 3"], count: int, random: torch.Generator) -> Float[Tensor, "n 3"]:
    """So many points about the hull's surface, and as many anywhere."""
    some = near[torch.randint(len(near), (count,), generator=random)]
    about = some + SHELL / 2 * torch.randn(some.shape, generator=random)
    return torch.cat([about, 2 * torch.rand(count, 3, generator=random) - 1])


def _unlike(surface: Surface, hull: SDF, asked: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """How far the surface is from the hull."""
    value, gradient = value_and_gradient(surface, asked)
    return (value - hull(asked)).abs().mean() + UNIT * unit_length(gradient)


def _beyond(surface: Surface, hull: SDF, asked: Float[Tensor, "n 3"], known: Float[Tensor, "m 3"]) -> Float[Tensor, ""]:
    """How far the surface is out of the hull, and from what is seen."""
    value, gradient = value_and_gradient(surface, torch.cat([asked, known]))
    outside = hull(asked).relu()
    out = torch.where(outside > 0, (outside - value[: len(asked)]).relu(), 0.0)
    return out.mean() + SEEN * contradicted(value[len(asked) :]) + EVEN * unit_length(gradient)
