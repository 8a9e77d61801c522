"""Where a surface can be: an octree of cell centres, each of which excludes a ball by a Lipschitz constant of f."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.rays import Bounds, Rays, meet_sphere
from distrace.tracing.batch import Batch
from distrace.tracing.evaluator import Evaluator

CELLS = 16  # along the diameter of the unit sphere; those that may hold surface are split once
HALF_DIAGONAL = 3**0.5 / 2  # of a cell of width 1
MARGIN = 1.1  # × the steepest slope that was measured: what is steeper lies between the samples
SAMPLES = 64  # of the cells along a ray through the sphere: less than half a cell apart
PROBES = 256  # cells nearest to the surface in which the gradient is measured
STEEP = 0.9  # share of these gradients that the bound covers: ReLU networks have a few steep facets


@dataclass(frozen=True)
class Occupancy:
    """The cells around the unit sphere that may hold surface, and their neighbours, for each shape of a batch."""

    occupied: Bool[Tensor, "shapes n n n"]
    lipschitz: Float[Tensor, "shapes"]  # the bound on |∇f| by which the others were excluded
    values: Float[Tensor, "shapes m m m"]  # of f at the centres of the coarser cells, in radii
    radius: float
    evaluations: int

    def entered(self, batch: Batch) -> Batch:
        """Rays from the first to the last cell on their way that may hold surface, without those that meet none."""
        rays = Rays(batch.origins, batch.directions)
        cells = self.occupied.shape[-1]
        bounds = meet_sphere(rays, 1 + 2 / cells)
        index = bounds.meets.nonzero()[:, 0]
        batch, near, far = batch[index], bounds.near[index], bounds.far[index]
        apart = (far - near) / SAMPLES
        steps = torch.arange(SAMPLES, device=near.device) + 0.5
        points = batch.at(near + steps[:, None] * apart)
        x, y, z = ((points + 1) * (cells / 2)).long().clamp_(0, cells - 1).unbind(-1)
        shape = batch.view if len(self.occupied) > 1 else torch.zeros_like(batch.view)
        held = self.occupied[shape, x, y, z]
        order = torch.arange(1, SAMPLES + 1, device=near.device)[:, None]
        last = (held * order).amax(0)
        first = SAMPLES - (held * order.flip(0)).amax(0)
        within = replace(batch, t=near + first * apart, far=near + last * apart)
        return within[(last > 0).nonzero()[:, 0]]

    @torch.no_grad()
    def lowest(self, rays: Rays, bounds: Bounds, shape: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Where along rays of the world the value between the coarse cells' centres is least."""
        volume = self.values.reshape(1, 1, -1, CELLS, CELLS)  # all shapes in a row
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
    """Excludes every cell with |f(centre)| > L · (half its diagonal), splits the others, and excludes again.

    Without a `lipschitz` constant L is measured: the steepest mean slope over any block of 2 × 2 × 2 cells, and the
    gradient in the cells nearest to the surface. Cells deep in the solid stay occupied: rays may start there.
    """
    shapes, width = evaluator.shapes, 2 / CELLS
    along = (torch.arange(CELLS, dtype=like.dtype, device=like.device) + 0.5) * width - 1
    centres = torch.cartesian_prod(along, along, along)
    shape = torch.arange(shapes, device=like.device)
    values = evaluator.at(centres.repeat(shapes, 1), shape.repeat_interleave(len(centres)), rough=True).reshape(
        shapes, -1
    )
    if lipschitz is None:
        blocks = values.reshape(shapes, *[CELLS] * 3).unfold(1, 2, 2).unfold(2, 2, 2).unfold(3, 2, 2)
        steepest = _mean_slope(blocks, width).flatten(1).amax(1)
        bound = MARGIN * steepest.maximum(_steep_gradient(evaluator, centres, values, width / 64))
    else:
        bound = like.new_full((shapes,), lipschitz)
    reach = (width * HALF_DIAGONAL) * bound[:, None]
    possible = ~(values > reach)  # also where the field gives NaN
    shape, cell = (possible & ~(values < -reach)).nonzero().unbind(1)
    children = centres[cell][:, None] + torch.cartesian_prod(*[like.new_tensor([-width / 4, width / 4])] * 3)
    whose = shape.repeat_interleave(8)
    fine = evaluator.at(children.reshape(-1, 3), whose, rough=True)
    if lipschitz is None:
        bound = bound.scatter_reduce(0, shape, MARGIN * _mean_slope(fine.reshape(-1, 2, 2, 2), width / 2), "amax")
    occupied = possible.reshape(shapes, *[CELLS] * 3)
    occupied = occupied.repeat_interleave(2, 1).repeat_interleave(2, 2).repeat_interleave(2, 3)
    x, y, z = ((children + 1) * CELLS).long().reshape(-1, 3).unbind(-1)
    occupied[whose, x, y, z] = ~(fine > (width / 2 * HALF_DIAGONAL) * bound[whose])
    beside = F.max_pool3d(occupied[:, None].to(like.dtype), 3, 1, 1)[:, 0] > 0
    coarse = values.reshape(shapes, *[CELLS] * 3)
    return Occupancy(beside, bound, coarse, evaluator.radius, evaluator.evaluations)


def _mean_slope(blocks: Float[Tensor, "*batch 2 2 2"], width: float) -> Float[Tensor, "*batch"]:
    """|∇f| over blocks of cells, by differences averaged over each axis: no more than the steepest slope in them."""
    means = [blocks.diff(dim=axis).flatten(-3).mean(-1) for axis in (-1, -2, -3)]
    return torch.stack(means).norm(dim=0) / width


def _steep_gradient(evaluator: Evaluator, centres: Tensor, values: Tensor, step: float) -> Float[Tensor, "shapes"]:
    """What most |∇f| stay below in the cells nearest to the surface, by differences over a short `step`."""
    shapes = len(values)
    nearest = values.abs().topk(PROBES, largest=False).indices
    ahead = centres[nearest][:, :, None] + step * torch.eye(3, dtype=centres.dtype, device=centres.device)
    whose = torch.arange(shapes, device=centres.device).repeat_interleave(3 * PROBES)
    moved = evaluator.at(ahead.reshape(-1, 3), whose).reshape(shapes, PROBES, 3)
    here = evaluator.at(centres[nearest].reshape(-1, 3), whose[::3]).reshape(shapes, PROBES, 1)
    return ((moved - here) / step).norm(dim=-1).kthvalue(int(STEEP * PROBES), dim=1).values
