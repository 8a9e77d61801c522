"""Slopes of a field near its surface: they scale its values to distances."""

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.base import SDF, evaluate_checked

CELLS = 7  # along the diameter; slopes are measured at their corners
STEP = 1e-2  # cell widths: of the finite differences


@torch.no_grad()
def typical_slope(sdf: SDF, like: Tensor, radius: float = 1.0) -> tuple[float, int]:
    """Returns the median of |∇f| near the surface in the sphere, and the evaluations that it took.

    It is taken over corners of a coarse grid that are within a cell of a zero, by |f| / |∇f|, which does not depend on
    the field's scale. 0 where no corner is.
    """
    along = torch.linspace(-radius, radius, CELLS + 1, dtype=like.dtype, device=like.device)
    points = torch.cartesian_prod(along, along, along)
    points = points[points.norm(dim=-1) <= radius * (1 + 1 / CELLS)]
    cell = 2 * radius / CELLS
    steps = STEP * cell * torch.eye(3).to(points)
    values, *values_ahead = evaluate_checked(
        sdf, torch.stack([points, *(points + step for step in steps)]).flatten(0, 1)
    ).chunk(4)
    slope = (torch.stack(values_ahead) - values).norm(dim=0) / (STEP * cell)
    near = slope[(values.abs() < cell * slope) & slope.isfinite()]
    return (float(near.median()) if len(near) else 0.0), 4 * len(points)


def percentile_99(slopes: Float[Tensor, "n"]) -> float:
    """Returns the 99th percentile of slopes; 0 of none."""
    return float(slopes.kthvalue(max(1, int(0.99 * len(slopes)))).values) if len(slopes) else 0.0
