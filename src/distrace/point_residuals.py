"""What the shape of a code lacks of points whose distances are known, and its exact derivatives by the code."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.code_residuals import derivatives, with_prior
from distrace.decoder import FAR, Decoder
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.solver import Residuals


@dataclass(frozen=True)
class Coordinates:
    """Of a code."""

    w: Float[Tensor, "dimensions"]


@dataclass
class PointProblem:
    """Residuals f(p) − d of a code's coordinates at fixed points; surface points have d = 0.

    What is farther than `FAR`, on the right side, is right.
    """

    decoder: Decoder
    prior: Prior
    samples: Float[Tensor, "n 4"]
    counted: Weights
    scale: float = 0.02  # up to which deviations count by their squares
    evaluations: int = 0

    def look(self, w: Float[Tensor, "dimensions"], last: Coordinates | None = None) -> Coordinates:
        return Coordinates(w)

    def moved(self, at: Coordinates, step: Float[Tensor, "dimensions"]) -> Coordinates:
        return Coordinates(at.w + step)

    def residuals(self, at: Coordinates) -> Residuals:
        w, distances = at.w, self.samples[:, 3]
        values, _, by_code = derivatives(self.decoder, self.samples[:, :3], self.prior.code(w))
        self.evaluations += len(values)
        far = (values.abs() > FAR) & (distances.abs() > FAR) & (values.sign() == distances.sign())
        lacking = (values - distances).masked_fill(far, 0.0)
        jacobian = (by_code @ self.prior.basis).masked_fill(far[:, None], 0.0)
        weights = torch.full_like(lacking, self.counted.depth / len(lacking) / self.scale)
        return with_prior(lacking, jacobian, weights, w, self.counted.code)

    def terms(self, at: Coordinates, residuals: Residuals) -> dict[str, float]:
        distance = residuals.values[: len(self.samples)].abs().mean()
        return {
            "distance": self.counted.depth * float(distance),
            "code": self.counted.code * float(at.w.square().mean()),
        }
