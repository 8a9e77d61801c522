"""Shape and colours of one object from photographs with masks, by a network's weights: no class, no prior.

As in IDR (Yariv et al., *Multiview neural surface reconstruction*, NeurIPS 2020) rays are sphere-traced, and the points
that they hit have their exact derivatives by the weights. Colours and outlines are compared with the photographs'.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.field import value_and_gradient
from distrace.hull import visual_hull
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import attach, minimum
from distrace.surface_network import ColourNetwork, SurfaceNetwork, SurfaceSpecs
from distrace.targets import band
from distrace.trace import Trace, TraceConfig, sphere_trace

MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=1e-3, steps=25, least_step=4e-3)
NEAR_OUTLINE = 31  # pixels across the band from which half of the background's rays are drawn
FAR_OFF = 0.1  # rays of the background that come no closer have nothing to say
COURSE = 100  # steps, whose mean terms are a point of a run's course
SHELL = 0.05  # around the surface, in which half of the points lie whose gradient should have length 1
SURVEYED = 400_000  # points, of which those near the hull's surface are kept
STEEPEST = 1.0  # norm of the gradient by the surface's weights: a few rays that graze must not throw it off
UNIT = 0.02  # of the hull's loss: how much the length of the gradient counts
REFINED = 2  # rounds of the search for a ray's least value: to two thousandths


@dataclass(frozen=True)
class ReconstructConfig:
    """The schedule. Sizes are the longer sides of the images, in pixels: coarse ones, then finer ones."""

    steps: int = 16_000
    hull_steps: int = 1500  # before, of the surface alone, towards the visual hull
    sizes: tuple[int, ...] = (160, 320)
    rays: int = 1024  # of a step: half of the object, half around it
    learning_rate: float = 1e-3  # of the colours' network …
    surface_rate: float = 0.5  # … and × this of the surface's
    last_rate: float = 0.05  # × as much at the end; the rate falls exponentially
    outline: float = 50.0  # the weights of the terms, to one of the colours' mean absolute difference
    eikonal: float = 1.0
    sharpness: float = 100.0  # of an outline at first, per radius: it doubles …
    sharpenings: int = 3  # … so often, evenly over the steps
    painting: float = 0.05  # of the steps, at first, in which colours are learnt and do not shape the surface
    colours_shape: bool = True  # without, only outlines shape the surface: a visual hull
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.rays < 4 or not self.sizes or min(self.sizes) < 8:
            given = f"{self.steps} steps of {self.rays} rays and images of {self.sizes} pixels"
            raise ValueError(f"{given} were asked for; at least 1 step, 4 rays and 8 pixels are needed")

    def rate(self, step: int) -> float:
        return self.learning_rate * self.last_rate ** (step / self.steps)

    def sharp(self, step: int) -> float:
        return self.sharpness * 2.0 ** (step * (self.sharpenings + 1) // self.steps)

    def shapes(self, step: int) -> bool:
        """Whether colours shape the surface."""
        return self.colours_shape and step >= self.painting * self.steps

    def size(self, step: int) -> int:
        return self.sizes[step * len(self.sizes) // self.steps]


@dataclass(frozen=True)
class Pixels:
    """The rays of photographs of one size that meet the unit sphere, what they show, and which of them tell most."""

    rays: Rays
    colours: Float[Tensor, "n 3"]
    is_object: Bool[Tensor, "n"]
    groups: tuple[Tensor, Tensor, Tensor]  # rows of the object, of the background by the outline, of all background

    @staticmethod
    def of(photographs: Sequence[Photograph], size: int) -> "Pixels":
        """Raises `ValueError` for a photograph without a mask."""
        parts = []
        for each in photographs:
            if each.mask is None:
                raise ValueError(f"{each.name} has no mask; a reconstruction is told by masks what is object")
            coarse = each.resized(min(1.0, size / max(each.mask.shape)))
            assert coarse.mask is not None
            rays = coarse.camera.rays().flat()
            meets = meet_sphere(rays).meets
            kept = (rays.origins, rays.directions, coarse.image.reshape(-1, 3), coarse.mask.reshape(-1))
            parts.append([part[meets] for part in (*kept, band(coarse.mask, NEAR_OUTLINE).reshape(-1))])
        origins, directions, colours, is_object, near = (torch.cat(part) for part in zip(*parts, strict=True))
        groups = tuple(some.nonzero()[:, 0] for some in (is_object, ~is_object & near, ~is_object))
        assert len(groups) == 3
        return Pixels(Rays(origins, directions), colours, is_object, groups)

    def drawn(self, count: int, random: torch.Generator) -> "Pixels":
        """Half of them of the object, a quarter of the background by its outlines."""
        shares = (count // 2, count // 4, count - count // 2 - count // 4)
        rows = torch.cat(
            [
                group[torch.randint(len(group), (share,), generator=random)]
                for group, share in zip(self.groups, shares, strict=True)
                if len(group)
            ]
        )
        return Pixels(self.rays[rows], self.colours[rows], self.is_object[rows], self.groups)

    def to(self, device: torch.device) -> "Pixels":
        rays = Rays(self.rays.origins.to(device), self.rays.directions.to(device))
        return Pixels(rays, self.colours.to(device), self.is_object.to(device), self.groups)


@dataclass
class Reconstruction:
    """What a run changes as it goes on, and what a checkpoint holds."""

    surface: SurfaceNetwork
    colour: ColourNetwork
    optimiser: torch.optim.Adam
    step: int = 0
    seconds: float = 0.0  # of all steps
    evaluations: int = 0  # of the surface's network
    course: list[dict[str, float]] = field(default_factory=list)  # mean terms of each COURSE steps so far

    @staticmethod
    def fresh(specs: SurfaceSpecs, config: ReconstructConfig, device: torch.device) -> "Reconstruction":
        torch.manual_seed(config.seed)
        surface, colour = SurfaceNetwork(specs).to(device), ColourNetwork(specs).to(device)
        groups = [
            {"params": list(surface.parameters()), "share": config.surface_rate},
            {"params": list(colour.parameters()), "share": 1.0},
        ]
        return Reconstruction(surface, colour, torch.optim.Adam(groups, config.learning_rate))

    def record(self, terms: dict[str, float], seconds: float) -> None:
        """Counts a step done."""
        done = self.step % COURSE
        if not done:
            self.course.append(dict.fromkeys(terms, 0.0))
        mean = self.course[-1]
        for name, value in terms.items():
            mean[name] += (value - mean[name]) / (done + 1)
        self.step, self.seconds = self.step + 1, self.seconds + seconds


@dataclass(frozen=True)
class Step:
    """One step done: the terms of its loss, and how long it took."""

    step: int
    terms: dict[str, float]
    seconds: float


def begin_with_hull(state: Reconstruction, photographs: Sequence[Photograph], config: ReconstructConfig) -> None:
    """Teaches the surface what the masks allow: from there colours need not find what outlines know.

    Raises `ValueError` for photographs without masks, or masks without anything in common.
    """
    began = time.perf_counter()
    hull, device = visual_hull(photographs), state.surface.last.weight.device
    random = torch.Generator().manual_seed(config.seed)
    points = 2 * torch.rand(SURVEYED, 3, generator=random) - 1
    near = points[hull(points).abs() < SHELL]
    optimiser = torch.optim.Adam(state.surface.parameters())
    for step in range(config.hull_steps):
        optimiser.param_groups[0]["lr"] = config.learning_rate * (1 - step / config.hull_steps)
        some = near[torch.randint(len(near), (config.rays,), generator=random)]
        about = some + SHELL / 2 * torch.randn(some.shape, generator=random)
        anywhere = 2 * torch.rand(config.rays, 3, generator=random) - 1
        asked = torch.cat([about, anywhere])
        value, gradient = value_and_gradient(state.surface, asked.to(device))
        loss = (value - hull(asked).to(device)).abs().mean() + UNIT * _unit(gradient)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    state.seconds += time.perf_counter() - began


def reconstruct(
    photographs: Sequence[Photograph], state: Reconstruction, config: ReconstructConfig = ReconstructConfig()
) -> Iterator[Step]:
    """Fits in place and yields after every step, from wherever `state` is to the last one.

    The draw of a step depends on the seed and the step alone: a run that was stopped goes on as if it had not been.
    Raises `ValueError` for photographs without masks, or masks without object.
    """
    device, size, pixels = state.surface.last.weight.device, 0, None
    while state.step < config.steps:
        began = time.perf_counter()
        if pixels is None or config.size(state.step) != size:
            size = config.size(state.step)
            pixels = Pixels.of(photographs, size)
            if not len(pixels.groups[0]):
                raise ValueError("the masks of the photographs mark no pixel in the unit sphere as object")
        for group in state.optimiser.param_groups:
            group["lr"] = group["share"] * config.rate(state.step)
        random = torch.Generator().manual_seed((config.seed << 32) + state.step)
        some = pixels.drawn(config.rays, random).to(device)
        terms = _terms(some, state, config, random)
        weighted = terms["colour"] + config.outline * terms["outline"] + config.eikonal * terms["eikonal"]
        state.optimiser.zero_grad()
        weighted.backward()
        torch.nn.utils.clip_grad_norm_(state.surface.parameters(), STEEPEST)
        state.optimiser.step()
        told = {name: value.item() for name, value in terms.items()}
        state.record(told, seconds := time.perf_counter() - began)
        yield Step(state.step, told, seconds)


def _terms(
    pixels: Pixels, state: Reconstruction, config: ReconstructConfig, random: torch.Generator
) -> dict[str, Tensor]:
    """Of the loss: colours where object was hit, outlines elsewhere, and the length of the field's gradient."""
    bounds = meet_sphere(pixels.rays)
    trace = sphere_trace(state.surface, pixels.rays, bounds, MARCH)
    state.evaluations += trace.total_evaluations + 3 * len(pixels.rays.origins)
    seen = trace.hit & pixels.is_object
    colour = _colour_term(pixels, trace, seen, state, config.shapes(state.step))
    outline = _outline_term(pixels, bounds, trace, ~seen, state.surface, config.sharp(state.step))
    points = pixels.rays[trace.hit].at(trace.distance[trace.hit])
    return {"colour": colour, "outline": outline, "eikonal": _eikonal_term(points, state.surface, random)}


