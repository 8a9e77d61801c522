"""What the shape of a code lacks of points whose distances are known, and its exact derivatives by the code."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.fields.batch import BatchField
from distrace.fields.decoder import FAR, Decoder
from distrace.fitting.code_jacobian import derivatives, with_prior
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.solver import Residuals
from distrace.losses import Weights
from distrace.prior import Prior

LOOKED = 20_000  # points at most that are asked whether they say something


@dataclass(frozen=True)
class Told:
    """One start's coordinates of a code, and the points that its shape is compared at."""

    start: int  # its number among the starts that are fitted together
    w: Float[Tensor, "dimensions"]
    samples: Float[Tensor, "n 4"]


@dataclass
class PointProblem:
    """Residuals f(p) − d of the coordinates of several codes, each a start, at points; surface points have d = 0.

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
    evaluations: Counter[int] = field(default_factory=Counter)  # of the field, by each start

    @torch.no_grad()
    def look(self, w: Sequence[Float[Tensor, "dimensions"]], last: Sequence[Told] | None = None) -> list[Told]:
        """Draws points that say something of each shape: the same draw for all starts, as if each were alone."""
        some = drawn(self.samples, LOOKED, self.random)
        self.evaluations.update({start: len(some) for start in range(len(w))})
        field = self.decoder.fields(torch.stack([self.prior.code(each) for each in w]))
        seed = int(torch.randint(1 << 62, (), generator=self.random))
        found = []
        for start, values in enumerate(field(some[:, :3].expand(len(w), -1, -1))):
            telling = some[~_right(values, some[:, 3])]
            random = torch.Generator().manual_seed(seed)
            found.append(Told(start, w[start], drawn(telling if len(telling) else some, self.count, random)))
        return found

    def moved(self, told: Sequence[Told], steps: Sequence[Float[Tensor, "dimensions"]]) -> list[Told]:
        return [Told(at.start, at.w + step, at.samples) for at, step in zip(told, steps, strict=True)]

    def residuals(self, told: Sequence[Told]) -> list[Residuals]:
        return [self._residuals(at) for at in told]  # a start has enough points for one product

    def _residuals(self, at: Told) -> Residuals:
        points, distances = at.samples[:, :3], at.samples[:, 3]
        values, _, by_code = derivatives(self.decoder, points, self.prior.code(at.w))
        self.evaluations[at.start] += len(values)
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
def misfits(field: BatchField, samples: Float[Tensor, "n 4"]) -> list[float]:
    """How far each shape is from the distances at points, in the mean, beyond `FAR` not at all."""
    values, distances = field(samples[:, :3].expand(len(field), -1, -1)), samples[:, 3]
    return (values.clamp(-FAR, FAR) - distances.clamp(-FAR, FAR)).abs().mean(1).tolist()


def _right(values: Float[Tensor, "n"], distances: Float[Tensor, "n"]) -> Bool[Tensor, "n"]:
    return (values.abs() > FAR) & (distances.abs() > FAR) & (values.sign() == distances.sign())
