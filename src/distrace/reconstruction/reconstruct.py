"""Shape and colours of one object from photographs with masks, by the weights of networks, without a prior.

As in IDR (Yariv et al., *Multiview neural surface reconstruction*, NeurIPS 2020) rays are sphere-traced, and hits have
exact derivatives with respect to the weights. Their colours and outlines are compared with the photographs'. The
surface starts as the masks' visual hull and, where they show more, consistent depths: colours alone find neither, since
the filling of a court can be painted.
"""

import time
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, value_and_gradient
from distrace.rays import meet_sphere
from distrace.reconstruction.losses import SHELL, PixelSampler, eikonal, loss_terms, normals_and_features
from distrace.reconstruction.matching import PatchMatching
from distrace.reconstruction.multiview_depth import NO_DEPTHS, ConsistentDepths, consistent_depth_loss, plane_sweep
from distrace.reconstruction.networks import SurfaceNetwork
from distrace.reconstruction.state import ReconstructConfig, Reconstruction
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace
from distrace.training.losses import record

GRADIENT_NORM = 1.0  # to which the surface network's gradient is clipped: a few grazing rays have very large ones
REFINEMENT_MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=3e-4, steps=50, least_step=2e-3)
MOST_PIXELS = 1_000_000  # of the colour refinement
CHUNK = 1 << 15  # rays
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
    surface = state.surface
    surface.evaluations = 0
    random = torch.Generator().manual_seed(config.seed)
    points = 2 * torch.rand(CANDIDATES, 3, generator=random) - 1
    near = points[hull(points).abs() < SHELL]
    optimiser = torch.optim.Adam(surface.parameters())
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
    surface: SurfaceNetwork, hull: SDF, points: Float[Tensor, "n 3"], depth_points: Float[Tensor, "m 3"]
) -> Float[Tensor, ""]:
    """The surface's error at depths, and by how much it lies outside the hull."""
    value, gradient = value_and_gradient(surface, torch.cat([points, depth_points]))
    distance = hull(points).relu()
    outside = torch.where(distance > 0, (distance - value[: len(points)]).relu(), 0.0)
    loss = DEPTHS * consistent_depth_loss(value[len(points) :])
    return outside.mean() + loss + EIKONAL_WITH_DEPTHS * eikonal(gradient)


def reconstruct(
    photographs: Sequence[Photograph],
    state: Reconstruction,
    config: ReconstructConfig = ReconstructConfig(),
    depths: ConsistentDepths = NO_DEPTHS,
) -> Iterator[int]:
    """Fits `state` in place, from its step to the last one, and yields the number of steps done after each.

    The random draws of a step depend on the seed and the step alone, so that a stopped run goes on as if it had not
    been. Raises `ValueError` for photographs without masks, or masks without object.
    """
    size = 0
    while state.step < config.steps:
        began = time.perf_counter()
        if config.size_at(state.step) != size:
            size = config.size_at(state.step)
            coarse = [photograph.at_most(size) for photograph in photographs]
            sampler = PixelSampler.of(coarse)
            matching = PatchMatching.of(coarse, state.device)
        random = _generator(config, state.step)
        motions = state.motions()
        surface = state.surface
        surface.evaluations = 0  # the caller may have rendered it since the last step
        terms = loss_terms(
            sampler.sample(config.rays, random).to(state.device).moved(motions),
            matching.moved(motions),
            surface,
            state.colour,
            random,
            config.shapes_at(state.step),
            config.sharpness_at(state.step),
        )
        if len(depths):
            terms["depths"] = consistent_depth_loss(surface(depths.sample(config.rays // 4, random).to(state.device)))
        state.evaluations += surface.evaluations
        weighted = torch.stack([config.weight(name, len(depths) > 0) * term for name, term in terms.items()])
        yield _update(state, weighted.sum(), terms, config, began)
    if state.step < config.total:
        yield from _refine_colours(photographs, state, config)


def _refine_colours(
    photographs: Sequence[Photograph], state: Reconstruction, config: ReconstructConfig
) -> Iterator[int]:
    """The last steps, of colours alone; none where no ray hits the surface.

    Rays of the object's pixels, or of a random `MOST_PIXELS` of them, are traced once for all steps.
    """
    began = time.perf_counter()
    random = _generator(config, config.steps)
    surface = state.surface
    surface.evaluations = 0
    pixels = PixelSampler.of([photograph.at_most(config.sizes[-1]) for photograph in photographs]).pixels
    parts = []
    with torch.no_grad():
        pixels = pixels.to(state.device).moved(state.motions())
        rows = pixels.is_object.nonzero()[:, 0].cpu()
        rows = rows[torch.randperm(len(rows), generator=random)[:MOST_PIXELS]]
        for chunk in rows.split(CHUNK):
            traced = pixels[chunk.to(state.device)]
            trace = sphere_trace(surface, traced.rays, meet_sphere(traced.rays), REFINEMENT_MARCH)
            shown = traced[trace.hit]
            points = shown.rays.at(trace.distance[trace.hit])
            normals, features = normals_and_features(surface, points)
            parts.append((points, normals, shown.rays.directions, features, shown.colours))
    *inputs, colours = (torch.cat(part) for part in zip(*parts, strict=True))
    state.evaluations += surface.evaluations
    while len(colours) and state.step < config.total:
        random = _generator(config, state.step)
        rows = torch.randint(len(colours), (config.refinement_pixels,), generator=random).to(state.device)
        rendered = state.colour(*(values[rows] for values in inputs))
        loss = F.mse_loss(rendered, colours[rows])  # absolute errors would ignore rare colours, as of joints
        yield _update(state, loss, {"refinement": loss}, config, began)
        began = time.perf_counter()


def _generator(config: ReconstructConfig, step: int) -> torch.Generator:
    return torch.Generator().manual_seed((config.seed << 32) + step)


def _update(
    state: Reconstruction, loss: Tensor, terms: dict[str, Tensor], config: ReconstructConfig, began: float
) -> int:
    """One step of the optimiser, recorded in the state; returns the number of steps done."""
    for group in state.optimiser.param_groups:
        group["lr"] = group["share"] * config.rate_at(state.step)
    state.optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(state.surface.parameters(), GRADIENT_NORM)
    state.optimiser.step()
    first = 0 if state.step < config.steps else config.steps
    for name, value in terms.items():
        record(state.loss_history.setdefault(name, []), state.step - first, value.item())
    state.step += 1
    state.seconds += time.perf_counter() - began
    return state.step
