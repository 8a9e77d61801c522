"""Fitting a shape's code to observed views, as an iterator of steps."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from distrace import losses
from distrace.data.observation import View
from distrace.fields.base import SDF, Counted
from distrace.fields.decoder import Decoder
from distrace.fitting.multistart import Starts, Step, best_of
from distrace.fitting.ray_sampling import Pool, Targets
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.render import render_rays
from distrace.tracing.sphere_tracing import TraceConfig


@dataclass(frozen=True)
class FitConfig(Starts):
    """Adam on the code, its rate falling to zero along a cosine."""

    learning_rate: float = 0.1  # in standard deviations of the training codes
    depth_rays: int = 1000  # of each view at each iteration
    mask_rays: int = 500
    weights: Weights = Weights()
    margin: float = 0.005  # how far the surface is to stay from rays of the background
    trace: TraceConfig = field(default_factory=lambda: TraceConfig(steps=150, tolerance=5e-4))


def fit_shape(decoder: Decoder, views: Sequence[View], prior: Prior, config: FitConfig = FitConfig()) -> Iterator[Step]:
    """Fits a code to views. Of several starts the one of the least loss goes on; its last step is the result.

    Raises `ValueError` without views, or with one from inside the mean shape.
    """
    pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
    return best_of(config, lambda start: _descend(decoder, pools, prior, config, start))


@torch.no_grad()
def pools_of(mean: SDF, views: Sequence[View], device: torch.device) -> list[Pool]:
    """What can be drawn from each view. From inside the mean shape nothing is hit, and nothing can be learnt."""
    if not views:
        raise ValueError("no view was given; fitting needs at least one")
    eyes = torch.stack([view.camera.T_world_camera[:3, 3] for view in views])
    values = mean(eyes.to(device))
    if (values < 0).any():
        eye = [round(x, 3) for x in eyes[int(values.argmin())].tolist()]
        raise ValueError(
            f"the camera at {eye} is inside the mean shape; shapes are seen from outside, about the origin"
        )
    return [Pool.of(view) for view in views]


def _descend(decoder: Decoder, pools: list[Pool], prior: Prior, config: FitConfig, start: int) -> Iterator[Step]:
    """Adam from one start, on other rays at every iteration."""
    random = torch.Generator().manual_seed(config.seed + start)
    w = prior.start(start, config.seed).requires_grad_()
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
