"""Rows of the tracing benchmark: DIST's strategies, its original code, and the default tracer (fast)."""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import torch
from torch import Tensor

from distrace.benchmarks.measuring import Case, reference_depth
from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF
from distrace.rays import Bounds, meet_sphere
from distrace.render import STRATEGIES, Buffers, Config, render
from distrace.tracing.sphere_tracing import COARSE_TO_FINE, PARALLEL, Trace, sphere_trace

NAIVE_RAYS = 100  # of which the row `naive` is a sample
ORIGINAL_BATCH = 100_000  # points
COUNT = 8  # of rows
TURN = 10.0  # degrees to the next view


def of_field(
    sdf: SDF, camera: Camera, strategies: Mapping[str, Config] = STRATEGIES, radius: float = 1.0
) -> Iterator[Case]:
    """One ray after another (a sample of them), and the strategies, on one view of any field."""
    truth = reference_depth(sdf, camera, radius)
    yield _naive(sdf, camera, truth, radius)
    for name, config in strategies.items():
        yield Case(name, lambda config=config: render(sdf, camera, radius=radius, config=config), truth)


def of_model(model: Model, code: int, camera: Camera) -> Iterator[Case]:
    """The strategies and DIST's original code on a decoder, and the default tracer on the next view of the shape."""
    sdf, latent = model.field(code), model.codes[code]
    cases = list(of_field(sdf, camera))
    yield from cases[:-1]
    yield Case("original", lambda: _original(model, latent, camera), cases[-1].truth)
    yield cases[-1]
    first = render(sdf, camera)
    aside = camera.turned(TURN)
    yield Case("fast_next", lambda: render(sdf, aside, occupancy=first.occupancy), reference_depth(sdf, aside))


def _naive(sdf: SDF, camera: Camera, truth: Tensor, radius: float) -> Case:
    """One ray after another, each for all of its steps."""
    rays, cosines = camera.rays().flat(), camera.cosines().reshape(-1)
    bounds = meet_sphere(rays, radius)
    entering = bounds.meets.nonzero()[:, 0]
    chosen = entering[torch.randperm(len(entering), generator=torch.Generator().manual_seed(0))[:NAIVE_RAYS]]
    some = Bounds(bounds.near[chosen], bounds.far[chosen])

    def alone(k: int) -> Trace:
        ray, part = rays[chosen[k : k + 1]], Bounds(some.near[k : k + 1], some.far[k : k + 1])
        trace = sphere_trace(sdf, ray, part, PARALLEL)
        for _ in range(int(trace.evaluations), PARALLEL.steps):
            sdf(ray.at(trace.stopped))
        return replace(trace, evaluations=torch.full_like(trace.evaluations, PARALLEL.steps))

    def render_each() -> Buffers:
        traces = [alone(k) for k in range(len(chosen))]
        images = {name: torch.cat([trace.images()[name] for trace in traces]) for name in traces[0].images()}
        return Buffers(sdf, rays[chosen], cosines[chosen], replace(traces[0], **images), radius)

    return Case("naive", render_each, truth.reshape(-1)[chosen], len(chosen) / len(entering))


def _original(model: Model, code: Tensor, camera: Camera) -> Buffers:
    """Coarse-to-fine as the original code runs it: each point with its own copy of the code, and a last query of the
    least |f| on every ray, also where it hit."""

    def sdf(points: Tensor) -> Tensor:
        return torch.cat([model.decoder(part, code.expand(len(part), -1)) for part in points.split(ORIGINAL_BATCH)])

    buffers = render(sdf, camera, config=COARSE_TO_FINE)
    met = torch.isfinite(buffers.trace.closest)
    sdf(buffers.rays[met].at(buffers.trace.closest[met]))
    return replace(buffers, trace=replace(buffers.trace, evaluations=buffers.trace.evaluations + met))
