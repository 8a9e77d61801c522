"""Where a surface can be: centres of cells on two levels exclude balls, by a Lipschitz constant of f."""

import itertools
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.equality import ByValue
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.rays import Bounds, Rays
from distrace.tracing.evaluator import Evaluator
from distrace.tracing.images import Lines

CELLS = 16  # along the diameter of the unit sphere; those that may hold surface are split once
CORNERS = tuple(itertools.product((-1, 1), repeat=3))  # of a cell, and where the parts of a block of cells are
HALF_DIAGONAL = 3**0.5 / 2  # of a cell of width 1
MARGIN = 1.1  # × the steepest slope that was measured: what is steeper lies between the samples
SAMPLES = 4 * CELLS  # of the cells along a ray through the sphere: half a cell apart
PROBES = 256  # cells nearest to the surface in which the gradient is measured
STEEP = 0.97  # share of these gradients that the bound covers: ReLU networks have a few steep facets
FLAT = 0.01  # of the steepest gradient, and of the least value a radius: what is flatter is saturated
BAND = 0.018  # radii: a field that is flat wherever it was measured may rise to that within so much of its surface


@dataclass(frozen=True, eq=False, repr=False)
class Occupancy(ByValue):
    """The cells around the unit sphere that may hold surface, and their neighbours, for each shape of a batch."""

    occupied: Bool[Tensor, "shapes n n n"]
    lipschitz: Float[Tensor, "shapes"]  # the bound on |∇f|: no less than that by which the others were excluded
    values: Float[Tensor, "shapes m m m"]  # of f at the centres of the coarser cells, in radii
    radius: float
    cheap: SDF | BatchField | None = None  # the field by rougher products, where those are faster on this machine

    def entered(self, lines: Lines) -> Float[Tensor, "3 n"]:
        """From the first to the last cell on the way of each ray that may hold surface, and from the first again.

        From inf to −inf if none does.
        Cells are found by samples along the ray.
        """
        cells = self.occupied.shape[-1]
        near, far = lines.in_sphere(1 + 2 / cells)  # of a block, other rays than the middle one may be in the sphere
        apart = (far - near).clamp_min(0) / SAMPLES
        order = torch.arange(SAMPLES, dtype=near.dtype, device=near.device)[:, None]
        cell = ((lines.at(torch.addcmul(near, order + 0.5, apart)) + 1) * (cells / 2)).long().clamp_(0, cells - 1)
        shape = 0 if len(self.occupied) == 1 or lines.view is None else lines.view
        x, y, z = cell.unbind(-1)
        held = self.occupied[shape, x, y, z]
        first = torch.where(held, order, torch.inf).amin(0)
        last = torch.where(held, order + 1, -torch.inf).amax(0)
        return torch.addcmul(near, torch.stack([first, last, first]), apart)

    @torch.no_grad()
    def lowest(self, rays: Rays, bounds: Bounds, shape: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Where along rays of the world the value between the coarse cells' centres is least."""
        volume = self.values.to(bounds.near.dtype).reshape(1, 1, -1, CELLS, CELLS)  # all shapes in a row
        last = volume.new_tensor(volume.shape[2:]) - 1
        before = F.pad(shape[:, None] * CELLS, (0, 2))
        best, least = bounds.near, torch.full_like(bounds.near, torch.inf)
        for k in range(SAMPLES // 2):
            t = torch.lerp(bounds.near, bounds.far, (2 * k + 1) / SAMPLES)
            place = (rays.at(t) / self.radius + 1) * (CELLS / 2) - 0.5
            index = place.clamp(0, CELLS - 1)
            grid = (2 * (index + before) / last - 1).flip(-1).reshape(1, 1, 1, -1, 3)
            value = F.grid_sample(volume, grid, align_corners=True).reshape(-1)
            value = value + (place - index).norm(dim=-1) * (2 / CELLS)  # f grows away from the surface
            best, least = torch.where(value < least, t, best), value.minimum(least)
        return best


@torch.no_grad()
def find_occupancy(evaluator: Evaluator, like: Tensor, lipschitz: float | None = None) -> Occupancy:
    """Excludes every cell with f(centre) > L · (half its diagonal), splits the others, and excludes again.

    Without a `lipschitz` constant L is measured: the steepest mean slope over any block of 2 × 2 × 2 cells, and the
    gradient in the cells nearest to the surface. Cells deep in the solid stay occupied: rays may start there.
    """
    shapes, width = evaluator.shapes, 2 / CELLS
    along = torch.arange(-1 + width / 2, 1, width, dtype=like.dtype, device=like.device)
    centres = torch.stack(torch.meshgrid(along, along, along, indexing="ij"), dim=-1).reshape(-1, 3)
    corners = like.new_tensor(CORNERS)
    shape = torch.arange(shapes, device=like.device)
    values = evaluator.at(centres.repeat(shapes, 1), shape.repeat_interleave(len(centres)), rough=True)
    coarse = values.reshape(shapes, *[CELLS] * 3)
    if lipschitz is None:
        blocks = coarse.unfold(1, 2, 2).unfold(2, 2, 2).unfold(3, 2, 2).reshape(shapes, -1, 8)
        steepest = _mean_slope(blocks, corners, width).amax(1)
        bound = MARGIN * steepest.maximum(_steep_gradient(evaluator, centres, coarse.flatten(1), width / 64))
    else:
        bound = like.new_full((shapes,), lipschitz)
    reach = (width * HALF_DIAGONAL * bound).reshape(-1, 1, 1, 1)
    uncertain = ~(coarse.abs() > reach)  # also where the field gives NaN
    shape, cell = uncertain.flatten(1).nonzero().unbind(1)
    children = centres[cell][:, None] + width / 4 * corners
    whose = shape.repeat_interleave(8)
    fine = evaluator.at(children.reshape(-1, 3), whose, rough=True)
    if lipschitz is None:
        bound = bound.scatter_reduce(0, shape, MARGIN * _mean_slope(fine.reshape(-1, 8), corners, width / 2), "amax")
        bound = bound.clamp_min(torch.finfo(bound.dtype).eps)  # of a constant field
    excluded = coarse > width * HALF_DIAGONAL * bound.reshape(-1, 1, 1, 1)
    occupied = F.interpolate((~excluded).to(like.dtype)[:, None], scale_factor=2.0)[:, 0]
    x, y, z = ((children + 1) * CELLS).long().reshape(-1, 3).unbind(1)
    occupied[whose, x, y, z] = (~(fine > width / 2 * HALF_DIAGONAL * bound[whose])).to(like.dtype)
    beside = F.max_pool3d(occupied[:, None], 3, 1, 1)[:, 0] > 0
    return Occupancy(beside, bound, coarse, evaluator.radius)


def _mean_slope(
    blocks: Float[Tensor, "*batch 8"], corners: Float[Tensor, "8 3"], width: float
) -> Float[Tensor, "*batch"]:
    """|∇f| over blocks of cells, by differences averaged over each axis; 0 where f is not finite."""
    return (blocks @ corners).norm(dim=-1).nan_to_num(0.0, posinf=0.0) / (4 * width)


def _steep_gradient(evaluator: Evaluator, centres: Tensor, values: Tensor, step: float) -> Float[Tensor, "shapes"]:
    """What most |∇f| stay below near the surface, by differences over a short `step`.

    They are measured in the cells nearest to the surface, and once more a Newton step on, as far as a cell's corner:
    what saturates, like tanh(s f), is steep at its surface alone. Of a field that is flat in all of these cells nothing
    is known but that it may be truncated: then its band is taken to be `BAND` wide.
    """
    values, nearest = values.abs().topk(PROBES, largest=False)
    at = centres[nearest]
    first = _gradient(evaluator, at, step)
    length = first.norm(dim=-1)
    way = (values / length).clamp_max(2 / CELLS * HALF_DIAGONAL).nan_to_num(0.0)
    at = at - F.normalize(first, dim=-1) * way[..., None]
    steep = torch.cat([length, _gradient(evaluator, at, step).norm(dim=-1)], dim=1).nan_to_num(0.0)
    steepest, least = steep.amax(1, keepdim=True), values[:, 0]
    found = steep.masked_fill(steep < FLAT * steepest, torch.nan).nanquantile(STEEP, dim=1)
    return torch.where(steepest[:, 0] > FLAT * least, found, least / BAND)


def _gradient(evaluator: Evaluator, points: Float[Tensor, "shapes n 3"], step: float) -> Float[Tensor, "shapes n 3"]:
    shapes, count, _ = points.shape
    offsets = step * torch.eye(4, 3, dtype=points.dtype, device=points.device)  # the last is none
    whose = torch.arange(shapes, device=points.device).repeat_interleave(4 * count)
    around = evaluator.at((points[:, :, None] + offsets).reshape(-1, 3), whose).reshape(shapes, count, 4)
    return (around[..., :3] - around[..., 3:]) / step
