"""What the shape of a code lacks of points whose distances are known, and its exact derivatives by the code."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.decoder import FAR, Decoder
from distrace.field import SDF
from distrace.fitting.by_code import derivatives, with_prior
from distrace.fitting.solver import Residuals
from distrace.fitting.targets import drawn
from distrace.losses import Weights
from distrace.prior import Prior

LOOKED = 20_000  # points at most that are asked whether they say something


@dataclass(frozen=True)
class Told:
    """Coordinates of a code, and the points that its shape is compared at."""

    w: Float[Tensor, "dimensions"]
    samples: Float[Tensor, "n 4"]


@dataclass
class PointProblem:
    """Residuals f(p) − d of a code's coordinates at points; surface points have d = 0.

    What is farther than `FAR`, on the right side, is right. A look finds points that are not: most of those far from
    the surface say nothing, but a surface where none should be is known from them alone.
    """

    decoder: Decoder
    prior: Prior
    samples: Float[Tensor, "all 4"]
    count: int  # of them that are compared at once
    random: torch.Generator
    counted: Weights
    scale: float = 0.02  # up to which deviations count by their squares
    evaluations: int = 0

    @torch.no_grad()
    def look(self, w: Float[Tensor, "dimensions"], last: Told | None = None) -> Told:
        """Draws points that say something of this shape."""
        some = drawn(self.samples, LOOKED, self.random)
        self.evaluations += len(some)
        values = self.decoder.field(self.prior.code(w))(some[:, :3])
        telling = some[~_right(values, some[:, 3])]
        return Told(w, drawn(telling if len(telling) else some, self.count, self.random))

    def moved(self, at: Told, step: Float[Tensor, "dimensions"]) -> Told:
        return Told(at.w + step, at.samples)

    def residuals(self, at: Told) -> Residuals:
        points, distances = at.samples[:, :3], at.samples[:, 3]
        values, _, by_code = derivatives(self.decoder, points, self.prior.code(at.w))
        self.evaluations += len(values)
        right = _right(values, distances)
        lacking = (values - distances).masked_fill(right, 0.0)
        jacobian = (by_code @ self.prior.basis).masked_fill(right[:, None], 0.0)
        weights = torch.full_like(lacking, self.counted.depth / len(lacking) / self.scale)
        return with_prior(lacking, jacobian, weights, at.w, self.counted.code)

    def terms(self, at: Told, residuals: Residuals) -> dict[str, float]:
        distance = residuals.values[: len(at.samples)].abs().mean()
        return {
            "distance": self.counted.depth * float(distance),
            "code": self.counted.code * float(at.w.square().mean()),
        }


@torch.no_grad()
def misfit(sdf: SDF, samples: Float[Tensor, "n 4"]) -> float:
    """How far a field is from the distances at points, in the mean, beyond `FAR` not at all."""
    values, distances = sdf(samples[:, :3]), samples[:, 3]
    apart = (values.clamp(-FAR, FAR) - distances.clamp(-FAR, FAR)).abs()
    return float(apart.mean())


def _right(values: Float[Tensor, "n"], distances: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    return (values.abs() > FAR) & (distances.abs() > FAR) & (values.sign() == distances.sign())
