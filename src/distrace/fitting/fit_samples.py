"""Fitting a code to signed samples, without rendering: DeepSDF's own way (Park et al., CVPR 2019, section 4.3)."""

import time
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.decoder import Decoder
from distrace.fitting.multistart import Step
from distrace.training.losses import clamped_loss


@dataclass(frozen=True)
class SampleFitConfig:
    """The original's 800 iterations of Adam, its rate divided by ten half-way."""

    iterations: int = 800
    learning_rate: float = 5e-3
    samples: int = 8000  # of each iteration
    clamp: float = 0.1
    code_weight: float = 1e-4  # × the mean of the code's squares
    code_deviation: float = 0.01  # of the first code's entries
    seed: int = 0


def fit_samples(
    decoder: Decoder, samples: Float[Tensor, "n 4"], config: SampleFitConfig = SampleFitConfig()
) -> Iterator[Step]:
    """Fits a code to points and their signed distances. Raises `ValueError` without samples."""
    if not len(samples):
        raise ValueError("no samples were given; fitting needs points with their signed distances")
    random = torch.Generator().manual_seed(config.seed)
    code = config.code_deviation * torch.randn(decoder.specs.code_length, generator=random)
    code = code.to(samples.device).requires_grad_()
    optimiser = torch.optim.Adam([code])
    for iteration in range(config.iterations):
        began = time.perf_counter()
        late = iteration >= config.iterations // 2
        optimiser.param_groups[0]["lr"] = config.learning_rate * (0.1 if late else 1.0)
        batch = samples[torch.randint(len(samples), (min(config.samples, len(samples)),), generator=random)]
        distance = clamped_loss(decoder.field(code)(batch[:, :3]), batch[:, 3], config.clamp)
        loss = distance + config.code_weight * code.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        terms = {"distance": float(distance.detach())}
        yield Step(0, iteration + 1, float(loss.detach()), terms, code.detach().clone(), time.perf_counter() - began)


def on_surface(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 4"]:
    """Surface points as samples."""
    return torch.cat([points, torch.zeros_like(points[:, :1])], dim=1)


def around_points(
    points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], offset: float = 0.01
) -> Float[Tensor, "m 4"]:
    """Samples at ± `offset` along the normals of surface points, as DeepSDF completes a depth map (section 6.3)."""
    sides = [
        torch.cat([points + sign * offset * normals, torch.full_like(points[:, :1], sign * offset)], dim=1)
        for sign in (-1.0, 1.0)
    ]
    return torch.cat(sides)
