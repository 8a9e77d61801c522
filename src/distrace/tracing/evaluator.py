"""The field as the tracer evaluates it: in the unit sphere, exactly or in bfloat16, with evaluations counted."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.fields.base import SDF, Counted, evaluate_checked
from distrace.fields.batch import BatchField, CountedBatch
from distrace.tracing.images import Lines

ROUGH_ERROR = 7e-4  # of 999 in 1,000 values of 8 × 512 decoders in bfloat16 near their surfaces


class Evaluator:
    """Evaluates a field along rays, in radii of the sphere, divided by the Lipschitz bound once it is known.

    `rough` values are in bfloat16 where that is faster on this machine, and good to `error`; elsewhere they are exact,
    and the error is zero. `cheap` is the field that `fastest_field` returns.
    """

    def __init__(self, sdf: SDF | BatchField, radius: float, cheap: SDF | BatchField | None = None) -> None:
        self.sdf = sdf
        self.radius = radius
        self.shapes = len(sdf) if isinstance(sdf, BatchField) else 1
        self.cheap = _counting(sdf, cheap)
        self.error = 0.0 if cheap is None else ROUGH_ERROR / radius
        self.scale: Tensor | None = None  # [shapes]
        self.evaluations = 0

    def exact(self, lines: Lines, t: Float[Tensor, "*k n"]) -> Float[Tensor, "*k n"]:
        return self.at(lines.at(t), lines.view)

    def rough(self, lines: Lines, t: Float[Tensor, "*k n"]) -> Float[Tensor, "*k n"]:
        return self.at(lines.at(t), lines.view, rough=True)

    def at(
        self, points: Float[Tensor, "*k n 3"], shape: Int[Tensor, "n"] | None, *, rough: bool = False
    ) -> Float[Tensor, "*k n"]:
        """Returns values at points of the unit sphere, each of the shape of its number."""
        if not points.numel():
            return points[..., 0]
        self.evaluations += points.numel() // 3
        field = self.cheap if rough and self.cheap is not None else self.sdf
        world = points if self.radius == 1 else points * self.radius
        if isinstance(field, BatchField):
            values = field.values(world, points.new_zeros(1, dtype=torch.int64) if shape is None else shape)
        else:
            values = evaluate_checked(field, world)
        if self.scale is None:
            return values if self.radius == 1 else values / self.radius
        return values * (self.scale[shape] if self.shapes > 1 else self.scale)

    def normalise(self, lipschitz: Float[Tensor, "shapes"]) -> None:
        """Scales later values so that |f| is at most the distance to the surface."""
        self.scale = (self.radius * lipschitz).reciprocal()
        self.error = self.error / float(lipschitz.min()) if self.error else 0.0


def _counting(sdf: SDF | BatchField, cheap: SDF | BatchField | None) -> SDF | BatchField | None:
    """Returns the cheap field, counting where the exact one counts."""
    if isinstance(sdf, CountedBatch) and isinstance(cheap, BatchField):
        return sdf.counting(cheap)
    if isinstance(sdf, Counted) and cheap is not None and not isinstance(cheap, BatchField):
        return sdf.counting(cheap)
    return cheap
