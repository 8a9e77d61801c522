"""Other shapes that what was seen allows, and how far they are apart: where nothing was seen, many fit.

Each is the same fit, pulled towards another draw from the prior than its mean (randomise, then optimise: Bardsley et
al., SIAM J. Sci. Comput. 2014), so that it follows the draw where nothing was seen.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fields.decoder import FAR
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.methods import completing
from distrace.fitting.multistart import Step, charged
from distrace.prior import START_DEVIATION, Prior, prior_of

CONFIG = CodeFitConfig(iterations=10, starts=1, stages=3, narrowing=0.3, robust=0, sharpening=0)


def plausible(
    model: Model, seen: View | Cloud, count: int, config: CodeFitConfig = CONFIG, seed: int = 0
) -> Iterator[Step]:
    """`count` completions; the step of each is its last one, and `start` its number."""
    prior, random = prior_of(model.codes), torch.Generator().manual_seed(seed)
    for number in range(count):
        draw = prior.code(prior.draw(random, START_DEVIATION))
        *steps, last = completing(model, seen, replace(config, starts=1), Prior(draw, prior.basis))
        yield charged(replace(last, start=number), steps)


@torch.no_grad()
def spread(model: Model, codes: Sequence[Float[Tensor, "length"]], points: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """How far the surfaces of codes are from each point: the root of the mean squared distance, at most `FAR`."""
    distances = torch.stack([model.field(code)(points).clamp(-FAR, FAR) for code in codes])
    return distances.square().mean(0).sqrt()
