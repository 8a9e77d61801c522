"""From coarse to fine: where a pixel's ray meets the surface, foretold by a lattice and by the pixels around it."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from distrace.fast.forecast import Forecast, Kind, Known, forecast
from distrace.fast.outlines import examine
from distrace.fast.picture import Picture
from distrace.fast.roots import Guess

LATTICE_DOUBT = 0.3  # relative, of the lattice's slope
PARENTS_DOUBT = 0.03  # of one between neighbours that agree, or of the last trace
STEEP = 0.03  # flatter slopes are not handed on
APART = 2.0  # × the sides of a pixel: neighbours on one surface differ by no more than that, over the slope
SEARCHES = 3  # places on a ray that are looked at because the surface is but near


def trace_coarsest(picture: Picture) -> None:
    """Approaches the surface on every ray of the first stride, so that nothing that is thin both ways of it is passed.

    Where a last trace hit, its distance is tried before.
    """
    pixels = picture.grid.between(picture.config.strides[0], True, picture.near.device)
    pixels = pixels[picture.meets[pixels]]
    last, slope = picture.last_distance[pixels], picture.last_slope[pixels]
    again = last.isfinite() & (slope < -STEEP)
    doubt = torch.full_like(last, PARENTS_DOUBT)
    picture.settle(pixels[again], Guess(last, slope, doubt)[again])
    pixels = pixels[~picture.hit[pixels]]
    ahead = forecast(picture.lattice, picture.rays[pixels], picture.begin[pixels], picture.end[pixels])
    picture.closest[pixels] = ahead.closest
    met = torch.isfinite(ahead.begins)
    picture.approach(pixels[met], ahead.begins[met])


def trace_between(picture: Picture, stride: int) -> None:
    """Traces the pixels that a stride adds.

    Close to each other, parents that agree are enough; elsewhere the lattice decides which of them to believe. Where it
    is alone, or was wrong, the ray approaches the surface step by step.
    """
    pixels = picture.grid.between(stride, False, picture.near.device)
    family = _Family(picture, pixels[picture.meets[pixels]], stride)
    agree = torch.zeros_like(picture.meets)
    if stride < picture.config.searched:
        between, explained = family.between()
        picture.settle(family.pixels[explained], between[explained])
        agree[family.pixels[explained]] = True
        family = _Family(picture, family.pixels[~picture.hit[family.pixels]], stride)
    pixels, ahead = family.pixels, _foretell(family, search=stride >= picture.config.searched)
    within = ahead.begins <= picture.near[pixels]  # the solid may reach to where the ray starts
    picture.start[pixels[within]] = picture.near[pixels[within]]
    guess = family.guess(ahead)
    root = (ahead.kind == Kind.ROOT) & ~within
    alone = (guess.doubt == LATTICE_DOUBT) | agree[pixels]
    picture.approach(pixels[root & alone], ahead.begins[root & alone])
    at = root & ~alone
    outside = picture.settle(pixels[at], guess[at])
    picture.start[pixels[at]] = torch.fmax(outside, ahead.begins[at])


def _foretell(family: "_Family", *, search: bool) -> Forecast:
    """The first root on each ray; with `search`, places where the surface is but near are looked at before."""
    picture, pixels, known = family.picture, family.pixels, family.known()
    lattice, rays, far = picture.lattice, picture.rays[pixels], picture.end[pixels]
    ahead = forecast(lattice, rays, picture.begin[pixels], far, known, pass_near=not search)
    picture.closest[pixels] = ahead.closest
    for again in range(SEARCHES):
        doubtful = ((ahead.kind == Kind.NEAR) & (ahead.begins > picture.near[pixels])).nonzero()[:, 0]
        if not len(doubtful):
            break
        examine(picture, pixels[doubtful], ahead.distance[doubtful])
        ahead.kind[doubtful] = int(Kind.NOTHING)
        on = doubtful[~picture.hit[pixels[doubtful]]]
        begin, last = ahead.stopped[on], again == SEARCHES - 1
        ahead.put(on, forecast(lattice, rays[on], begin, far[on], known[on], pass_near=last))
    return ahead


class _Family:
    """Pixels, their parents on the coarser grid, and the pixels behind those."""

    def __init__(self, picture: Picture, pixels: Int[Tensor, "n"], stride: int) -> None:
        self.picture, self.pixels = picture, pixels
        self.parents, weights = picture.grid.parents(pixels, stride)
        self.weights = weights.to(picture.near)
        self.used = self.weights > 0
        self.behind = picture.grid.behind(pixels, self.parents)
        self.side = APART * stride * picture.spacing[pixels]

    def known(self) -> Known:
        """What the lattice was off by at the parents' samples."""
        errors = self.picture.error[self.parents].masked_fill(~self.used, torch.nan)
        return Known(self.picture.points[self.parents], errors, self.weights)

    def between(self) -> tuple[Guess, Bool[Tensor, "n"]]:
        """What parents that all hit tell (NaN without), and whether their slopes explain how far they are apart.

        The distance is a cubic through parents and what is behind them, where that is of the same surface. With a last
        trace parents tell by how much the distance has changed since.
        """
        picture, there, slopes = self.picture, self.picture.distance[self.parents], self.picture.slope[self.parents]
        further = picture.distance[self.behind]
        distance, apart = self._mean(there)
        slope, _ = self._mean(slopes)
        within = self.side * distance / slope.abs()
        smooth = ((self.behind >= 0) & ((further - there).abs() < 2 * within[:, None])) | ~self.used
        cubic, _ = self._mean(there + (there - further) / 8)
        distance = torch.where(smooth.all(1), cubic, distance)
        turn = (slopes - picture.slope[self.behind]).nan_to_num(0.0) * smooth
        _, spread = self._mean(slopes + turn / 2)
        doubt = spread / (slope.abs() - spread).clamp_min(STEEP)
        before, last_slope = picture.last_distance[self.pixels], picture.last_slope[self.pixels]
        beside = picture.last_distance[self.parents]
        change, _ = self._mean(there - beside)
        lasting = before.isfinite() & last_slope.isfinite() & (beside.isfinite() | ~self.used).all(1)
        distance = torch.where(lasting, before + change, distance)
        slope, doubt = torch.where(lasting, last_slope, slope), torch.where(lasting, 0.0, doubt)
        known = slope < -STEEP
        return Guess(distance.masked_fill(~known, torch.nan), slope, PARENTS_DOUBT + doubt), known & (apart < within)

    def beyond(self, distance: Float[Tensor, "n"]) -> Guess:
        """The line through a parent and the pixel behind it, of the parent that so comes nearest to a distance."""
        near, far = (self.picture.distance[at] for at in (self.parents, self.behind))
        slope, last = (self.picture.slope[at] for at in (self.parents, self.behind))
        apart = self.side[:, None] * near / slope.abs()
        valid = self.used & (self.behind >= 0) & ((near - far).abs() < apart) & (slope.maximum(last) < -STEEP)
        continued = (1.5 * near - 0.5 * far).masked_fill(~valid, torch.inf)
        _, best = (continued - distance[:, None]).abs().min(1, keepdim=True)
        doubt = PARENTS_DOUBT + ((slope - last) / slope).abs()
        return Guess(*(part.gather(1, best)[:, 0] for part in (continued, slope, doubt)))

    def guess(self, ahead: Forecast) -> Guess:
        """What parents tell where it is near the lattice's root, else what one of them tells, else the root itself."""
        half = self.picture.lattice.cell / 2
        guess = Guess(ahead.distance, ahead.slope, torch.full_like(ahead.slope, LATTICE_DOUBT))
        beyond, (between, explained) = self.beyond(ahead.distance), self.between()
        guess = guess.replaced((beyond.distance - ahead.distance).abs() < half, beyond)
        fits = (between.distance < ahead.distance + half) & (between.distance > ahead.begins - half)
        near = explained | (between.distance > ahead.distance - half)
        return guess.replaced(fits & near, between)  # all false for NaN

    def _mean(self, values: Float[Tensor, "n 4"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Over the parents; and how far the farthest is off."""
        mean = (self.weights * values.masked_fill(~self.used, 0.0)).sum(1)
        return mean, (values - mean[:, None]).abs().masked_fill(~self.used, 0.0).amax(1)
