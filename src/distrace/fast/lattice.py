"""A sparse lattice of a field: what the field is between its corners, and how far off that may be."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional as F

from distrace.field import SDF, asked, narrowed
from distrace.rays import Bounds, Rays, meet_box
from distrace.steepness import steep

SAMPLES = 32  # along a ray: about a smallest cell apart
TELLING = 30  # differences, at least, that say how steep a field is
FAR = 4.0  # no zero in the unit sphere is farther from a corner: what the field says beyond, infinity too, is the same
INNER = 0.25  # of a cell's width: cells deeper inside than this are not halved, for rays meet the surface before them


@dataclass(frozen=True)
class LatticeConfig:
    """`cells` along the diameter at first; those that can hold the surface are halved, up to `levels` sizes of cell."""

    cells: int = 7
    levels: int = 3
    steepest: float = (
        1.2  # a bound on |∇f|: no zero is nearer to a corner than |f| / steepest; steeper fields are scaled
    )

    def __post_init__(self) -> None:
        if self.cells < 2 or self.levels < 1 or not self.steepest > 0:
            raise ValueError(f"{self} is no lattice: it needs at least 2 cells, 1 level and a positive steepness")


@dataclass(frozen=True)
class Lattice:
    """The field at corners x, y, z of a cube around the unit sphere, and how far it may be off between them."""

    values: Float[Tensor, "n n n"]
    slack: Float[Tensor, "n n n"]
    steepest: float
    field: SDF  # that was evaluated …
    near: SDF  # … and the same, cheaper, near its surface
    evaluations: int = 0
    radius: float = 1.0  # by which lengths were divided, to fit the unit sphere …
    steepness: float = 1.0  # … and values, where the field was steeper than the configuration's bound

    @property
    def cell(self) -> float:
        """The width of the smallest cells."""
        return 2 / (len(self.values) - 1)

    def box(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]] | None:
        """The corners of a box outside of which there is no surface; None where there is none at all."""
        possible = (self.values < self.slack).nonzero()
        if not len(possible):
            return None
        low, high = (possible.amin(0) - 1).to(self.values), (possible.amax(0) + 1).to(self.values)
        return low * self.cell - 1, high * self.cell - 1

    def within(self, rays: Rays, bounds: Bounds) -> Bounds:
        """The stretch of each ray outside of which there is no surface."""
        box = self.box()
        inside = Bounds(bounds.far, bounds.near) if box is None else meet_box(rays, *box)
        return Bounds(inside.near.maximum(bounds.near), inside.far.minimum(bounds.far))

    @torch.no_grad()
    def __call__(self, points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
        """Value and slack at points, trilinearly."""
        both = torch.stack([self.values, self.slack])[None]
        found = F.grid_sample(both, points.flip(-1)[None, None, None], padding_mode="border", align_corners=True)
        return found[0, 0, 0, 0], found[0, 1, 0, 0]

    @torch.no_grad()
    def lowest(self, rays: Rays, bounds: Bounds, but: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Where along rays of the world the value is least, to a cell, farther than two cells from some distances."""
        apart, at, least = (bounds.far - bounds.near) / SAMPLES, but, torch.full_like(but, torch.inf)
        for k in range(SAMPLES):
            t = bounds.near + (k + 0.5) * apart
            value = self(rays.at(t) / self.radius)[0]
            value = value.masked_fill((t - but).abs() < 2 * self.cell * self.radius, torch.inf)
            at, least = torch.where(value < least, t, at), value.minimum(least)
        return at

    def measured_steepness(self) -> float | None:
        """What 99 of 100 differences along the axes stay below, per length, within two cells of the surface; None where
        there are too few of them to tell."""
        near = self.values.abs() < 2 * self.cell
        slopes = []
        for axis in range(3):
            (first, second), apart = (near.narrow(axis, k, len(near) - 1) for k in (0, 1)), self.values.diff(dim=axis)
            slopes.append(apart[first & second].abs() / self.cell)
        found = torch.cat(slopes)
        return steep(found) if len(found) >= TELLING else None

    @torch.no_grad()
    def slope(self, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """The derivative of the value along directions, over a tenth of a cell."""
        step = directions * self.cell / 20
        return (self(points + step)[0] - self(points - step)[0]) / (self.cell / 10)


@torch.no_grad()
def build(sdf: SDF, config: LatticeConfig = LatticeConfig(), like: Tensor = torch.empty(0)) -> Lattice:
    """Evaluates a field where its surface can be in the unit sphere, on the device and in the precision of `like`.

    At first |f| / steepest at its corners tells whether a cell can hold the surface; after a halving the slack is half
    the worst error that the coarser lattice had at the new corners around, as a kink's is (a smooth field's: 1/4).
    """
    count = config.cells
    points = _corners(count, like)
    wanted = points.norm(dim=-1) <= 1 + 1 / count
    known = asked(sdf, points[wanted]).clamp(-FAR, FAR)
    values = _spread(torch.full_like(points[..., 0], torch.nan).masked_scatter(wanted, known))
    slack = torch.full_like(values, config.steepest * 3**0.5 / count)
    evaluations = int(wanted.sum())
    near = sdf
    for level in range(1, config.levels):
        count *= 2
        points = _corners(count, like)
        wanted = _halved(values, slack, 2 / count) & (points.norm(dim=-1) <= 1 + 2 / count)
        values, slack = _finer(values), _finer(slack)
        fresh, near = narrowed(sdf, points[wanted]) if level == config.levels - 1 else (sdf(points[wanted]), sdf)
        fresh = fresh.clamp(-FAR, FAR)
        surplus = torch.zeros_like(values).masked_scatter(wanted, (fresh - values[wanted]).abs())
        around = _pooled(surplus, 5) / 2
        slack = torch.where(_pooled(wanted.to(values), 3) > 0, around, slack)
        values = values.masked_scatter(wanted, fresh)
        evaluations += len(fresh)
    return Lattice(values, slack, config.steepest, sdf, near, evaluations)


def _corners(count: int, like: Tensor) -> Float[Tensor, "n n n 3"]:
    along = torch.linspace(-1, 1, count + 1, dtype=like.dtype, device=like.device)
    return torch.stack(torch.meshgrid(along, along, along, indexing="ij"), dim=-1)


def _halved(values: Tensor, slack: Tensor, width: float) -> Bool[Tensor, "n n n"]:
    """The new corners of the cells that can hold the surface."""
    lowest = -F.max_pool3d((slack - values)[None, None], 2, 1)[0, 0]
    highest = F.max_pool3d(values[None, None], 2, 1)[0, 0]
    cells = ((lowest < 0) & (highest > -INNER * width)).to(values)
    corners = F.conv_transpose3d(cells[None, None], torch.ones(1, 1, 3, 3, 3).to(values), stride=2)[0, 0] > 0
    corners[::2, ::2, ::2] = False
    return corners


def _finer(image: Tensor) -> Tensor:
    size = [2 * n - 1 for n in image.shape]
    return F.interpolate(image[None, None], size=size, mode="trilinear", align_corners=True)[0, 0]


def _pooled(image: Tensor, width: int) -> Tensor:
    return F.max_pool3d(image[None, None], width, 1, width // 2)[0, 0]


def _spread(values: Tensor) -> Tensor:
    """Corners far outside of the sphere take the greatest value beside them."""
    while values.isnan().any():
        beside = _pooled(values.nan_to_num(-torch.inf), 3)
        if not torch.isfinite(beside).any():
            return torch.zeros_like(values)  # a field of nothing but NaN: the surface may be anywhere
        values = torch.where(values.isnan() & torch.isfinite(beside), beside, values)
    return values
