"""Fits a shape's code to observed views by Adam on DIST's loss, which renders them at every iteration."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from statistics import fmean

import torch
from jaxtyping import Float
from torch import Tensor

from distrace import losses
from distrace.data.observation import View
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.ray_sampling import Pool, Targets, pools_of
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.render import render_rays
from distrace.tracing.sphere_tracing import TraceConfig

RECENT = 8  # iterations whose mean loss says which start is best: each measures it on other rays


@dataclass(frozen=True)
class FitConfig:
    """Adam on the code, its rate falling to zero along a cosine, from several starts of which the best goes on."""

    iterations: int = 150
    starts: int = 3
    trial: int = 20  # iterations of each start before the choice
    seed: int = 0
    learning_rate: float = 0.1  # in standard deviations of the training codes
    depth_rays: int = 1000  # of each view at each iteration
    mask_rays: int = 500
    weights: Weights = Weights()
    margin: float = 0.005  # how far the surface is to stay from rays of the background
    trace: TraceConfig = field(default_factory=lambda: TraceConfig(steps=150, tolerance=5e-4))

    def __post_init__(self) -> None:
        if min(self.iterations, self.starts) < 1:
            given = f"{self.iterations} iterations and {self.starts} starts"
            raise ValueError(f"{given} were given; each must be at least 1")

    @property
    def tried(self) -> int:
        """Iterations of each start before the choice; the best has at least one left."""
        return min(self.trial, self.iterations - 1) if self.starts > 1 else 0

    @property
    def total(self) -> int:
        """Iterations of all starts."""
        return self.iterations + self.tried * (self.starts - 1)


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


def fit_shape(decoder: Decoder, views: Sequence[View], prior: Prior, config: FitConfig = FitConfig()) -> Iterator[Step]:
    """Fits a code to views. Of several starts the one of the least loss goes on; the last step is the result.

    Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
    starts = range(config.starts if config.tried else 1)
    descents = [_Descent(decoder, pools, prior, config, start) for start in starts]
    recent = []
    for descent in descents:
        trial = []
        for _ in range(config.tried):
            step = descent.step()
            yield step
            trial.append(step.loss)
        recent.append(fmean(trial[-RECENT:]) if trial else 0.0)
    best = descents[recent.index(min(recent))]
    for _ in range(config.tried, config.iterations):
        yield best.step()


class _Descent:
    """Adam from one start, on other rays at every iteration."""

    def __init__(self, decoder: Decoder, pools: list[Pool], prior: Prior, config: FitConfig, start: int) -> None:
        self.decoder = decoder
        self.pools = pools
        self.prior = prior
        self.config = config
        self.start = start
        self.iteration = 0
        self.random = torch.Generator().manual_seed(config.seed + start)
        self.w = prior.start(start, config.seed).requires_grad_()
        self.optimiser = torch.optim.Adam([self.w])

    def step(self) -> Step:
        began = time.perf_counter()
        config = self.config
        fall = (1 + math.cos(math.pi * self.iteration / config.iterations)) / 2
        self.optimiser.param_groups[0]["lr"] = config.learning_rate * fall
        targets = [pool.draw(config.depth_rays, config.mask_rays, self.random) for pool in self.pools]
        sdf = Counted(self.decoder.field(self.prior.code(self.w)))
        terms = view_terms(sdf, targets, config)
        terms["code"] = config.weights.code * self.w.square().mean()
        loss = torch.stack(list(terms.values())).sum()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_([self.w], 1.0)  # one grazing ray must not throw the code out
        self.optimiser.step()
        self.iteration += 1
        named = {name: float(term.detach()) for name, term in terms.items()}
        code = self.prior.code(self.w.detach())
        seconds = time.perf_counter() - began
        return Step(self.start, self.iteration, float(loss.detach()), named, code, seconds, sdf.evaluations)


def view_terms(sdf: SDF, targets: list[Targets], config: FitConfig) -> dict[str, Tensor]:
    """Returns the weighted terms of the loss, averaged over views."""
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
