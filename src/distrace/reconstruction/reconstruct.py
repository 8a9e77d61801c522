"""Shape and colours of one object from photographs with masks, by the weights of networks, without a prior.

As in IDR (Yariv et al., *Multiview neural surface reconstruction*, NeurIPS 2020) rays are sphere-traced, and hits have
exact derivatives with respect to the weights. Their colours and outlines are compared with the photographs'.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.rays import meet_sphere
from distrace.reconstruction.losses import PixelRays, PixelSampler, loss_terms, normals_and_features
from distrace.reconstruction.matching import PatchMatching
from distrace.reconstruction.multiview_depth import NO_DEPTHS, ConsistentDepths, depth_loss
from distrace.reconstruction.state import ReconstructConfig, Reconstruction
from distrace.reconstruction.surface_network import ColourNetwork, CountedSurface, Surface
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace
from distrace.training.losses import record

GRADIENT_NORM = 1.0  # to which the surface network's gradient is clipped: a few grazing rays have very large ones
REFINEMENT_MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=3e-4, steps=50, least_step=2e-3)
MOST_POINTS = 1_000_000  # of the colour refinement
CHUNK = 1 << 15  # rays


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
        surface = CountedSurface(state.surface)
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
            terms["depths"] = depth_loss(surface(depths.sample(config.rays // 4, random).to(state.device)))
        state.evaluations += surface.evaluations
        weighted = torch.stack([config.weight(name, len(depths) > 0) * term for name, term in terms.items()])
        yield _update(state, weighted.sum(), terms, config, began)
    if state.step < config.total:
        yield from _refine_colours(photographs, state, config)


def _refine_colours(
    photographs: Sequence[Photograph], state: Reconstruction, config: ReconstructConfig
) -> Iterator[int]:
    """The last steps, of colours alone; none where no ray hits the surface.

    Rays are traced once for all steps, each of which can so afford many more pixels.
    """
    began = time.perf_counter()
    finest = [photograph.at_most(config.sizes[-1]) for photograph in photographs]
    surface = CountedSurface(state.surface)
    with torch.no_grad():
        pixels = PixelSampler.of(finest).pixels.to(state.device).moved(state.motions())
    points = SurfaceColours.of(surface, pixels, _generator(config, config.steps))
    state.evaluations += surface.evaluations
    while len(points.points) and state.step < config.total:
        term = points.loss(state.colour, config.refinement_pixels, _generator(config, state.step))
        yield _update(state, term, {"refinement": term}, config, began)
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


@dataclass(frozen=True)
class SurfaceColours:
    """Points where rays of the object's pixels hit the surface, the colour network's inputs there, and the colours."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    features: Float[Tensor, "n features"]
    colours: Float[Tensor, "n 3"]

    @staticmethod
    @torch.no_grad()
    def of(surface: Surface, pixels: PixelRays, random: torch.Generator) -> "SurfaceColours":
        """Traces the object's pixels, or a random `MOST_POINTS` of them."""
        rows = pixels.is_object.nonzero()[:, 0].cpu()
        rows = rows[torch.randperm(len(rows), generator=random)[:MOST_POINTS]]
        parts = []
        for chunk in rows.split(CHUNK):
            traced = pixels[chunk.to(pixels.view.device)]
            trace = sphere_trace(surface, traced.rays, meet_sphere(traced.rays), REFINEMENT_MARCH)
            shown = traced[trace.hit]
            points = shown.rays.at(trace.distance[trace.hit])
            normals, features = normals_and_features(surface, points)
            parts.append((points, normals, shown.rays.directions, features, shown.colours))
        return SurfaceColours(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def loss(self, colour: ColourNetwork, count: int, random: torch.Generator) -> Float[Tensor, ""]:
        """The mean squared error of `count` random points: absolute errors would ignore rare colours, as of joints."""
        rows = torch.randint(len(self.points), (count,), generator=random).to(self.points.device)
        *inputs, colours = (getattr(self, part.name)[rows] for part in fields(self))
        return F.mse_loss(colour(*inputs), colours)
