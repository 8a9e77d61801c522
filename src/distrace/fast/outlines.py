"""Places where rays may or may not meet the surface: outlines, and what a lattice leaves open."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.fast.picture import BENT, Picture
from distrace.fast.roots import Guess

ENTRY_DOUBT = 0.5  # relative, of a slope on a parabola through two samples
EDGE = 0.01  # the radius of an edge that a ray passes within a pixel's width: how far apart looks along it are
AHEAD = 3  # looks ahead, at most
FALLING = 0.05  # along a ray: where f falls more slowly, the surface is not ahead
CLEAR = 0.3  # of a pixel's width: values that stay above it while a ray passes an outline show that it misses
SHARP = 1.0
ROUNDS = 6  # in which the least value is enclosed ever more closely
CLOSE = 5e-4  # a least value below this, by a parabola through three samples, is worth a look
NEARLY = 2.5e-4  # what is enclosed and less than this is enclosed more closely
CHAIN = 20  # pixels by which an outline may grow into what was not seen before
DIAGONAL = 1.4  # pixels, to a neighbour
UNKNOWN_SLOPE, LEAST_SLOPE = 0.3, 0.05  # for how far neighbours' distances may differ


def follow(picture: Picture) -> None:
    """Looks at rays beside others that hit nearer than the surface's slope explains, or that nearly hit."""
    tried = [picture.least_at]
    pixels = picture.meets.nonzero()[:, 0]
    for _ in range(CHAIN):
        pixels, seed = _nearer_beside(picture, pixels, tried)
        if not len(pixels):
            break
        tried.append(torch.full_like(picture.distance, torch.inf).index_put((pixels,), seed))
        before = picture.distance[pixels]
        _Examined(picture, pixels, seed).pass_by().enclose().enter()
        changed = picture.distance[pixels] != before
        pixels = torch.cat([picture.grid.around(pixels[changed]), pixels[~changed]]).unique()


def examine(picture: Picture, pixels: Int[Tensor, "n"], seed: Float[Tensor, "n"]) -> None:
    """Looks for the solid near some distance, by the least value of f there; where it is found, for its surface."""
    examined = _Examined(picture, pixels, seed).enclose()
    picture.least[pixels], picture.least_at[pixels] = examined.value, examined.t
    examined.enter()


