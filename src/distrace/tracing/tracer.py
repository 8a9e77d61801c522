"""The default tracer: cells that may hold surface, cones of blocks of pixels, predicted roots, single rays."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from distrace.batch_field import BatchField
from distrace.camera import Camera
from distrace.field import SDF
from distrace.rays import Rays, meet_sphere
from distrace.trace import Outcome, Trace
from distrace.tracing.batch import Batch
from distrace.tracing.bounds import Occupancy, find_occupancy
from distrace.tracing.evaluator import Evaluator
from distrace.tracing.images import BRANCH, Images, beside_middle, reach
from distrace.tracing.march import march_cones, march_rays
from distrace.tracing.roots import Found, Roots, refine

TOP = 0.03  # radii: the cones of the largest blocks reach no farther; half a cell of the occupancy
CONE_STEPS = 8  # of each level
MIDDLE_STEPS = (1, 1, 1)  # of the middle rays from which the pixels around them are predicted
RAY_WIDTH = 0.01  # radii: the footprint of rays that are no pixels
PREDICTED = 2e-2  # radii before a root that the pixels around predict, at most, that may stay unchecked
STEPS = (1,) * 9 + (2,) * 3  # of single rays by rough values
LATER_STEPS = (1,) * 8 + (2,) * 4 + (4,) * 4 + (8,) * 40  # by exact values, of rays that graze the surface
LOOKS = 3  # at a root that was predicted from the pixels around …
LATER_LOOKS = 6  # … and by a ray's own march


@dataclass(frozen=True)
class TracerConfig:
    """`tolerance`: how far off a hit may be, in radii. `lipschitz`: a bound on |∇f|; measured if not given.

    A field that is steeper than the bound may lose what is thin; one that is flatter takes more steps.
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

    Raises `ValueError` for an occupancy of another radius or number of shapes, and for another number of cameras than
    of shapes.
    """
    camera = camera.detach()
    images = Images(camera, radius)
    evaluator, occupancy, setup = _prepared(sdf, images.eye, radius, config, occupancy)
    if isinstance(sdf, BatchField) and evaluator.shapes != images.views:
        raise ValueError(
            f"a field of {evaluator.shapes} shapes and {images.views} cameras were given; give a camera for each shape"
        )
    level = images.level_of(TOP)
    stride = BRANCH**level
    batch = occupancy.entered(images.blocks(stride))
    predicted: Roots | None = None
    while stride > 1:
        batch = march_cones(evaluator, batch, reach(stride), CONE_STEPS)
        stride //= BRANCH
        middle = batch
        batch, parent = images.split(batch, stride)
        if stride == 1:
            batch, kept = _in_sphere(batch)
            predicted = _predicted(evaluator, middle, images, batch, parent[kept])
    if level == 0:
        batch, _ = _in_sphere(batch)
    setup += evaluator.evaluations
    pixel = (batch.view * images.height + batch.row) * images.width + batch.column
    shape = torch.Size([*camera.intrinsics.shape[:-2], camera.height, camera.width])
    trace = _traced(evaluator, batch, predicted, config.tolerance)
    shift = images.shift.reshape(*camera.intrinsics.shape[:-2], 1, 1)
    return _spread(trace, pixel, images.beside().reshape(shape), shift, radius, setup), occupancy


@torch.no_grad()
def trace_rays(
    sdf: SDF, rays: Rays, radius: float = 1.0, config: TracerConfig = TracerConfig(), occupancy: Occupancy | None = None
) -> tuple[Trace, Occupancy]:
    """The same for rays [n] that are no image: each is marched on its own. Raises `ValueError` as `trace_images`."""
    rays = rays.detach()
    evaluator, occupancy, setup = _prepared(sdf, rays.directions, radius, config, occupancy)
    unit = Rays(rays.origins / radius, rays.directions)
    bounds = meet_sphere(unit, 2.0)
    start = bounds.near.nan_to_num(posinf=0.0)
    index = torch.arange(len(start), device=start.device)
    nothing = torch.zeros_like(start)
    width = nothing[:, None] + nothing.new_tensor([RAY_WIDTH, 0.0])
    everywhere = Batch(torch.zeros_like(index), index, index, unit.at(start), unit.directions, width, nothing, nothing)
    batch, _ = _in_sphere(occupancy.entered(everywhere))
    beside = beside_middle(Rays(everywhere.origins, everywhere.directions))
    trace = _traced(evaluator, batch, None, config.tolerance)
    return _spread(trace, batch.row, beside, start, radius, setup), occupancy


def _in_sphere(batch: Batch) -> tuple[Batch, Int[Tensor, "kept"]]:
    """Rays cut off at the unit sphere, without those that miss it; and which they were."""
    bounds = meet_sphere(Rays(batch.origins, batch.directions))
    t, far = batch.t.maximum(bounds.near), batch.far.minimum(bounds.far)
    kept = (t < far).nonzero()[:, 0]
    return replace(batch, t=t, far=far)[kept], kept


def _prepared(
    sdf: SDF | BatchField, like: Tensor, radius: float, config: TracerConfig, occupancy: Occupancy | None
) -> tuple[Evaluator, Occupancy, int]:
    evaluator = Evaluator(sdf, radius)
    if occupancy is None:
        occupancy = find_occupancy(evaluator, like, config.lipschitz)
    elif occupancy.radius != radius:
        raise ValueError(f"an occupancy for a radius of {occupancy.radius} was given with {radius}; leave it out")
    elif len(occupancy.occupied) != evaluator.shapes:
        given = len(occupancy.occupied)
        raise ValueError(
            f"an occupancy of {given} shapes was given with a field of {evaluator.shapes}; leave the occupancy out"
        )
    setup, evaluator.evaluations = evaluator.evaluations, 0
    evaluator.normalise(occupancy.lipschitz)
    return evaluator, occupancy, setup


def _predicted(evaluator: Evaluator, middle: Batch, images: Images, batch: Batch, parent: Int[Tensor, "n"]) -> Roots:
    """Where the pixels of blocks of 3 × 3 meet the surface, if it is flat between the middle rays of neighbours.

    1 / t of a plane is nearly linear in the image. A missing neighbour is replaced by the opposite one.
    """
    roots = march_rays(evaluator.rough, middle, MIDDLE_STEPS).roots
    some = middle[roots.ray]
    t = torch.full_like(middle.t, torch.nan)
    slope = t.clone()
    t[roots.ray] = roots.t - evaluator.exact(some, roots.t) / roots.slope
    slope[roots.ray] = roots.slope
    rows, columns = -(-images.height // BRANCH) + 2, -(-images.width // BRANCH) + 2
    grid = t.new_full((images.views * rows * columns,), torch.nan)
    at = (middle.view * rows + middle.row + 1) * columns + middle.column + 1
    shift = images.shift[middle.view]
    inverse = 1 / (t + shift)
    grid[at] = inverse
    total = inverse[parent]
    for offset, step in ((batch.row % BRANCH - 1, columns), (batch.column % BRANCH - 1, 1)):
        ahead = grid[at[parent] + step * offset]
        behind = grid[at[parent] - step * offset]
        change = torch.where(ahead.isnan(), inverse[parent] - behind, ahead - inverse[parent])
        total = total + torch.where(offset == 0, 0.0, change / BRANCH)
    root = 1 / total - shift[parent]
    enters = batch.t == meet_sphere(Rays(batch.origins, batch.directions)).near  # perhaps in the solid
    usable = ((root > batch.t) & (root - batch.t < PREDICTED) & (root < batch.far) & ~enters).nonzero()[:, 0]
    low = batch.t[usable]
    return Roots(usable, root[usable], slope[parent[usable]], low, torch.full_like(low, torch.inf))


def _traced(evaluator: Evaluator, batch: Batch, predicted: Roots | None, tolerance: float) -> Trace:
    """Single rays: those with a predicted root, then by rough values, then, where these leave doubt, by exact ones."""
    distance = torch.full_like(batch.t, torch.nan)
    closest = batch.t.clone()
    evaluations = torch.zeros_like(batch.view)
    outcome = torch.full_like(batch.view, int(Outcome.ESCAPED))
    if predicted is not None:
        found = refine(evaluator, batch, predicted, tolerance, LOOKS, settle=False)
        distance[predicted.ray] = found.t
        evaluations[predicted.ray] += found.evaluations
    ray = distance.isnan().nonzero()[:, 0]
    some = batch[ray]
    passes = ((evaluator.rough, STEPS, evaluator.error, True), (evaluator.exact, LATER_STEPS, 0.0, False))
    for evaluate, steps, error, predict in passes:
        marched = march_rays(evaluate, some, steps, error=error, predict=predict)
        found = refine(evaluator, some, marched.roots, tolerance, LATER_LOOKS)
        at = ray[marched.roots.ray]
        beyond = found.t > some.far[marched.roots.ray]
        distance[at] = found.t.masked_fill(beyond, torch.nan)
        closest[ray] = marched.closest
        evaluations[ray] += marched.evaluations
        evaluations[at] += found.evaluations
        missed = (found.t.isnan() & ~beyond & (found.clear < some.far[marched.roots.ray])).nonzero()[:, 0]
        left = torch.cat([marched.stopped, marched.roots.ray[missed]])
        begins, first = ray[marched.inside], some[marched.inside]
        ray, some = ray[left], some[left].from_(torch.cat([marched.clear, found.clear[missed]]))
    outcome[ray] = int(Outcome.EXHAUSTED)
    outcome[begins] = int(Outcome.INSIDE)
    past = (first.t > meet_sphere(Rays(first.origins, first.directions)).near + tolerance).nonzero()[:, 0]
    passed = begins[past]
    back = _stepped_back(evaluator, first[past], tolerance)
    distance[passed] = back.t
    evaluations[passed] += back.evaluations
    hit = ~distance.isnan()
    outcome = outcome.masked_fill(hit, int(Outcome.HIT))
    closest = torch.where(hit, distance, closest)
    return Trace(distance.masked_fill(~hit, torch.inf), outcome, closest, closest, evaluations)


def _stepped_back(evaluator: Evaluator, batch: Batch, tolerance: float) -> Found:
    """Roots of rays that a ball too large, where f is steeper than the bound, has led into the solid."""
    index = torch.arange(len(batch), device=batch.t.device)
    value = evaluator.exact(batch, batch.t)
    roots = Roots(index, batch.t + value, -torch.ones_like(value), batch.t + 4 * value, batch.t)
    found = refine(evaluator, batch, roots, tolerance, LATER_LOOKS)
    return replace(found, evaluations=found.evaluations + 1)


def _spread(trace: Trace, ray: Tensor, beside: Tensor, shift: Tensor, radius: float, setup: int) -> Trace:
    """The results of some rays among all, in the world's lengths; the others passed the sphere's middle `beside`."""
    whole = {
        "distance": torch.full_like(beside, torch.inf),
        "outcome": torch.full_like(beside, int(Outcome.ESCAPED), dtype=torch.int64),
        "closest": beside,
        "stopped": beside,
        "evaluations": torch.zeros_like(beside, dtype=torch.int64),
    }
    for name, image in whole.items():
        values = image.reshape(-1).index_put((ray,), trace.images()[name])
        whole[name] = values.reshape(beside.shape)
    for name in ("distance", "closest", "stopped"):
        whole[name] = (whole[name] + shift) * radius
    return Trace(**whole, setup_evaluations=setup)