def _colour_term(
    pixels: Pixels, trace: Trace, seen: Bool[Tensor, "n"], state: Reconstruction, shapes: bool
) -> Float[Tensor, ""]:
    """The mean absolute difference of colours, as a share of all rays of the object."""
    rays, distance = pixels.rays[seen], trace.distance[seen]
    points = rays.at(attach(state.surface, rays, distance) if shapes else distance)
    made = coloured(state.surface, state.colour, points, rays.directions, shapes)
    return (made - pixels.colours[seen]).abs().sum() / 3 / pixels.is_object.sum().clamp_min(1)


def coloured(
    surface: SurfaceNetwork,
    colour: ColourNetwork,
    points: Float[Tensor, "n 3"],
    directions: Float[Tensor, "n 3"],
    shapes: bool = True,
) -> Float[Tensor, "n 3"]:
    """Colours of points of the surface; without `shapes` they do not pull at it."""
    keep = torch.is_grad_enabled()
    with torch.enable_grad():
        asked = points if points.requires_grad else points.detach().requires_grad_()
        value, features = surface.features(asked)
        (gradient,) = torch.autograd.grad(value.sum(), asked, retain_graph=keep, create_graph=keep and shapes)
    normals = F.normalize(gradient, dim=-1)
    if not (keep and shapes):
        normals, features = normals.detach(), features.detach()
    return colour(points, normals, directions, features)


