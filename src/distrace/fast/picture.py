"""What the fast tracer knows of each pixel, and its ways to find out more; all flat, in a sphere of radius 1."""

from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.fast.lattice import Lattice, LatticeConfig
from distrace.fast.neighbours import Grid
from distrace.fast.roots import Guess, settle
from distrace.field import SDF
from distrace.rays import Bounds, Rays
from distrace.trace import Outcome, Trace, TraceConfig, sphere_trace

NEARBY = 0.01  # how far a hit is held against samples behind it, and how far before an odd one a march starts
SECOND_DOUBT = 0.29  # relative, of a slope that was used before
BENT = 3e-4  # distances that are off from both neighbours by more, and were reached from afar, are looked at again


def _approach() -> TraceConfig:
    return TraceConfig(coarse_levels=0, tolerance=1e-3, least_step=2e-4, polish=False)


def _march() -> TraceConfig:
    return TraceConfig(coarse_levels=0, tolerance=2e-6, least_step=6e-4)


@dataclass(frozen=True)
class FastConfig:
    """How closely hits are to be known, and what is asked first. Lengths are relative to the radius of the sphere."""

    tolerance: float = 2.5e-4  # a hit is taken once its distance is bound to be this close
    lattice: LatticeConfig = field(default_factory=LatticeConfig)
    strides: tuple[int, ...] = (8, 4, 2, 1)  # of the pixels that are traced first, and then in between
    searched: int = (
        4  # strides from here on also look where the surface is but near: for what the lattice smoothed away
    )
    approach: TraceConfig = field(default_factory=_approach)  # of the pixels traced first, until roots can be settled
    march: TraceConfig = field(default_factory=_march)  # of what does not settle


