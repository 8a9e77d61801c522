"""DeepSDF's own fit of a code to signed samples, without rendering (Park et al., CVPR 2019, section 4.3)."""

import time
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.fields.decoder import Decoder
from distrace.fitting.fit_code import CodeFit
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
) -> CodeFit:
    """Fits a code to points and their signed distances. Raises `ValueError` without samples."""
    if not len(samples):
        raise ValueError("no samples were given; fitting needs points with their signed distances")
    began = time.perf_counter()
    random = torch.Generator().manual_seed(config.seed)
    code = config.code_deviation * torch.randn(decoder.specs.code_length, generator=random)
    code = code.to(samples.device).requires_grad_()
    optimiser = torch.optim.Adam([code])
    losses = []
    count = min(config.samples, len(samples))
    for iteration in range(config.iterations):
        late = iteration >= config.iterations // 2
        optimiser.param_groups[0]["lr"] = config.learning_rate * (0.1 if late else 1.0)
        batch = samples[torch.randint(len(samples), (count,), generator=random)]
        distance = clamped_loss(decoder.field(code)(batch[:, :3]), batch[:, 3], config.clamp)
        loss = distance + config.code_weight * code.square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    seconds = time.perf_counter() - began
    return CodeFit(code.detach(), losses[-1], {"start 1": losses}, count * config.iterations, seconds)