def _outline_term(
    pixels: Pixels,
    bounds: Bounds,
    trace: Trace,
    wrong: Bool[Tensor, "n"],
    surface: SurfaceNetwork,
    sharpness: float,
) -> Float[Tensor, ""]:
    """Cross entropy of the rays' least values, where the object was missed or is not; as a share of all rays."""
    rows = wrong.nonzero()[:, 0]
    with torch.no_grad():
        close = surface(pixels.rays[rows].at(trace.closest[rows])) < FAR_OFF
    rows = rows[close | pixels.is_object[rows]]
    rays, closest = pixels.rays[rows], trace.closest[rows]
    within = Bounds(bounds.near[rows], bounds.far[rows])
    values = surface(rays.at(minimum(surface, rays, closest, within, reach=SHELL, refine=REFINED)))
    lacking = F.binary_cross_entropy_with_logits(
        -sharpness * values, pixels.is_object[rows].to(values), reduction="sum"
    )
    return lacking / sharpness / len(wrong)


def _eikonal_term(hits: Float[Tensor, "n 3"], surface: SurfaceNetwork, random: torch.Generator) -> Float[Tensor, ""]:
    """(|∇f| − 1)² at points anywhere and about the surface (Gropp et al., ICML 2020)."""
    count = max(len(hits), 1)
    anywhere = 2 * torch.rand(count, 3, generator=random) - 1
    about = hits + (SHELL * torch.randn(hits.shape, generator=random)).to(hits)
    _, gradient = value_and_gradient(surface, torch.cat([anywhere.to(hits), about]))
    return _unit(gradient)


def _unit(gradient: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    return (gradient.norm(dim=-1) - 1).square().mean()