class Picture:
    """Rays on a grid of pixels, and the state of each. Distances are infinite where nothing was hit so far."""

    def __init__(
        self,
        sdf: SDF,
        rays: Rays,
        bounds: Bounds,
        spacing: Tensor,
        lattice: Lattice,
        config: FastConfig,
        last: Trace | None,
    ) -> None:
        self.sdf = lattice.near if sdf == lattice.field else sdf
        self.lattice, self.config, self.grid = lattice, config, Grid(rays.shape)
        self.rays, self.near, self.far = rays.flat(), bounds.near.reshape(-1), bounds.far.reshape(-1)
        within = lattice.within(self.rays, Bounds(self.near, self.far))
        self.begin, self.end = within.near, within.far
        self.meets, self.spacing = self.begin < self.end, spacing.reshape(-1)  # of pixels, at distance 1
        unknown, nowhere = torch.full_like(self.near, torch.nan), torch.full_like(self.near, torch.inf)
        self.distance, self.slope = nowhere.clone(), unknown.clone()
        self.moved = torch.zeros_like(nowhere)  # from the last sample to the hit
        self.odd = torch.zeros_like(self.meets)  # hits that other samples contradict
        self.points, self.error = torch.zeros_like(self.rays.directions), unknown.clone()  # of the lattice, at samples
        self.least, self.least_at = nowhere.clone(), nowhere.clone()  # values that were looked for, and where
        self.start = unknown.clone()  # where to march from, for rays that wait for that
        self.closest = -(self.rays.origins * self.rays.directions).sum(-1)  # until more is known: beside the centre
        self.outcome = torch.full_like(nowhere, int(Outcome.ESCAPED), dtype=torch.int8)
        self.evaluations = torch.zeros_like(self.outcome, dtype=torch.int32)
        self.last_distance, self.last_slope = unknown, unknown
        if last is not None and last.slope is not None and last.distance.shape == rays.shape:
            self.last_distance, self.last_slope = last.distance.reshape(-1), last.slope.reshape(-1)

    @property
    def hit(self) -> Tensor:
        return torch.isfinite(self.distance)

    def look(self, pixels: Int[Tensor, "n"], t: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """The field's values. Where they do not fall behind a hit as its slope has it, the hit is odd."""
        self.evaluations[pixels] += 1
        value, behind = self.sdf(self.rays[pixels].at(t)), t - self.distance[pixels]
        close = (behind > self.config.tolerance) & (behind < NEARBY)
        self.odd[pixels[close & (value > self.slope[pixels] * behind / 2)]] = True
        return value

    def settle(self, pixels: Int[Tensor, "n"], guess: Guess, tolerance: float | None = None) -> Float[Tensor, "n"]:
        """Looks for roots from guesses; returns the last distance known to be outside, NaN where there is none."""
        rays = self.rays[pixels]
        roots = settle(self.sdf, rays, guess, tolerance or self.config.tolerance, self.lattice.cell)
        points = rays.at(roots.sample)
        self.evaluations[pixels] += roots.evaluations
        self.points[pixels], self.error[pixels] = points, roots.value - self.lattice(points)[0]
        found = ~roots.distance.isnan()
        at = pixels[found]
        self.distance[at], self.slope[at], self.moved[at] = (
            part[found] for part in (roots.distance, roots.slope, roots.moved)
        )
        return roots.outside

    def approach(self, pixels: Int[Tensor, "n"], begins: Float[Tensor, "n"]) -> None:
        """Sphere tracing from where the surface may be first, so that nothing thin is passed; then by secants."""
        trace = self._traced(pixels, begins.maximum(self.near[pixels]), self.config.approach)
        self.closest[pixels] = trace.closest
        pixels, distance = pixels[trace.hit], trace.distance[trace.hit]
        unknown = torch.full_like(distance, torch.nan)
        self.start[pixels] = torch.fmax(self.settle(pixels, Guess(distance, unknown, unknown)), distance)

    def march_left(self) -> None:
        """Sphere tracing of the rays that wait for it: what did not settle."""
        pixels = (~self.hit & ~self.start.isnan()).nonzero()[:, 0]
        start, self.start[pixels] = self.start[pixels], torch.nan
        rounding = 4 * torch.finfo(start.dtype).eps * self.far[pixels]
        config = replace(self.config.march, tolerance=rounding.clamp_min(self.config.march.tolerance))
        self.distance[pixels] = self._traced(pixels, start, config).distance

    def _traced(self, pixels: Tensor, start: Tensor, config: TraceConfig) -> Trace:
        bounds = Bounds(self.near[pixels], self.far[pixels])
        trace = sphere_trace(self.sdf, self.rays[pixels], bounds, config, start)
        self.outcome[pixels] = trace.outcome.to(torch.int8)
        self.evaluations[pixels] += trace.evaluations.to(torch.int32)
        return trace

    def check_bends(self) -> None:
        """Looks again at hits that lie off the surface of their neighbours."""
        pixels = self.hit.nonzero()[:, 0]
        bend = self.grid.bend(pixels, self.distance)
        self.check(pixels[(self.moved[pixels] > self.config.tolerance / 2) & (bend > BENT)])

    def check(self, pixels: Int[Tensor, "n"]) -> None:
        """Looks once more at what was taken for hits, more closely."""
        distance, slope = self.distance[pixels], self.slope[pixels].masked_fill(self.odd[pixels], torch.nan)
        self.distance[pixels], self.odd[pixels], self.start[pixels] = torch.inf, False, distance - 2 * NEARBY
        self.settle(pixels, Guess(distance, slope, torch.full_like(distance, SECOND_DOUBT)), self.config.tolerance / 4)

    def trace(self) -> Trace:
        """All that is known, as images."""
        outcome = self.outcome.masked_fill(self.hit, int(Outcome.HIT))
        closest = torch.where(self.hit, self.distance, self.closest.clamp(self.near, self.far))
        closest = closest.masked_fill(self.near >= self.far, torch.inf)
        slope = self.slope.masked_fill(~self.hit, torch.nan)
        return Trace(self.distance, outcome, closest, closest, self.evaluations, slope=slope).reshaped(self.grid.shape)
