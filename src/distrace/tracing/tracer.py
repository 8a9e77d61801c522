"""The default tracer: occupied cells, cones of blocks of pixels, single rays."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.fields.precision import fastest_field
from distrace.rays import Rays
from distrace.tracing.bounds import Occupancy, find_occupancy
from distrace.tracing.evaluator import Evaluator
from distrace.tracing.images import BRANCH, Pixels, reach
from distrace.tracing.march import BRACKET, EXACT, EXACT_ALONE, ROUGH, Queried, State, evaluations, march, march_cones
from distrace.tracing.sphere_tracing import Outcome, Trace

LARGEST = 0.012  # radii: of the cones of the largest blocks; a fifth of a cell of the occupancy
GAP = 0.003  # radii, and half a pixel: the most that the balls around a ray's samples may leave unchecked
FINEST = 16  # × the machine epsilon: the least tolerance, in radii
FINE = 0.05  # pixels: the tolerance of a hit, if less than the configuration's


@dataclass(frozen=True)
class TracerConfig:
    """`tolerance`: the largest error of a hit, in radii. `lipschitz`: a bound on |∇f|, by default measured.

    A field that is steeper than the bound may lose thin parts; one that is flatter takes more steps. An occupancy has
    the bound that it was measured with, and takes no other.
    """

    tolerance: float = 2.5e-4
    lipschitz: float | None = None

    def __post_init__(self) -> None:
        given = [self.tolerance] if self.lipschitz is None else [self.tolerance, self.lipschitz]
        if not all(0 < value < math.inf for value in given):
            raise ValueError(f"{self} cannot trace: the tolerance and the Lipschitz constant must be positive, finite")


@torch.no_grad()
def trace_images(
    sdf: SDF | BatchField,
    camera: Camera,
    rays: Rays,
    radius: float = 1.0,
    config: TracerConfig = TracerConfig(),
    occupancy: Occupancy | None = None,
) -> tuple[Trace, Occupancy]:
    """Traces the rays of a camera, or of a batch; the returned occupancy serves further views of the same field.

    Raises `ValueError` for an occupancy of another radius, number of shapes or Lipschitz constant, or too few cameras.
    """
    views = camera.intrinsics.shape[:-2].numel()
    if isinstance(sdf, BatchField) and len(sdf) != views:
        raise ValueError(f"a field of {len(sdf)} shapes and {views} cameras were given; give a camera for each shape")
    with torch.autocast(rays.origins.device.type, enabled=False):  # distances need their precision
        pixels = Pixels.of_camera(camera, rays, radius, LARGEST)
        return _traced(sdf, pixels, radius, config, occupancy)


@torch.no_grad()
def trace_rays(
    sdf: SDF, rays: Rays, radius: float = 1.0, config: TracerConfig = TracerConfig(), occupancy: Occupancy | None = None
) -> tuple[Trace, Occupancy]:
    """Traces rays [n] that are no image, each on its own. Raises `ValueError` as `trace_images`."""
    if isinstance(sdf, BatchField):
        raise ValueError(f"a field of {len(sdf)} shapes was given with rays; give one of them, as `field[0]`")
    with torch.autocast(rays.origins.device.type, enabled=False):
        pixels = Pixels.of_rays(Rays(rays.origins / radius, rays.directions))
        return _traced(sdf, pixels, radius, config, occupancy)


def _traced(
    sdf: SDF | BatchField, pixels: Pixels, radius: float, config: TracerConfig, occupancy: Occupancy | None
) -> tuple[Trace, Occupancy]:
    cheap = fastest_field(sdf) if occupancy is None else occupancy.cheap
    evaluator = Evaluator(sdf, radius, cheap)
    if occupancy is None:
        occupancy = replace(find_occupancy(evaluator, pixels.width, config.lipschitz), cheap=cheap)
    else:
        _check(occupancy, evaluator, config.lipschitz)
    evaluator.normalise(occupancy.lipschitz)
    number, span = _spans(evaluator, occupancy, pixels)
    state, counts = _marched(evaluator, pixels, config.tolerance, number, span)
    trace = _result(pixels, number, state, span[1], counts, radius)
    return replace(trace, setup_evaluations=evaluator.evaluations - int(trace.evaluations.sum())), occupancy


def _spans(evaluator: Evaluator, occupancy: Occupancy, pixels: Pixels) -> tuple[Int[Tensor, "n"], Float[Tensor, "3 n"]]:
    """Returns the rays that may meet surface; their begin, end, and their begin if f is steeper than its bound."""
    number = pixels.blocks()
    span = occupancy.entered(pixels.lines[number])
    for level in range(pixels.level, 0, -1):
        number, span = _not_empty(number, span)
        lines = pixels.lines[number]
        cone = reach(BRANCH**level)
        width = cone * lines.of_view(pixels.width)
        growth = cone * lines.of_view(pixels.growth)
        radius = torch.addcmul(width, growth, span[1])
        span = march_cones(evaluator.rough, lines, span, radius, evaluator.error)
        number = pixels.split(number, BRANCH ** (level - 1))
        span = span.repeat_interleave(BRANCH**2, 1)
    t, last, begin = span.unbind(0)
    near, far = (bound[number] for bound in pixels.span)
    return _not_empty(number, torch.stack([t.maximum(near), last.minimum(far), begin.maximum(near)]))


def _marched(
    evaluator: Evaluator, pixels: Pixels, tolerance: float, number: Int[Tensor, "n"], span: Float[Tensor, "3 n"]
) -> tuple[State, Shaped[Tensor, "n"]]:
    """Returns the final state of these rays, and the number of evaluations of f for each."""
    t, far, begin = span.unbind(0)
    lines = pixels.lines[number]
    all_rays = torch.arange(len(number), device=number.device)
    finest = FINEST * torch.finfo(t.dtype).eps
    limits = [(pixels.middle / 4).clamp(finest, GAP / 2), (FINE * pixels.middle).clamp(finest, max(tolerance, finest))]
    gap, tolerances = (lines.of_view(limit).expand_as(t) for limit in limits)
    state = State.begin(evaluator.rough, lines, t, far, gap, tolerances)
    states = torch.stack(state)
    clear = state.value > evaluator.error
    queried: list[Queried] = [(all_rays, 1)]
    if evaluator.error:
        queried += march(evaluator.rough, lines, states, all_rays[clear], ROUGH, evaluator.error)
    active = states[0] < far
    restarted = all_rays[~clear]
    if len(restarted):  # where f is steeper than the bound a ball is too large, and a cone may end in the solid
        limits = (limit[restarted] for limit in (begin, far, gap, tolerances))
        states[:, restarted] = torch.stack(State.begin(evaluator.exact, lines[restarted], *limits))
        queried.append((restarted, 1))
        active = active & (states[1] > -tolerances)
    queried += march(evaluator.exact, lines, states, all_rays[active], EXACT if evaluator.error else EXACT_ALONE)
    return State(*states.unbind(0)), evaluations(queried, len(number))


def _check(occupancy: Occupancy, evaluator: Evaluator, lipschitz: float | None) -> None:
    if occupancy.radius != evaluator.radius:
        radii = f"{occupancy.radius} was given with {evaluator.radius}"
        raise ValueError(f"an occupancy for a radius of {radii}; leave it out")
    if len(occupancy.occupied) != evaluator.shapes:
        fields = f"{len(occupancy.occupied)} shapes was given with a field of {evaluator.shapes}"
        raise ValueError(f"an occupancy of {fields}; leave the occupancy out")
    if lipschitz is not None and (occupancy.lipschitz != lipschitz).any():
        measured = f"{float(occupancy.lipschitz.max()):.4g}"
        raise ValueError(f"lipschitz={lipschitz} was given with an occupancy for {measured}; leave the occupancy out")


def _not_empty(number: Int[Tensor, "n"], span: Float[Tensor, "3 n"]) -> tuple[Int[Tensor, "m"], Float[Tensor, "3 m"]]:
    """Returns the rays with a non-empty interval."""
    t, end, _ = span.unbind(0)
    active = t < end
    return number[active], span[:, active]


def _result(
    pixels: Pixels,
    number: Int[Tensor, "n"],
    state: State,
    far: Float[Tensor, "n"],
    counts: Shaped[Tensor, "n"],
    radius: float,
) -> Trace:
    """Returns the trace of all rays, in the world's lengths; rays without a state come closest at the centre."""
    at = state.root.clamp(state.t - state.tolerance, torch.add(state.end, state.tolerance, alpha=BRACKET + 1))
    outcome = (at < far) * int(Outcome.HIT)  # or ESCAPED, which is 0
    unfinished = state.t < state.end
    outcome = outcome.masked_fill(unfinished, int(Outcome.EXHAUSTED))
    outcome = outcome.masked_fill(unfinished & (state.value <= 0), int(Outcome.INSIDE))
    hit = outcome == int(Outcome.HIT)
    rows = [torch.where(hit, at, torch.inf), torch.where(hit, at, state.closest), outcome, counts]
    near, far = pixels.span
    middle = torch.where(near < far, near.lerp(far, 0.5), torch.inf)
    zero = torch.zeros_like(near)
    table = torch.stack([torch.full_like(near, torch.inf), middle, zero, zero])
    table.index_copy_(1, number, torch.stack([row.to(near.dtype) for row in rows]))
    table[:2].add_(pixels.start).mul_(radius)
    distance, closest, outcome, counts = pixels.image(table).unbind(0)
    return Trace(distance, outcome.long(), closest, closest, counts.long())
