"""Where a ray may first meet the surface, as far as a lattice and what is known beside the ray can tell: no queries."""

from dataclasses import dataclass, fields
from enum import IntEnum

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.fast.lattice import Lattice
from distrace.rays import Rays

LONGEST = 0.3  # of a step through empty space
FLOOR = 1e-5  # doubt that remains at a known point


class Kind(IntEnum):
    """What a ray meets first."""

    NOTHING = 0
    NEAR = 1  # the surface may be here, or not
    ROOT = 2  # the value changes sign


@dataclass(frozen=True)
class Forecast:
    """Of each ray; `distance` is that of the root, or of the least value where the surface is near."""

    kind: Int[Tensor, "n"]
    distance: Float[Tensor, "n"]
    begins: Float[Tensor, "n"]  # the distance at which the surface may be first
    stopped: Float[Tensor, "n"]  # where to go on from
    slope: Float[Tensor, "n"]  # of the field along the ray, at roots
    closest: Float[Tensor, "n"]  # the distance of the least value passed by

    def __getitem__(self, index: Tensor) -> "Forecast":
        return Forecast(*(getattr(self, part.name)[index] for part in fields(self)))

    def put(self, index: Tensor, other: "Forecast") -> None:
        """Takes some rays' forecasts from another."""
        for name in ("kind", "distance", "begins", "stopped", "slope"):
            getattr(self, name)[index] = getattr(other, name)


@dataclass(frozen=True)
class Known:
    """Samples beside each ray: where, by how much the lattice was off there, and what they weigh; NaN where none is."""

    points: Float[Tensor, "n k 3"]
    errors: Float[Tensor, "n k"]
    weights: Float[Tensor, "n k"]

    def __getitem__(self, index: Tensor) -> "Known":
        return Known(self.points[index], self.errors[index], self.weights[index])


def corrected(lattice: Lattice, points: Float[Tensor, "n 3"], known: Known | None) -> tuple[Tensor, Tensor]:
    """Value and slack, closer to the truth where samples are known within half a cell."""
    value, slack = lattice(points)
    close = (value < slack).nonzero()[:, 0]
    if known is None or not len(close):
        return value, slack
    beside = known[close]
    away = (points[close, None] - beside.points).norm(dim=-1) / lattice.cell
    usable = (away < 0.5) & ~beside.errors.isnan()
    weights = beside.weights.masked_fill(~usable, 0.0)
    errors = beside.errors.masked_fill(~usable, 0.0)
    error = (weights * errors).sum(1) / weights.sum(1).clamp_min(1e-9)
    spread = (errors - error[:, None]).abs().masked_fill(~usable, 0.0).amax(1)
    nearest = away.masked_fill(~usable, torch.inf).amin(1)
    doubt = (2 * slack[close] * nearest + spread + FLOOR).minimum(slack[close])
    value[close] += error
    slack[close] = torch.where(usable.any(1), doubt, slack[close])
    return value, slack


@torch.no_grad()
def forecast(
    lattice: Lattice, rays: Rays, begin: Tensor, far: Tensor, known: Known | None = None, *, pass_near: bool = False
) -> Forecast:
    """Steps along each ray from `begin` to where the surface may first be; past what is but near, with `pass_near`.

    Outside, a step is what the lattice leaves of f at least, over the steepness; in doubt it is short.
    """
    walk = _Walk(begin, far)
    active = (begin < far).nonzero()[:, 0]
    while len(active):
        at = walk.t[active]
        value, slack = corrected(lattice, rays[active].at(at), None if known is None else known[active])
        active = walk.step(active, value, slack, lattice, pass_near)
    return walk.result(lattice, rays, known)


class _Walk:
    def __init__(self, begin: Tensor, far: Tensor) -> None:
        nothing = torch.full_like(begin, torch.inf)
        self.t, self.far = begin.clone(), far
        self.kind = torch.full_like(begin, int(Kind.NOTHING), dtype=torch.int64)
        self.where, self.begins, self.least = nothing, nothing.clone(), nothing.clone()
        self.last_t, self.last_value = begin.clone(), torch.full_like(begin, torch.nan)
        self.closest, self.lowest = begin.clone(), nothing.clone()

    def step(self, at: Tensor, value: Tensor, slack: Tensor, lattice: Lattice, pass_near: bool) -> Tensor:
        """One step of the rays `at`; returns those still on their way."""
        t, begins, least, lower = self.t[at], self.begins[at], self.least[at], value - slack
        begins = torch.where(begins.isinf() & (lower <= 0), t, begins)
        doubt = torch.isfinite(begins)
        crossed = doubt & (value < 0)
        rises = doubt & ~crossed & ((lower > 0) | (value > least + slack / 2))
        better = doubt & (value < least)
        where = torch.where(better, t, self.where[at])
        lowest = value < self.lowest[at]
        self.lowest[at], self.closest[at] = value.minimum(self.lowest[at]), torch.where(lowest, t, self.closest[at])
        last, last_t = self.last_value[at], self.last_t[at]
        zero = torch.where(last > 0, t - value * (t - last_t) / (value - last), t)
        where = torch.where(crossed, zero, where)
        least = torch.where(better, value, least)
        if pass_near:
            clear = rises & (lower > 0)
            begins, doubt = begins.masked_fill(clear, torch.inf), doubt & ~clear
            least, where, rises = (
                least.masked_fill(rises, torch.inf),
                where.masked_fill(rises, torch.inf),
                clear & False,
            )
        short = lattice.cell / 8
        cautious = (lower / lattice.steepest).clamp(short, LONGEST)
        following = t + torch.where(doubt, (0.7 * value).clamp_min(short), cautious)
        out = following >= self.far[at]
        near = rises | (out & doubt & ~crossed & (not pass_near))
        kind = torch.where(crossed, int(Kind.ROOT), torch.where(near, int(Kind.NEAR), int(Kind.NOTHING)))
        self.kind[at], self.where[at], self.begins[at], self.least[at] = kind, where, begins, least
        self.last_t[at], self.last_value[at], self.t[at] = t, value, following
        return at[~(crossed | rises | out)]

    def result(self, lattice: Lattice, rays: Rays, known: Known | None) -> Forecast:
        """Roots are brought to where the corrected value is zero, by one step of Newton."""
        found = (self.kind == Kind.ROOT).nonzero()[:, 0]
        slope, here = torch.full_like(self.t, torch.nan), rays[found]
        points = here.at(self.where[found])
        slope[found] = lattice.slope(points, here.directions)
        value, _ = corrected(lattice, points, None if known is None else known[found])
        reach = lattice.cell / 4
        self.where[found] -= (value / slope[found].clamp_max(-0.05)).clamp(-reach, reach)
        return Forecast(self.kind, self.where, self.begins, self.t, slope, self.closest)
