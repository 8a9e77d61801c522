"""The fast tracer: a lattice foretells where rays meet the surface, neighbouring pixels sharpen it, one look tells.

Images are traced from coarse to fine: the first pixels approach the surface step by step; a pixel between others that
hit starts from their distances and slopes. Then outlines are followed: a pixel beside one that hits nearer looks there,
too. What does not settle is marched.
"""

from dataclasses import dataclass, replace
from itertools import product

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.fast import outlines, passes
from distrace.fast.lattice import Lattice, build
from distrace.fast.picture import FastConfig, Picture
from distrace.field import SDF, narrowed
from distrace.rays import meet_sphere
from distrace.steepness import typical_slope
from distrace.trace import Trace, sphere_trace

ROUNDS = 4  # at most, in which a field's steepness is found
TILE = 1024  # pixels along each side of what is traced at once: a bound on memory


@torch.no_grad()
def fast_trace(
    sdf: SDF,
    camera: Camera,
    radius: float = 1.0,
    config: FastConfig = FastConfig(),
    lattice: Lattice | None = None,
    last: Trace | None = None,
) -> tuple[Trace, Lattice]:
    """Traces all pixels of a camera, or of a batch of them; the lattice can be given on to the next view of the field.

    `last` is the trace of nearly the same field by nearly the same camera: guesses start from it.
    """
    setup = 0
    if lattice is None:
        lattice, setup = prepared(sdf, camera.intrinsics.detach(), radius, config)
    elif lattice.radius != radius:
        raise ValueError(
            f"a lattice for a radius of {lattice.radius} was given with a radius of {radius}; leave it out"
        )
    unit, steepness = _unit(sdf, radius, lattice.steepness), lattice.steepness
    last = last and last.scaled(1 / radius, 1 / steepness)
    trace = _tiled(unit, camera.detach().scaled(1 / radius), config, lattice, last)
    return replace(trace.scaled(radius, steepness), setup_evaluations=setup), lattice


def near_surface(sdf: SDF, lattice: Lattice | None) -> SDF:
    """The same field, cheaper near its surface, where a lattice of it knows one."""
    if lattice is None or _unit(sdf, lattice.radius, lattice.steepness) != lattice.field:
        return sdf
    return lattice.near.sdf if isinstance(lattice.near, _Unit) else lattice.near


@torch.no_grad()
def prepared(sdf: SDF, like: Tensor, radius: float = 1.0, config: FastConfig = FastConfig()) -> tuple[Lattice, int]:
    """A lattice of the field; where that turns out to be too steep, one of the field divided by its steepness.

    And how many evaluations all took. What is thin in a steep field shows only in a lattice of the divided one, and so
    does how steep it is there: that is found in rounds.
    """
    steepness, lattice = 1.0, build(_unit(sdf, radius, 1.0), config.lattice, like)
    evaluations = lattice.evaluations
    for _ in range(ROUNDS):
        found, asked = _steepness(lattice, like)
        evaluations += asked
        if found <= config.lattice.steepest:
            break
        steepness *= found
        lattice = build(_unit(sdf, radius, steepness), config.lattice, like)
        evaluations += lattice.evaluations
    return replace(lattice, radius=radius, steepness=steepness), evaluations


def _steepness(lattice: Lattice, like: Tensor) -> tuple[float, int]:
    """Of the lattice's field, by its corners or else by new points; and how many these are."""
    found = lattice.measured_steepness()
    return typical_slope(lattice.field, like) if found is None else (found, 0)


def _unit(sdf: SDF, radius: float, steepness: float) -> SDF:
    return sdf if radius == 1 and steepness == 1 else _Unit(sdf, radius, steepness)


@dataclass(frozen=True)
class _Unit:
    """A field scaled into the unit sphere, and to a slope of 1."""

    sdf: SDF
    radius: float
    steepness: float

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        return self.sdf(points * self.radius) / (self.radius * self.steepness)

    def narrowed(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], SDF]:
        values, field = narrowed(self.sdf, points * self.radius)
        return values / (self.radius * self.steepness), _Unit(field, self.radius, self.steepness)


def _tiled(sdf: SDF, camera: Camera, config: FastConfig, lattice: Lattice, last: Trace | None) -> Trace:
    height, width = camera.height, camera.width
    if height <= TILE and width <= TILE:
        return _traced(sdf, camera, config, lattice, last)
    whole: Trace | None = None
    for top, left in product(range(0, height, TILE), range(0, width, TILE)):
        part = (..., slice(top, top + TILE), slice(left, left + TILE))
        tile = _traced(sdf, camera.cropped(top, left, TILE, TILE), config, lattice, last and last[part])
        whole = whole or tile.of(lambda image: image.new_empty(*image.shape[:-2], height, width))
        for name, image in tile.images().items():
            whole.images()[name][part] = image
    assert whole is not None
    return whole


def _traced(sdf: SDF, camera: Camera, config: FastConfig, lattice: Lattice, last: Trace | None) -> Trace:
    rays = camera.rays()
    bounds = meet_sphere(rays)
    if lattice.values.isnan().any():  # the field gives NaN somewhere: nothing can be foretold
        trace = sphere_trace(sdf, rays, bounds, config.march)
        return replace(trace, slope=torch.full_like(trace.distance, torch.nan))
    spacing = 2 * camera.tolerance(1.0).expand(rays.shape)
    picture = Picture(sdf, rays, bounds, spacing, lattice, config, last)
    passes.trace_coarsest(picture)
    for stride in config.strides[1:]:
        passes.trace_between(picture, stride)
    picture.march_left()
    outlines.follow(picture)
    picture.check_bends()
    picture.march_left()
    return picture.trace()
