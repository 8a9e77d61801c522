"""The default tracer: cells that may hold surface, cones of blocks of pixels, single rays."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.batch_field import BatchField
from distrace.camera import Camera
from distrace.field import SDF
from distrace.rays import Rays
from distrace.trace import Outcome, Trace
from distrace.tracing.bounds import Occupancy, find_occupancy
from distrace.tracing.evaluator import Evaluator, cheaper
from distrace.tracing.images import BRANCH, Pixels, reach
from distrace.tracing.march import ALONE, NEAR, NEVER, ROUGH, Looked, State, evaluations, march, march_cones

LARGEST = 0.012  # radii: the cones of the largest blocks reach no farther; a fifth of a cell of the occupancy
GAP = 0.006  # radii of a ray, and two pixels, at most, that the balls around its samples may leave unchecked
BRACKET = 2.0  # tolerances: in a shorter bracket the root of the line is taken
FINE = 0.02  # pixels: the tolerance of a hit, where that is less than a configuration's


@dataclass(frozen=True)
class TracerConfig:
    """`tolerance`: how far off a hit may be, in radii. `lipschitz`: a bound on |∇f|; measured if not given.

    A field that is steeper than the bound may lose what is thin; one that is flatter takes more steps. An occupancy has
    the bound that it was measured with, and takes no other.
    """

    tolerance: float = 2.5e-4
    lipschitz: float | None = None

    def __post_init__(self) -> None:
        given = [self.tolerance] if self.lipschitz is None else [self.tolerance, self.lipschitz]
        if not all(0 < each < math.inf for each in given):
            raise ValueError(f"{self} cannot trace: the tolerance and the Lipschitz constant must be positive, finite")


@torch.no_grad()
def trace_images(
    sdf: SDF | BatchField,
    camera: Camera,
    radius: float = 1.0,
    config: TracerConfig = TracerConfig(),
    occupancy: Occupancy | None = None,
) -> tuple[Trace, Occupancy]:
    """Traces all pixels of a camera, or of a batch of them; the occupancy serves further views of the same field.

    Raises `ValueError` for an occupancy of another radius, number of shapes or Lipschitz constant, and for another
    number of cameras than of shapes.
    """
    views = camera.intrinsics.shape[:-2].numel()
    if isinstance(sdf, BatchField) and len(sdf) != views:
        raise ValueError(f"a field of {len(sdf)} shapes and {views} cameras were given; give a camera for each shape")
    pixels = Pixels.of_camera(camera, radius, LARGEST)
    return _traced(sdf, pixels, radius, config, occupancy)


@torch.no_grad()
def trace_rays(
    sdf: SDF, rays: Rays, radius: float = 1.0, config: TracerConfig = TracerConfig(), occupancy: Occupancy | None = None
) -> tuple[Trace, Occupancy]:
    """The same for rays [n] that are no image: each is marched on its own. Raises `ValueError` as `trace_images`."""
    rays = rays.detach()
    pixels = Pixels.of_rays(Rays(rays.origins / radius, rays.directions))
    return _traced(sdf, pixels, radius, config, occupancy)


def _traced(
    sdf: SDF | BatchField, pixels: Pixels, radius: float, config: TracerConfig, occupancy: Occupancy | None
) -> tuple[Trace, Occupancy]:
    evaluator = Evaluator(sdf, radius, cheaper(sdf) if occupancy is None else occupancy.cheap)
    if occupancy is None:
        occupancy = find_occupancy(evaluator, pixels.width, config.lipschitz)
    else:
        _check(occupancy, evaluator, config.lipschitz)
    evaluator.normalise(occupancy.lipschitz)
    number = pixels.blocks()
    span = occupancy.entered(pixels.lines[number])
    for level in range(pixels.level, 0, -1):
        number, span = _not_empty(number, span)
        lines, cone = pixels.lines[number], reach(BRANCH**level)
        width, growth = (cone * lines.of_view(each) for each in (pixels.width, pixels.growth))
        wide = torch.addcmul(width, growth, span[1])
        span = march_cones(evaluator.rough, lines, span, wide, len(ROUGH), evaluator.error)
        number, span = pixels.split(number, BRANCH ** (level - 1)), span.repeat_interleave(BRANCH**2, 1)
    near, far = pixels.lines[number].in_sphere()
    begin = span[2].maximum(near)
    number, span = _not_empty(number, torch.stack([span[0].maximum(near), span[1].minimum(far), begin]))
    lines = pixels.lines[number]
    t, far, begin = span.unbind(0)
    limits = [pixels.middle.clamp_max(GAP / 2), (FINE * pixels.middle).clamp_max(config.tolerance)]
    limits = [lines.of_view(each).expand_as(t) for each in [*limits, BRACKET * limits[1]]]
    states = torch.stack(State.of_spans(t, far, *limits))
    setup = evaluator.evaluations
    left = every = torch.arange(len(number), device=number.device)
    looked: list[Looked] = [(every[:0], 0)]
    if evaluator.error:
        looked += march(evaluator.rough, lines, states, every, ROUGH, evaluator.error)
        left = every[states[0] < far]
    looked += march(evaluator.exact, lines, states, left, NEAR if evaluator.error else ALONE)
    overshot = every[(states[1] >= NEVER) & (begin < t)]
    if len(overshot):  # where f is steeper than the bound a ball is too large, and a cone may end in the solid
        again = State.of_spans(begin[overshot], far[overshot], *(limit[overshot] for limit in limits))
        states[:, overshot] = torch.stack(again)
        looked += march(evaluator.exact, lines, states, overshot, ALONE)
    looks = evaluations(looked, len(number))
    trace = _result(pixels, number, State(*states.unbind(0)), far, looks, radius)
    return replace(trace, setup_evaluations=setup), occupancy


def _check(occupancy: Occupancy, evaluator: Evaluator, lipschitz: float | None) -> None:
    given, shapes, radius = len(occupancy.occupied), evaluator.shapes, evaluator.radius
    if occupancy.radius != radius:
        raise ValueError(f"an occupancy for a radius of {occupancy.radius} was given with {radius}; leave it out")
    if given != shapes:
        raise ValueError(f"an occupancy of {given} shapes was given with a field of {shapes}; leave the occupancy out")
    if lipschitz is not None and (occupancy.lipschitz != lipschitz).any():
        known = f"{float(occupancy.lipschitz.max()):.4g}"
        raise ValueError(f"lipschitz={lipschitz} was given with an occupancy for {known}; leave the occupancy out")


def _not_empty(number: Int[Tensor, "n"], span: Float[Tensor, "3 n"]) -> tuple[Int[Tensor, "m"], Float[Tensor, "3 m"]]:
    """Without the rays of which nothing is left."""
    some = span[0] < span[1]
    return number[some], span[:, some]


def _result(
    pixels: Pixels,
    number: Int[Tensor, "n"],
    state: State,
    far: Float[Tensor, "n"],
    looks: Int[Tensor, "n"],
    radius: float,
) -> Trace:
    """What became of all rays, in the world's lengths; those without a state passed the sphere's middle."""
    at = state.root.minimum(state.end + state.bracket)
    outcome = (at < far) * int(Outcome.HIT)  # or ESCAPED, which is 0
    outcome = outcome.masked_fill(state.value >= NEVER, int(Outcome.INSIDE))
    outcome = outcome.masked_fill(state.going > 0, int(Outcome.EXHAUSTED))
    hit = outcome == int(Outcome.HIT)
    found = [torch.where(hit, at, torch.inf), torch.where(hit, at, state.closest), outcome, looks]
    near, far = pixels.lines.in_sphere()
    beside = torch.where(near < far, near.lerp(far, 0.5), torch.inf)
    zero = torch.zeros_like(near)
    table = torch.stack([torch.full_like(near, torch.inf), beside, zero, zero])
    table.index_copy_(1, number, torch.stack([each.to(near.dtype) for each in found]))
    table[:2].add_(pixels.start).mul_(radius)
    lengths, counts = pixels.image(table).split(2)
    distance, closest = lengths.unbind(0)
    outcome, looks = counts.long().unbind(0)
    return Trace(distance, outcome, closest, closest, looks)
