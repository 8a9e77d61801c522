"""The initial surface: the visual hull of the masks and, where they show more, consistent depths.

Colours alone find neither: the filling of a court can be painted, and so would stay.
"""

import time
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, value_and_gradient
from distrace.reconstruction.losses import SHELL, eikonal
from distrace.reconstruction.multiview_depth import NO_DEPTHS, ConsistentDepths, depth_loss, plane_sweep
from distrace.reconstruction.state import ReconstructConfig, Reconstruction
from distrace.reconstruction.surface_network import CountedSurface, Surface

CANDIDATES = 400_000  # points, of which those near the hull's surface are kept
EIKONAL_WITH_HULL = 0.02  # weight of the eikonal term beside the hull's …
EIKONAL_WITH_DEPTHS = 1.0  # … and beside the depths': nothing else keeps the surface between them smooth
DEPTHS = 2.0  # weight of depths beside outlines
INFORMATIVE_DEPTH = 0.1  # radii within the hull from which a depth says what outlines do not
INFORMATIVE_SHARE = 0.1  # of the depths that must do so


def informative_depths(photographs: Sequence[Photograph], hull: SDF) -> ConsistentDepths:
    """Consistent depths, if enough of them lie deep within the hull, in courts and hollows; otherwise none.

    Without hollows they would only hold the surface to what few pixels measure. Raises `ValueError` for photographs
    without masks.
    """
    depths = ConsistentDepths.of(plane_sweep(photographs))
    within = hull(depths.rays.at(depths.distance)) < -INFORMATIVE_DEPTH
    return depths if within.sum() > INFORMATIVE_SHARE * len(within) else NO_DEPTHS


def initialise(state: Reconstruction, hull: SDF, config: ReconstructConfig, depths: ConsistentDepths) -> None:
    """Fits the surface to the visual hull and then, if there are any, to depths; the rest stays as the hull has it."""
    began = time.perf_counter()
    surface = CountedSurface(state.surface)
    random = torch.Generator().manual_seed(config.seed)
    points = 2 * torch.rand(CANDIDATES, 3, generator=random) - 1
    near = points[hull(points).abs() < SHELL]
    optimiser = torch.optim.Adam(state.surface.parameters())
    hull_steps = config.initial_steps // 3 if len(depths) else config.initial_steps
    for step in range(config.initial_steps):
        optimiser.param_groups[0]["lr"] = config.learning_rate * (1 - step / config.initial_steps)
        about = near[torch.randint(len(near), (config.rays,), generator=random)]
        about = about + SHELL / 2 * torch.randn(about.shape, generator=random)
        points = torch.cat([about, 2 * torch.rand(config.rays, 3, generator=random) - 1]).to(state.device)
        if step < hull_steps:
            value, gradient = value_and_gradient(surface, points)
            loss = (value - hull(points)).abs().mean() + EIKONAL_WITH_HULL * eikonal(gradient)
        else:
            loss = _depths_in_hull(surface, hull, points, depths.sample(config.rays // 2, random).to(state.device))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    state.evaluations += surface.evaluations
    state.seconds += time.perf_counter() - began


def _depths_in_hull(
    surface: Surface, hull: SDF, points: Float[Tensor, "n 3"], depth_points: Float[Tensor, "m 3"]
) -> Float[Tensor, ""]:
    """The surface's error at depths, and by how much it lies outside the hull."""
    value, gradient = value_and_gradient(surface, torch.cat([points, depth_points]))
    distance = hull(points).relu()
    outside = torch.where(distance > 0, (distance - value[: len(points)]).relu(), 0.0)
    loss = DEPTHS * depth_loss(value[len(points) :])
    return outside.mean() + loss + EIKONAL_WITH_DEPTHS * eikonal(gradient)
