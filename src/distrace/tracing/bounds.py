"""Empty-space skipping: values at the centres of cells, on two levels, exclude balls by a Lipschitz bound on f."""

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
CORNERS = tuple(itertools.product((-1, 1), repeat=3))  # of a cell; also the offsets of its eight parts
HALF_DIAGONAL = 3**0.5 / 2  # of a cell of width 1
MARGIN = 1.1  # × the largest measured slope: slopes between the samples may be larger
SAMPLES = 4 * CELLS  # of the cells along a ray through the sphere: half a cell apart
PROBES = 256  # cells nearest to the surface in which the gradient is measured
STEEP = 0.97  # share of these gradients that the bound covers: ReLU networks have a few steep facets
FLAT = 0.01  # of the largest gradient, and of the least value per radius: flatter fields are saturated
BAND = 0.018  # radii: a field that is flat at all probes is taken to rise to its values in a band of this width


@dataclass(frozen=True, eq=False, repr=False)
class Occupancy(ByValue):
    """The cells around the unit sphere that may hold surface, and their neighbours, for each shape of a batch."""

    occupied: Bool[Tensor, "shapes n n n"]
    lipschitz: Float[Tensor, "shapes"]  # the bound on |∇f|: at least the one by which cells were excluded
    values: Float[Tensor, "shapes m m m"]  # of f at the centres of the coarser cells, in radii
    radius: float
    cheap: SDF | BatchField | None = None  # the field in bfloat16, where that is faster on this machine

    def entered(self, lines: Lines) -> Float[Tensor, "3 n"]:
        """Returns the interval from the first to the last occupied cell on each ray, and its begin once more.

        It is inf to −inf where no cell is occupied. Cells are found by samples along the ray.
        """
        cells = self.occupied.shape[-1]
        near, far = lines.in_sphere(1 + 2 / cells)  # if the middle ray misses the sphere, others of its block may not
        spacing = (far - near).clamp_min(0) / SAMPLES
        order = torch.arange(SAMPLES, dtype=near.dtype, device=near.device)[:, None]
        cell = ((lines.at(torch.addcmul(near, order + 0.5, spacing)) + 1) * (cells / 2)).long().clamp_(0, cells - 1)
        shape = 0 if len(self.occupied) == 1 or lines.view is None else lines.view
        x, y, z = cell.unbind(-1)
        occupied = self.occupied[shape, x, y, z]
        first = torch.where(occupied, order, torch.inf).amin(0)
        last = torch.where(occupied, order + 1, -torch.inf).amax(0)
        return torch.addcmul(near, torch.stack([first, last, first]), spacing)

    @torch.no_grad()
    def lowest(self, rays: Rays, bounds: Bounds, shape: Int[Tensor, "n"]) -> Float[Tensor, "n"]:
        """Returns the distances along rays of the world at which the interpolated coarse values are least."""
        volume = self.values.to(bounds.near.dtype).reshape(1, 1, -1, CELLS, CELLS)  # all shapes in a row
        last = volume.new_tensor(volume.shape[2:]) - 1
        before = F.pad(shape[:, None] * CELLS, (0, 2))
        best = bounds.near
        least = torch.full_like(bounds.near, torch.inf)
        for k in range(SAMPLES // 2):
            t = torch.lerp(bounds.near, bounds.far, (2 * k + 1) / SAMPLES)
            place = (rays.at(t) / self.radius + 1) * (CELLS / 2) - 0.5
            index = place.clamp(0, CELLS - 1)
            grid = (2 * (index + before) / last - 1).flip(-1).reshape(1, 1, 1, -1, 3)
            value = F.grid_sample(volume, grid, align_corners=True).reshape(-1)
            value = value + (place - index).norm(dim=-1) * (2 / CELLS)  # f grows away from the surface
            best = torch.where(value < least, t, best)
            least = value.minimum(least)
        return best


@torch.no_grad()
def find_occupancy(evaluator: Evaluator, like: Tensor, lipschitz: float | None = None) -> Occupancy:
    """Excludes every cell with f(centre) > L · (half its diagonal), splits the others, and excludes again.

    Without a `lipschitz` constant, L is measured: the largest mean slope over any block of 2 × 2 × 2 cells, and the
    gradient in the cells nearest to the surface. Cells deep in the solid stay occupied, as rays may start in them.
    """
    shapes = evaluator.shapes
    width = 2 / CELLS
    along = torch.arange(-1 + width / 2, 1, width, dtype=like.dtype, device=like.device)
    centres = torch.stack(torch.meshgrid(along, along, along, indexing="ij"), dim=-1).reshape(-1, 3)
    corners = like.new_tensor(CORNERS)
    shape = torch.arange(shapes, device=like.device)
    values = evaluator.at(centres.repeat(shapes, 1), shape.repeat_interleave(len(centres)), rough=True)
    coarse = values.reshape(shapes, *[CELLS] * 3)
    if lipschitz is None:
        blocks = coarse.unfold(1, 2, 2).unfold(2, 2, 2).unfold(3, 2, 2).reshape(shapes, -1, 8)
        largest_slope = _mean_slope(blocks, corners, width).amax(1)
        bound = MARGIN * largest_slope.maximum(_steep_gradient(evaluator, centres, coarse.flatten(1), width / 64))
    else:
        bound = like.new_full((shapes,), lipschitz)
    reach = (width * HALF_DIAGONAL * bound).reshape(-1, 1, 1, 1)
    uncertain = ~(coarse.abs() > reach)  # also where the field gives NaN
    shape, cell = uncertain.flatten(1).nonzero().unbind(1)
    children = centres[cell][:, None] + width / 4 * corners
    child_shape = shape.repeat_interleave(8)
    fine = evaluator.at(children.reshape(-1, 3), child_shape, rough=True)
    if lipschitz is None:
        bound = bound.scatter_reduce(0, shape, MARGIN * _mean_slope(fine.reshape(-1, 8), corners, width / 2), "amax")
        bound = bound.clamp_min(torch.finfo(bound.dtype).eps)  # of a constant field
    excluded = coarse > width * HALF_DIAGONAL * bound.reshape(-1, 1, 1, 1)
    occupied = F.interpolate((~excluded).to(like.dtype)[:, None], scale_factor=2.0)[:, 0]
    x, y, z = ((children + 1) * CELLS).long().reshape(-1, 3).unbind(1)
    occupied[child_shape, x, y, z] = (~(fine > width / 2 * HALF_DIAGONAL * bound[child_shape])).to(like.dtype)
    dilated = F.max_pool3d(occupied[:, None], 3, 1, 1)[:, 0] > 0
    return Occupancy(dilated, bound, coarse, evaluator.radius)


def _mean_slope(
    blocks: Float[Tensor, "*batch 8"], corners: Float[Tensor, "8 3"], width: float
) -> Float[Tensor, "*batch"]:
    """Returns |∇f| over blocks of cells, by differences averaged over each axis; 0 where f is not finite."""
    return (blocks @ corners).norm(dim=-1).nan_to_num(0.0, posinf=0.0) / (4 * width)


def _steep_gradient(evaluator: Evaluator, centres: Tensor, values: Tensor, step: float) -> Float[Tensor, "shapes"]:
    """Returns a bound on most |∇f| near the surface, by differences over a short `step`.

    They are measured in the cells nearest to the surface, and once more after a Newton step, at most to a cell's
    corner: a saturating field, like tanh(s f), is steep at its surface alone. A field that is flat in all of these
    cells may be truncated; then its band is taken to be `BAND` wide.
    """
    values, nearest = values.abs().topk(PROBES, largest=False)
    points = centres[nearest]
    gradient = _gradient(evaluator, points, step)
    slope = gradient.norm(dim=-1)
    newton = (values / slope).clamp_max(2 / CELLS * HALF_DIAGONAL).nan_to_num(0.0)
    points = points - F.normalize(gradient, dim=-1) * newton[..., None]
    slopes = torch.cat([slope, _gradient(evaluator, points, step).norm(dim=-1)], dim=1).nan_to_num(0.0)
    largest_slope = slopes.amax(1, keepdim=True)
    least = values[:, 0]
    bound = slopes.masked_fill(slopes < FLAT * largest_slope, torch.nan).nanquantile(STEEP, dim=1)
    return torch.where(largest_slope[:, 0] > FLAT * least, bound, least / BAND)


def _gradient(evaluator: Evaluator, points: Float[Tensor, "shapes n 3"], step: float) -> Float[Tensor, "shapes n 3"]:
    shapes, count, _ = points.shape
    offsets = step * torch.eye(4, 3, dtype=points.dtype, device=points.device)  # the last is zero
    shape = torch.arange(shapes, device=points.device).repeat_interleave(4 * count)
    values = evaluator.at((points[:, :, None] + offsets).reshape(-1, 3), shape).reshape(shapes, count, 4)
    return (values[..., :3] - values[..., 3:]) / step
