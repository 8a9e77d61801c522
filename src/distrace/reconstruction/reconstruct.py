"""Shape and colours of one object from photographs with masks, by a network's weights: no class, no prior.

As in IDR (Yariv et al., *Multiview neural surface reconstruction*, NeurIPS 2020) rays are sphere-traced, and the points
that they hit have their exact derivatives by the weights. Colours and outlines are compared with the photographs'.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.photos.multiview_depth import NO_DEPTHS, AgreedDepths, contradicted
from distrace.reconstruction.camera_refinement import motions, relative
from distrace.reconstruction.colour_refinement import Canvas
from distrace.reconstruction.matching import Matching
from distrace.reconstruction.surface_network import ColourNetwork, CountedSurface, SurfaceNetwork, SurfaceSpecs
from distrace.reconstruction.terms import Pool, terms_of
from distrace.training.losses import record

STEEPEST = 1.0  # norm of the gradient by the surface's weights: a few rays that graze must not throw it off


@dataclass(frozen=True)
class ReconstructConfig:
    """The schedule. Sizes are the longer sides of the images, in pixels: coarse ones, then finer ones."""

    steps: int = 16_000
    beginning: int = 1500  # steps before, of the surface alone, towards the visual hull and what depths tell
    sizes: tuple[int, ...] = (160, 320)
    rays: int = 1024  # of a step: half of the object, half around it
    learning_rate: float = 1e-3  # of the colours' network …
    surface_rate: float = 0.5  # … and × this of the surface's …
    camera_rate: float = 0.1  # … and of the cameras' motions; 0 where cameras are known exactly
    last_rate: float = 0.05  # × as much at the end; the rate falls exponentially
    colour: float = 1.0  # the weights of the terms
    patches: float = 0.5
    outline: float = 200.0
    eikonal: float = 1.0
    firmness: float = 10.0  # × `eikonal` with depths: the surface need not wander far then, and even parts stay smooth
    depths: float = 20.0
    sharpness: float = 100.0  # of an outline at first, per radius: it doubles …
    sharpenings: int = 3  # … so often, evenly over the steps
    painting: float = 0.05  # of the steps, at first, in which colours are learnt and do not shape the surface
    retouching: int = 1000  # steps after all others, of the colours alone …
    retouched: int = 4096  # … and the pixels of each
    colours_shape: bool = True  # without, only outlines shape the surface: a visual hull
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.rays < 4 or not self.sizes or min(self.sizes) < 8:
            given = f"{self.steps} steps of {self.rays} rays and images of {self.sizes} pixels"
            raise ValueError(f"{given} were asked for; at least 1 step, 4 rays and 8 pixels are needed")
        if self.retouching < 0 or self.retouched < 1:
            given = f"{self.retouching} steps of {self.retouched} pixels"
            raise ValueError(f"{given} were asked for to retouch; at least 0 steps and 1 pixel are needed")

    @property
    def total(self) -> int:
        """Steps, with those that retouch."""
        return self.steps + self.retouching

    def weight(self, term: str, with_depths: bool) -> float:
        """Of a term of the loss."""
        return getattr(self, term) * (self.firmness if with_depths and term == "eikonal" else 1.0)

    def rate(self, step: int) -> float:
        """Falls exponentially, and once more while colours are retouched."""
        part = step / self.steps if step < self.steps else (step - self.steps) / self.retouching
        return self.learning_rate * self.last_rate**part

    def sharp(self, step: int) -> float:
        return self.sharpness * 2.0 ** (step * (self.sharpenings + 1) // self.steps)

    def shapes(self, step: int) -> bool:
        """Whether colours shape the surface."""
        return self.colours_shape and step >= self.painting * self.steps

    def size(self, step: int) -> int:
        return self.sizes[step * len(self.sizes) // self.steps]


@dataclass
class Reconstruction:
    """What a run changes as it goes on, and what a checkpoint holds."""

    surface: SurfaceNetwork
    colour: ColourNetwork
    steps_of_views: Float[Tensor, "views 6"]  # by which each camera is moved: see `motions`
    optimiser: torch.optim.Adam
    step: int = 0
    seconds: float = 0.0  # of all steps
    evaluations: int = 0  # of the surface's network
    course: dict[str, list[float]] = field(default_factory=dict)  # of each term, as `course.py` keeps it

    @staticmethod
    def fresh(specs: SurfaceSpecs, config: ReconstructConfig, views: int, device: torch.device) -> "Reconstruction":
        torch.manual_seed(config.seed)
        surface, colour = SurfaceNetwork(specs).to(device), ColourNetwork(specs).to(device)
        steps_of_views = torch.zeros(views, 6, device=device, requires_grad=True)
        groups = [
            {"params": list(surface.parameters()), "share": config.surface_rate},
            {"params": list(colour.parameters()), "share": 1.0},
            {"params": [steps_of_views], "share": config.camera_rate},
        ]
        return Reconstruction(surface, colour, steps_of_views, torch.optim.Adam(groups, config.learning_rate))

    def motions(self) -> Float[Tensor, "views 4 4"]:
        """Of the views that are fitted to, in their order."""
        return motions(relative(self.steps_of_views))

    def record(self, terms: dict[str, float], seconds: float, since: int = 0) -> None:
        """Counts a step done, one of those that have these terms `since` some step."""
        for name, value in terms.items():
            record(self.course.setdefault(name, []), self.step - since, value)
        self.step, self.seconds = self.step + 1, self.seconds + seconds


@dataclass(frozen=True)
class Step:
    """One step done: the terms of its loss, and how long it took."""

    step: int
    terms: dict[str, float]
    seconds: float


def reconstruct(
    photographs: Sequence[Photograph],
    state: Reconstruction,
    config: ReconstructConfig = ReconstructConfig(),
    depths: AgreedDepths = NO_DEPTHS,
) -> Iterator[Step]:
    """Fits in place and yields after every step, from wherever `state` is to the last one: shapes, then retouches.

    The draw of a step depends on the seed and the step alone: a run that was stopped goes on as if it had not been.
    Raises `ValueError` for photographs without masks, or masks without object.
    """
    device, size = state.surface.last.weight.device, 0
    while state.step < config.steps:
        began = time.perf_counter()
        if config.size(state.step) != size:
            size = config.size(state.step)
            coarse = [each.at_most(size) for each in photographs]
            pool, matching = Pool.of(coarse), Matching.of(coarse, device)
        random = _drawing(config, state.step)
        some, surface = pool.drawn(config.rays, random).to(device), CountedSurface(state.surface)
        shapes, sharp, moves = config.shapes(state.step), config.sharp(state.step), state.motions()
        terms = terms_of(some.moved(moves), matching.moved(moves), surface, state.colour, random, shapes, sharp)
        if len(depths):
            terms["depths"] = contradicted(surface(depths.drawn(config.rays // 4, random).to(device)))
        state.evaluations += surface.evaluations
        weighted = torch.stack([config.weight(name, len(depths) > 0) * term for name, term in terms.items()])
        yield _stepped(state, weighted.sum(), terms, config, began)
    if state.step < config.total:
        yield from _retouched(photographs, state, config)


def _retouched(photographs: Sequence[Photograph], state: Reconstruction, config: ReconstructConfig) -> Iterator[Step]:
    """The last steps, of colours alone; none where no ray meets the surface."""
    began, surface = time.perf_counter(), CountedSurface(state.surface)
    finest = Pool.of([each.at_most(config.sizes[-1]) for each in photographs]).pixels
    with torch.no_grad():
        pixels = finest.to(state.surface.last.weight.device).moved(state.motions())
    canvas = Canvas.of(surface, pixels, _drawing(config, config.steps))
    state.evaluations += surface.evaluations
    while len(canvas.points) and state.step < config.total:
        term = canvas.term(state.colour, config.retouched, _drawing(config, state.step))
        yield _stepped(state, term, {"retouch": term}, config, began)
        began = time.perf_counter()


def _drawing(config: ReconstructConfig, step: int) -> torch.Generator:
    return torch.Generator().manual_seed((config.seed << 32) + step)


def _stepped(
    state: Reconstruction, loss: Tensor, terms: dict[str, Tensor], config: ReconstructConfig, began: float
) -> Step:
    """All that the loss depends on moves against its slope."""
    for group in state.optimiser.param_groups:
        group["lr"] = group["share"] * config.rate(state.step)
    state.optimiser.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(state.surface.parameters(), STEEPEST)
    state.optimiser.step()
    told = {name: value.item() for name, value in terms.items()}
    since = 0 if state.step < config.steps else config.steps
    state.record(told, seconds := time.perf_counter() - began, since)
    return Step(state.step, told, seconds)
