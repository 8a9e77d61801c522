"""Roots of a field along rays, from guesses: Newton and secant steps within brackets, accepted by a bound."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.field import SDF
from distrace.rays import Rays

SECANT_DOUBT = 0.1  # relative, of a slope through two samples
STALE_DOUBT = 0.5  # of one that was not confirmed by a second sample
LEAST_SLOPE = 0.03  # rays nearer to tangential are stepped as if at this slope
GRAZING = 0.15  # at flatter slopes only a change of sign tells that there is a root
VAGUE = 0.3  # a slope in more doubt needs a second sample
BEND = 0.003  # a step of this length is off by itself, at a kink


@dataclass(frozen=True)
class Guess:
    """Where a root may be, the slope of f there (NaN: unknown), and how far off that may be, relatively.

    `low` and `high`, with their values, enclose the root where they are known.
    """

    distance: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]
    doubt: Float[Tensor, "n"]
    low: Float[Tensor, "n"] | None = None
    low_value: Float[Tensor, "n"] | None = None
    high: Float[Tensor, "n"] | None = None
    high_value: Float[Tensor, "n"] | None = None

    def __getitem__(self, index: Tensor) -> "Guess":
        """Some rays' guesses, without ends."""
        return Guess(self.distance[index], self.slope[index], self.doubt[index])

    def replaced(self, where: Bool[Tensor, "n"], other: "Guess") -> "Guess":
        """Another guess at some rays, where neither has ends."""
        return Guess(
            torch.where(where, other.distance, self.distance),
            torch.where(where, other.slope, self.slope),
            torch.where(where, other.doubt, self.doubt),
        )


@dataclass(frozen=True)
class Roots:
    """`distance` is NaN where none was found. The rest tells the last sample, and the last one outside."""

    distance: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]
    moved: Float[Tensor, "n"]  # from the last sample to the root
    sample: Float[Tensor, "n"]
    value: Float[Tensor, "n"]  # of f at the last sample
    outside: Float[Tensor, "n"]  # NaN where no sample was
    evaluations: Int[Tensor, "n"]


@torch.no_grad()
def settle(sdf: SDF, rays: Rays, guess: Guess, tolerance: float, reach: float, looks: int = 7) -> Roots:
    """Looks at each guess and steps to the zero of the line through it, until a step is known to end close enough.

    A step of length s by a slope in doubt by r ends within r · s + s² / BEND of the root. Between samples of different
    signs the next one stays between (Illinois: Dowell and Jarratt, BIT 1971). A ray that leaves its guess by `reach`,
    or needs more looks, is given up.
    """
    search = _Search(guess)
    active = torch.arange(len(guess.distance), device=guess.distance.device)
    for look in range(looks):
        if not len(active):
            break
        value = sdf(rays[active].at(search.t[active]))
        active = search.step(active, value, tolerance, reach, first=look == 0)
    return search.result()


class _Search:
    def __init__(self, guess: Guess) -> None:
        nothing = torch.full_like(guess.distance, torch.nan)
        self.begin, self.t = guess.distance, guess.distance.clone()
        self.slope, self.doubt = guess.slope.clone(), guess.doubt
        ends = (guess.low, guess.low_value, guess.high, guess.high_value)
        self.low, self.low_value, self.high, self.high_value = (
            nothing.clone() if end is None else end.clone() for end in ends
        )
        self.sample, self.value, self.root, self.moved = (nothing.clone() for _ in range(4))
        self.evaluations = torch.zeros_like(guess.distance, dtype=torch.int32)

    def step(self, at: Tensor, value: Tensor, tolerance: float, reach: float, *, first: bool) -> Tensor:
        """One look of the rays `at`; returns those that go on."""
        t = self.t[at]
        self.evaluations[at] += 1
        slope, doubt = self._slope(at, t, value, first)
        between, regula, width = self._bracket(at, t, value)
        tangent = (-value / slope.clamp_max(-LEAST_SLOPE)).clamp(-reach / 2, reach / 2)
        move = torch.where(slope.isnan(), 1.2 * value, tangent)
        leaves = between & ~((t + move > self.low[at]) & (t + move < self.high[at]))
        move = torch.where(leaves, regula - t, move)
        doubt = torch.where(leaves, STALE_DOUBT, doubt)
        bound = (doubt * move.abs() + move**2 / BEND).minimum(width)
        vague = ((slope > -GRAZING) | (doubt >= VAGUE)) & ~between
        done = (bound < tolerance) & ~vague
        move = torch.where(vague & (bound < tolerance), move + tolerance, move)
        self.sample[at], self.value[at], self.slope[at], self.t[at] = t, value, slope, t + move
        self.root[at[done]], self.moved[at[done]] = (t + move)[done], move[done].abs()
        return at[~done & ((t + move - self.begin[at]).abs() < reach)]  # also false for NaN

    def _slope(self, at: Tensor, t: Tensor, value: Tensor, first: bool) -> tuple[Tensor, Tensor]:
        """By the last two samples where that is plausible."""
        slope = self.slope[at]
        slope = slope.masked_fill(slope > 0, torch.nan)  # no root that is entered through
        secant = (value - self.value[at]) / (t - self.sample[at])
        plausible = slope.isnan() | ((secant > 4 * slope) & (secant < slope / 4))
        use = (secant < -LEAST_SLOPE) & plausible
        stale = self.doubt[at] if first else torch.full_like(t, STALE_DOUBT)
        slope = torch.where(use, secant, slope)
        return slope, torch.where(use, SECANT_DOUBT, stale).masked_fill(slope.isnan(), torch.inf)

    def _bracket(self, at: Tensor, t: Tensor, value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Whether the sample and one before it enclose a root; the zero between them; and how far they are apart."""
        outside = value > 0
        again = outside == (self.value[at] > 0)
        self.low[at] = torch.where(outside, t, self.low[at])
        self.high[at] = torch.where(outside, self.high[at], t)
        low_value = torch.where(outside, value, torch.where(again, self.low_value[at] / 2, self.low_value[at]))
        high_value = torch.where(outside, torch.where(again, self.high_value[at] / 2, self.high_value[at]), value)
        self.low_value[at], self.high_value[at] = low_value, high_value
        width = self.high[at] - self.low[at]
        between = width > 0
        zero = self.low[at] + low_value * width / (low_value - high_value)
        return between, zero, torch.where(between, width, torch.inf)

    def result(self) -> Roots:
        return Roots(self.root, self.slope, self.moved, self.sample, self.value, self.low, self.evaluations)
