"""Fitting a shape's code to observed views, as an iterator of steps."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

import torch
from jaxtyping import Float
from torch import Tensor

from distrace import losses
from distrace.data.view import View
from distrace.decoder import Decoder
from distrace.field import SDF, Counted
from distrace.losses import Weights
from distrace.render import render_rays
from distrace.targets import Pool, Targets
from distrace.trace import TraceConfig

LEAST_DEVIATION = 0.4  # of the mean one: on held-out sofas better than none and no worse than 1


@dataclass(frozen=True)
class FitConfig:
    """Adam on the code, its rate falling to zero along a cosine."""

    iterations: int = 150
    learning_rate: float = 0.1  # in standard deviations of the training codes
    depth_rays: int = 1000  # of each view at each iteration
    mask_rays: int = 500
    weights: Weights = Weights()
    margin: float = 0.005  # how far the surface is to stay from rays of the background
    starts: int = 3
    trial: int = 20  # iterations that every start is given before the best goes on alone
    trace: TraceConfig = field(default_factory=lambda: TraceConfig(coarse_levels=0, tolerance=5e-4))
    seed: int = 0

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.starts < 1:
            given = f"{self.iterations} iterations and {self.starts} starts"
            raise ValueError(f"{given} were asked for; both must be at least 1")

    @property
    def tried(self) -> int:
        """Iterations of each start before the choice; the best has at least one left to go on."""
        return min(self.trial, self.iterations - 1) if self.starts > 1 else 0

    @property
    def total(self) -> int:
        return self.iterations + self.tried * (self.starts - 1)


@dataclass(frozen=True)
class Prior:
    """Codes as mean + basis · w, with w of unit variance over the training codes: steps follow what shapes do."""

    mean: Float[Tensor, "length"]
    basis: Float[Tensor, "length dimensions"]

    def code(self, w: Float[Tensor, "dimensions"]) -> Float[Tensor, "length"]:
        return self.mean + self.basis @ w


@dataclass(frozen=True)
class Step:
    """The code after an iteration, and the loss that it was taken from."""

    start: int
    iteration: int
    loss: float
    terms: dict[str, float]
    code: Float[Tensor, "length"]
    seconds: float
    evaluations: int = 0  # of the field


def prior_of(codes: Float[Tensor, "shapes length"]) -> Prior:
    """The Gaussian of some training codes; of fewer than two, DeepSDF's N(0, 0.1²).

    Directions in which the training codes hardly differ keep a small deviation: shapes not trained on need them.
    """
    length = codes.shape[1]
    if len(codes) < 2:
        return Prior(codes.new_zeros(length), 0.1 * torch.eye(length, device=codes.device))
    mean = codes.mean(0)
    _, found, directions = torch.linalg.svd((codes - mean) / math.sqrt(len(codes) - 1))
    deviations = codes.new_zeros(length)
    deviations[: len(found)] = found
    return Prior(mean, directions.T * (deviations**2 + (LEAST_DEVIATION * found.mean()) ** 2).sqrt())


def fit_shape(decoder: Decoder, views: Sequence[View], prior: Prior, config: FitConfig = FitConfig()) -> Iterator[Step]:
    """Fits a code to views. Of several starts the one of the least loss goes on; its last step is the result.

    Raises `ValueError` without views, or with one from inside the mean shape.
    """
    if not views:
        raise ValueError("no view was given; fitting needs at least one")
    _check_outside(decoder.field(prior.mean), views, prior.mean.device)
    pools = [Pool.of(view) for view in views]
    runs, trials = [], []
    for start in range(config.starts):
        run = _descend(decoder, pools, prior, config, start)
        for step in islice(run, config.tried):
            yield step
            trials.append(step)
        runs.append(run)
    yield from runs[_best(trials) if trials else 0]


@torch.no_grad()
def _check_outside(mean: SDF, views: Sequence[View], device: torch.device) -> None:
    """From inside a shape nothing is hit, and nothing can be learnt."""
    eyes = torch.stack([view.camera.T_world_camera[:3, 3] for view in views])
    values = mean(eyes.to(device))
    if (values < 0).any():
        eye = [round(x, 3) for x in eyes[int(values.argmin())].tolist()]
        raise ValueError(
            f"the camera at {eye} is inside the mean shape; shapes are seen from outside, about the origin"
        )


def _best(trials: list[Step]) -> int:
    """The start whose last losses are the least: each is measured on other rays, so some are averaged."""
    starts = {step.start for step in trials}
    recent = {start: [step.loss for step in trials if step.start == start][-8:] for start in starts}
    return min(starts, key=lambda start: sum(recent[start]) / len(recent[start]))


def _descend(decoder: Decoder, pools: list[Pool], prior: Prior, config: FitConfig, start: int) -> Iterator[Step]:
    """Adam from one start: the mean shape first, then draws from the prior."""
    random = torch.Generator().manual_seed(config.seed + start)
    w = torch.randn(prior.basis.shape[1], generator=random) * (0.0 if start == 0 else 0.7)
    w = w.to(prior.mean.device).requires_grad_()
    optimiser = torch.optim.Adam([w])
    for iteration in range(config.iterations):
        began = time.perf_counter()
        optimiser.param_groups[0]["lr"] = (
            config.learning_rate * (1 + math.cos(math.pi * iteration / config.iterations)) / 2
        )
        code = prior.code(w)
        targets = [pool.draw(config.depth_rays, config.mask_rays, random) for pool in pools]
        sdf = Counted(decoder.field(code))
        terms = view_terms(sdf, targets, config)
        terms["code"] = config.weights.code * w.square().mean()
        loss = torch.stack(list(terms.values())).sum()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([w], 1.0)  # one grazing ray must not throw the code out
        optimiser.step()
        named = {name: float(term.detach()) for name, term in terms.items()}
        seconds = time.perf_counter() - began
        now = prior.code(w.detach())
        yield Step(start, iteration + 1, float(loss.detach()), named, now, seconds, sdf.evaluations)


def view_terms(sdf: SDF, targets: list[Targets], config: FitConfig) -> dict[str, Tensor]:
    """The weighted terms of the loss, averaged over views."""
    weights = config.weights
    totals: dict[str, Tensor] = {}
    for target in targets:
        buffers = render_rays(sdf, target.camera, target.pixels, config=config.trace)
        missing, extra = losses.silhouette_loss(buffers, target.is_object, config.margin)
        terms = {
            "depth": weights.depth * losses.depth_loss(buffers, target.depth),
            "missing": weights.mask * missing,
            "extra": weights.mask * extra,
        }
        if target.normal is not None:
            terms["normal"] = weights.normal * losses.normal_loss(buffers, target.normal)
        totals = {name: totals.get(name, 0.0) + term / len(targets) for name, term in terms.items()}
    return totals
