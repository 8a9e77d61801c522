"""Cases of `bench trace`: DIST's strategies, its original code, and the default tracer (`fast`)."""

from collections.abc import Iterator
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.benchmarks.measuring import Case, reference_depth
from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.data.points import random_subset
from distrace.fields.base import SDF, chunked
from distrace.rays import Bounds, meet_sphere
from distrace.render import STRATEGIES, Buffers, render
from distrace.tracing.sphere_tracing import COARSE_TO_FINE, PARALLEL, Trace, sphere_trace

NAIVE_RAYS = 100  # the sample that the row `naive` is extrapolated from
ORIGINAL_BATCH = 100_000  # points
COUNT = 8  # of rows
TURN = 10.0  # degrees to the next view


def of_field(sdf: SDF, camera: Camera) -> Iterator[Case]:
    """Yields `naive` (a sample of rays, one after another) and the strategies, on one view of any field."""
    truth = reference_depth(sdf, camera)
    yield _naive(sdf, camera, truth)
    for name, config in STRATEGIES.items():
        yield Case(name, lambda config=config: render(sdf, camera, config=config), truth)


def of_model(model: Model, code: Float[Tensor, "length"], camera: Camera) -> Iterator[Case]:
    """Yields the cases of a decoder's shape, with DIST's original code and the default tracer's next view."""
    sdf = model.field(code)
    cases = list(of_field(sdf, camera))
    yield from cases[:-1]
    yield Case("original", lambda: _original(model, code, camera), cases[-1].truth)
    yield cases[-1]
    first = render(sdf, camera)
    turned = camera.turned(TURN)
    yield Case("fast_next", lambda: render(sdf, turned, occupancy=first.occupancy), reference_depth(sdf, turned))


def _naive(sdf: SDF, camera: Camera, truth: Tensor) -> Case:
    """Returns the case of one ray after another, each for all of its steps."""
    rays = camera.rays().flat()
    bounds = meet_sphere(rays)
    entering = bounds.meets.nonzero()[:, 0]
    sample = random_subset(entering, NAIVE_RAYS)
    cosines = camera.cosines().reshape(-1)[sample]

    def trace_one(k: Tensor) -> Trace:
        ray = rays[k[None]]
        trace = sphere_trace(sdf, ray, Bounds(bounds.near[k[None]], bounds.far[k[None]]), PARALLEL)
        for _ in range(int(trace.evaluations), PARALLEL.steps):
            sdf(ray.at(trace.stopped))
        return replace(trace, evaluations=torch.full_like(trace.evaluations, PARALLEL.steps))

    def render_each() -> Buffers:
        traces = [trace_one(k) for k in sample]
        images = {name: torch.cat([trace.images()[name] for trace in traces]) for name in traces[0].images()}
        return Buffers(sdf, rays[sample], cosines, replace(traces[0], **images), 1.0)

    return Case("naive", render_each, truth.reshape(-1)[sample], len(sample) / len(entering))


def _original(model: Model, code: Tensor, camera: Camera) -> Buffers:
    """Renders coarse-to-fine as the original code does.

    Each point has its own copy of the code, and each ray one more query at its least |f|, even after a hit.
    """
    sdf = chunked(lambda points: model.decoder(points, code.expand(len(points), -1)), ORIGINAL_BATCH)
    buffers = render(sdf, camera, config=COARSE_TO_FINE)
    marched = torch.isfinite(buffers.trace.closest)
    sdf(buffers.rays[marched].at(buffers.trace.closest[marched]))
    return replace(buffers, trace=replace(buffers.trace, evaluations=buffers.trace.evaluations + marched))
