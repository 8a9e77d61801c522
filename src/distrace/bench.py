"""Measuring the strategies of tracing on one view, against a reference that takes no chances."""

import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.field import SDF
from distrace.metrics import depth_errors, iou
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers, Config, render

OUTLIER = 1e-3
LONG = 60.0  # seconds; what takes longer is run once
SMALLEST_STEP = 5e-5


@dataclass(frozen=True)
class Row:
    """One strategy: what it cost and how far it is off. `setup_queries` are among the `queries`."""

    strategy: str
    queries: int
    setup_queries: int
    seconds: float
    runs: int
    hits: int
    iou: float
    depth_mean: float
    depth_p99: float
    depth_max: float
    outliers: int

    def asdict(self) -> dict:
        return asdict(self)


def poster_view(size: int = 512) -> Camera:
    """The view that all tables are measured on: 122,172 rays enter the unit sphere at 512 × 512.

    The published table has 122,166: some rays graze the sphere within the rounding of float32.
    """
    return Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=size, width=size)


@torch.no_grad()
def reference_distance(sdf: SDF, rays: Rays, bounds: Bounds) -> Float[Tensor, "*batch"]:
    """The first zero on each ray, `inf` without one.

    A cautious march (half the value, at most 0.02) until the sign changes, then bisection to 1e-6. Steps are never
    shorter than 5e-5, so that a ray on which f only comes close to zero ends.
    """
    rays, near, far = rays.flat(), bounds.near.reshape(-1), bounds.far.reshape(-1)
    low, high = near.clone(), torch.full_like(near, torch.inf)
    active = bounds.meets.reshape(-1).nonzero()[:, 0]
    while len(active):
        value = sdf(rays[active].at(low[active]))
        crossed = value < 0
        high[active[crossed]] = low[active[crossed]]
        active, value = active[~crossed], value[~crossed]
        last = low[active]
        low[active] = last + (0.5 * value).clamp(SMALLEST_STEP, 0.02)
        active = active[low[active] < far[active]]
    return _bisected(sdf, rays, high).reshape(bounds.near.shape)


def _bisected(sdf: SDF, rays: Rays, inside: Tensor) -> Tensor:
    """The zero before the first sample inside, which lies at most 0.02 before it."""
    found = torch.isfinite(inside).nonzero()[:, 0]
    high, low = inside[found], inside[found] - 0.02
    for _ in range(15):  # 0.02 / 2^15 < 1e-6
        middle = (low + high) / 2
        solid = sdf(rays[found].at(middle)) < 0
        low, high = torch.where(solid, low, middle), torch.where(solid, middle, high)
    return inside.index_put((found,), (low + high) / 2)


def ablation(
    sdf: SDF, camera: Camera, strategies: Mapping[str, Config], radius: float = 1.0, repeats: int = 5
) -> Iterator[tuple[Row, Buffers]]:
    """Measures each strategy on one view: times are medians of some runs after one to warm up."""
    rays = camera.rays()
    truth = camera.depth(reference_distance(sdf, rays, meet_sphere(rays, radius)))
    for name, config in strategies.items():
        buffers, seconds, runs = _timed(sdf, camera, radius, config, repeats)
        yield measured(name, buffers, truth, seconds, runs), buffers


def measured(name: str, buffers: Buffers, truth: Float[Tensor, "height width"], seconds: float, runs: int) -> Row:
    trace, errors = buffers.trace, depth_errors(buffers.depth, truth)
    if not len(errors):
        raise ValueError("the view shows nothing of this shape; there is nothing to measure")
    return Row(
        strategy=name,
        queries=trace.total_evaluations,
        setup_queries=trace.setup_evaluations,
        seconds=seconds,
        runs=runs,
        hits=int(buffers.mask.sum()),
        iou=iou(buffers.mask, torch.isfinite(truth)),
        depth_mean=float(errors.mean()),
        depth_p99=float(errors.quantile(0.99)) if len(errors) < 1 << 24 else float("nan"),
        depth_max=float(errors.max()),
        outliers=int((errors > OUTLIER).sum()),
    )


@torch.no_grad()
def _timed(sdf: SDF, camera: Camera, radius: float, config: Config, repeats: int) -> tuple[Buffers, float, int]:
    """The last rendering, the median time, and of how many runs; a single run is not warmed up for."""
    seconds: list[float] = []
    while len(seconds) < (repeats + 1 if repeats > 1 else 1) and not (seconds and seconds[0] > LONG):
        began = time.perf_counter()
        buffers = render(sdf, camera, radius=radius, config=config)
        if buffers.trace.distance.is_cuda:
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - began)
    timed = seconds[1:] or seconds
    return buffers, median(timed), len(timed)
