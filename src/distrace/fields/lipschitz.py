"""How steep a field is where its surface may be: what scales values to distances."""

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF, asked

CELLS = 7  # along the diameter, at whose corners slopes are taken
APART = 1e-2  # of a cell's width: over which


@torch.no_grad()
def typical_slope(sdf: SDF, like: Tensor, radius: float = 1.0) -> tuple[float, int]:
    """The median of |∇f| at corners of a coarse grid in the sphere that are, by |f| / |∇f|, within a cell of a zero.

    And how many evaluations that took. 0 where no zero seems near any: what it says of itself tells, whatever the
    field's scale.
    """
    along = torch.linspace(-radius, radius, CELLS + 1, dtype=like.dtype, device=like.device)
    points = torch.cartesian_prod(along, along, along)
    points = points[points.norm(dim=-1) <= radius * (1 + 1 / CELLS)]
    cell = 2 * radius / CELLS
    steps = APART * cell * torch.eye(3).to(points)
    values, *ahead = asked(sdf, torch.stack([points, *(points + step for step in steps)]).flatten(0, 1)).chunk(4)
    slope = (torch.stack(ahead) - values).norm(dim=0) / (APART * cell)
    near = slope[(values.abs() < cell * slope) & slope.isfinite()]
    return (float(near.median()) if len(near) else 0.0), 4 * len(points)


def steep(slopes: Float[Tensor, "n"]) -> float:
    """What 99 of 100 slopes stay below; 0 of none."""
    return float(slopes.kthvalue(max(1, int(0.99 * len(slopes)))).values) if len(slopes) else 0.0
