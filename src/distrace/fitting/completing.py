"""Completes a shape of a model from a view or a cloud in the canonical frame; and other shapes that fit as well."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fields.decoder import FAR
from distrace.fitting.fit import FitConfig, Step, fit_shape
from distrace.fitting.fit_code import CodeFit, CodeFitConfig, fit_observed, plausible_codes
from distrace.fitting.observed import Observed
from distrace.fitting.rounds import Progress
from distrace.prior import Prior, prior_of

NORMAL_OFFSET = 0.01  # radii from a point along its normal, of the two samples there: DeepSDF's section 6.3


def complete_shape(
    model: Model, seen: View | Cloud, config: FitConfig | CodeFitConfig, progress: Progress | None = None
) -> CodeFit:
    """Returns the code that fits, by Levenberg–Marquardt or, from a view, by Adam. Runs on the model's device."""
    prior = prior_of(model.codes)
    if isinstance(config, CodeFitConfig) or isinstance(seen, Cloud):
        settings = config if isinstance(config, CodeFitConfig) else CodeFitConfig(seed=config.seed)
        return fit_observed(model.decoder, observed_of(model, seen, prior), prior, settings, progress)
    steps = []
    for step in fit_shape(model.decoder, [seen.to(model.codes.device)], prior, config):
        steps.append(step)
        if progress is not None:
            progress(len(steps))
    return fit_of(steps)


def fit_of(steps: Sequence[Step]) -> CodeFit:
    """Returns the result of Adam's steps, the last of which is the best start's."""
    last = steps[-1]
    numbers = dict.fromkeys([last.start, *(step.start for step in steps)])
    losses = {f"start {k + 1}": [step.loss for step in steps if step.start == k] for k in numbers}
    evaluations = sum(step.evaluations for step in steps)
    return CodeFit(last.code, last.loss, losses, evaluations, sum(step.seconds for step in steps))


def observed_of(model: Model, seen: View | Cloud, prior: Prior) -> Observed:
    """Returns what a view or a cloud says of a shape; a cloud's normals tell distances beside its points."""
    seen = seen.to(model.codes.device)
    if isinstance(seen, View):
        return Observed.of_views(model.decoder, [seen], prior)
    points = seen.points
    if seen.normals is None:
        return Observed.of_points(signed_samples(points, torch.zeros_like(points), 0.0))
    sides = [signed_samples(points, seen.normals, offset) for offset in (-NORMAL_OFFSET, NORMAL_OFFSET)]
    return Observed.of_points(torch.cat(sides))


def signed_samples(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], offset: float) -> Float[Tensor, "n 4"]:
    """Returns points moved along normals of the surface, and their distances from it."""
    return torch.cat([points + offset * normals, torch.full_like(points[:, :1], offset)], dim=1)


def posterior_codes(
    model: Model, seen: View | Cloud, count: int, config: CodeFitConfig = CodeFitConfig()
) -> tuple[list[Float[Tensor, "length"]], int]:
    """Returns the codes of `count` completions, best first, and the number of evaluations."""
    prior = prior_of(model.codes)
    return plausible_codes(model.decoder, observed_of(model, seen, prior), prior, count, config)


@torch.no_grad()
def posterior_deviation(
    model: Model, codes: Sequence[Float[Tensor, "length"]], points: Float[Tensor, "n 3"]
) -> Float[Tensor, "n"]:
    """How far the surfaces of codes are from each point: the root of the mean squared distance, at most `FAR`."""
    distances = torch.stack([model.field(code)(points).clamp(-FAR, FAR) for code in codes])
    return distances.square().mean(0).sqrt()