def _nearer_beside(picture: Picture, pixels: Tensor, tried: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Which of some pixels to look at, and the distance: of the neighbour that hits, or nearly hits, the nearest.

    None that waits for the march, and not where was looked before.
    """
    beside, hit = picture.grid.beside, picture.hit
    at, least = torch.where(hit, picture.distance, picture.least_at), picture.least.masked_fill(hit, 0.0)
    pixels = pixels[picture.meets[pixels] & (hit | picture.start.isnan())[pixels]]
    there, apart = beside(pixels, at, torch.inf), DIAGONAL * picture.spacing[pixels]
    nearest = there.amin(0)
    some = nearest < picture.distance[pixels] - apart * nearest - BENT
    pixels, there, reach = pixels[some], there[:, some], apart[some] * there[:, some]
    beyond = beside(pixels, picture.distance, torch.inf, reach=2)
    slopes = beside(pixels, picture.slope, torch.nan).abs().fmin(picture.slope[pixels].abs())
    explained = reach / slopes.nan_to_num(UNKNOWN_SLOPE).clamp_min(LEAST_SLOPE) + BENT
    look = (beside(pixels, least, torch.inf) < reach) & (there < picture.distance[pixels] - explained)
    continued = torch.where((beyond - there).abs() < explained, 2 * there - beyond, there)
    near = 2 * _step(picture, pixels, nearest[some])
    for seed in tried:
        look &= ~((continued - seed[pixels]).abs() < near)
    first, which = there.masked_fill(~look, torch.inf).min(0)
    some = torch.isfinite(first)
    return pixels[some], continued.gather(0, which[None])[0, some]


def _step(picture: Picture, pixels: Tensor, t: Tensor) -> Tensor:
    return (2 * EDGE * picture.spacing[pixels] * t.nan_to_num(posinf=0.0)).sqrt()


class _Examined:
    """Rays and the least value found on each; `open` are those of which nothing is known for sure yet."""

    def __init__(self, picture: Picture, pixels: Tensor, seed: Tensor) -> None:
        self.picture, self.pixels, self.t = picture, pixels, seed.clone()
        self.value = picture.look(pixels, seed)
        self.before, self.outer, self.ahead = (torch.full_like(seed, torch.nan) for _ in range(3))
        self.step = _step(picture, pixels, seed)
        self.width = self.step.clone()
        self.open = (self.value > 0).nonzero()[:, 0]

    def pass_by(self) -> "_Examined":
        """Looks ahead while f falls towards zero; closes those that entered the solid, or clearly miss it."""
        at, width = self.open, self.step.clamp_max(EDGE)
        slope = torch.zeros_like(width)
        for _ in range(AHEAD):
            if not len(at):
                break
            ahead = self.picture.look(self.pixels[at], self.t[at] + width[at])
            fall = (self.value[at] - ahead) / width[at]
            slope[at] = fall.abs()
            zero = ahead / fall.clamp_min(1e-9)  # how much further on
            on = (ahead <= 0) | ((fall > FALLING) & (zero < 6 * self.step[at]))
            self.ahead[at] = ahead.masked_fill(on, torch.nan)
            at, ahead = at[on], ahead[on]
            self.before[at], self.outer[at] = self.t[at], self.value[at]
            self.t[at], self.value[at] = self.t[at] + width[at], ahead
            width[at] = zero[on].clamp(self.step[at], 4 * self.step[at])
            at = at[ahead > 0]
        least = (self.ahead - (self.value - self.ahead).clamp_min(0) / 2).fmin(self.value)
        clear = (least > CLEAR * self.picture.spacing[self.pixels] * self.t) & (least > SHARP * slope * self.step)
        self.open = ((self.value > 0) & ~clear).nonzero()[:, 0]
        return self

    def enclose(self) -> "_Examined":
        """Moves to the least value nearby, until that is negative, or no longer of interest."""
        for _ in range(ROUNDS):
            if not len(self.open):
                break
            at = self.open
            self.before[at] = self.t[at] - self.width[at]
            enclosed, bound = self._downhill(at)
            self.width[at] /= torch.where(enclosed, 4, 1)
            self.ahead[at] = torch.nan
            near = self.value[at] < torch.where(enclosed, NEARLY, 2 * self.step[at])
            self.open = at[(self.value[at] > 0) & (near | (bound < 0))]
        return self

    def _downhill(self, at: Tensor) -> tuple[Tensor, Tensor]:
        """Moves to the least of samples to both sides and, if worth it, of their parabola's vertex.

        Whether that is enclosed, and how low f may be between the samples at a kink, by the steeper of their slopes.
        """
        pixels, t, value, width = self.pixels[at], self.t[at], self.value[at], self.width[at]
        left, right = self.picture.look(pixels, t - width), self.ahead[at]
        unknown = right.isnan()
        right = right.masked_scatter(unknown, self.picture.look(pixels[unknown], (t + width)[unknown]))
        bend = (left - 2 * value + right).clamp_min(1e-9)
        offset = 0.5 * width * (left - right) / bend
        vertex = t + offset.clamp(-2 * width, 2 * width)
        worth = (value - (left - right) ** 2 / (8 * bend) < CLOSE) | (offset.abs() > width)
        lowest = torch.full_like(value, torch.inf)
        lowest[worth] = self.picture.look(pixels[worth], vertex[worth])
        self.outer[at] = left
        self.value[at], best = torch.stack([value, left, right, lowest]).min(0)
        self.t[at] = torch.stack([t, t - width, t + width, vertex]).gather(0, best[None])[0]
        steepest = (torch.maximum(left, right) - value).clamp_min(0)  # times the width
        return (best == 0) | ((best == 3) & (offset.abs() <= width)), (left + right) / 2 - steepest

    def enter(self) -> None:
        """Settles the surface between samples in the solid and those before them."""
        picture = self.picture
        picture.check(self.pixels[picture.odd[self.pixels]])
        solid = (self.value <= 0) & (self.t < picture.distance[self.pixels])
        pixels, t, value, before, outer, step = (
            part[solid] for part in (self.pixels, self.t, self.value, self.before, self.outer, self.step)
        )
        unknown = ~(outer > 0)
        before = torch.where(unknown, t - step, before)
        outer = outer.masked_scatter(unknown, picture.look(pixels[unknown], before[unknown]))
        width, fall = t - before, outer - value
        root = t - width * (-value / fall).clamp(0, 1).sqrt()  # on a parabola whose vertex is the sample inside
        slope = -2 * (-value * fall).clamp_min(0).sqrt() / width
        picture.distance[pixels], picture.start[pixels] = torch.inf, before - step
        at = (outer > 0).nonzero()[:, 0]
        doubt = torch.full_like(root, ENTRY_DOUBT)
        picture.settle(pixels[at], Guess(*(part[at] for part in (root, slope, doubt, before, outer, t, value))))
