"""Measuring ways to trace a view, against a reference that takes no chances."""

import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.metrics import depth_errors, iou
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers
from distrace.tracing.evaluator import Evaluator

OUTLIER = 1e-3
LONG = 60.0  # seconds; what takes longer is run once
SMALLEST_STEP = 5e-5


@dataclass(frozen=True)
class Row:
    """One strategy: what it cost and how far it is off. `setup_queries` are among the `queries`.

    Where only a sample of the rays was traced (`share` below 1), counts and times are extrapolated from it.
    """

    strategy: str
    queries: int
    setup_queries: int
    per_pixel: float  # queries per visible pixel of the reference
    seconds: float
    runs: int
    hits: int
    iou: float
    depth_mean: float
    depth_p99: float
    depth_max: float
    outliers: int
    share: float = 1.0


@dataclass(frozen=True)
class Case:
    """What a row is measured on: a way to render some rays, and the depth that they should show."""

    strategy: str
    render: Callable[[], Buffers]
    truth: Float[Tensor, "*batch"]
    share: float = 1.0  # of all rays that enter the sphere


class Operations(TorchDispatchMode):
    """Counts what PyTorch is asked to do."""

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += 1
        return func(*args, **(kwargs or {}))


@contextmanager
def recorded() -> Iterator[list[partial[Tensor]]]:
    """What the tracer evaluates meanwhile, to be evaluated once more."""
    calls: list[partial[Tensor]] = []
    at = Evaluator.at

    def watched(self: Evaluator, points: Tensor, shape: Tensor | None, *, rough: bool = False) -> Tensor:
        calls.append(partial(at, self, points, shape, rough=rough))
        return calls[-1]()

    Evaluator.at = watched
    try:
        yield calls
    finally:
        Evaluator.at = at


def poster_view(size: int = 512) -> Camera:
    """The view that all tables are measured on: 122,172 rays enter the unit sphere at 512 × 512.

    The published table has 122,166: some rays graze the sphere within the rounding of float32.
    """
    return Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=size, width=size)


@torch.no_grad()
def reference_distance(
    sdf: SDF, rays: Rays, bounds: Bounds, smallest: float = SMALLEST_STEP
) -> Float[Tensor, "*batch"]:
    """Returns the distance of the first surface on each ray, `inf` where there is none.

    A cautious march (half the value, at most 0.02) until the sign changes, then bisection to 1e-6. Steps are never
    shorter than the `smallest`, so that a ray on which f only comes close to zero ends. A ray that starts in the solid
    sees nothing, as for every strategy (`Outcome.INSIDE`).
    """
    rays, near, far = rays.flat(), bounds.near.reshape(-1), bounds.far.reshape(-1)
    low, high = near.clone(), torch.full_like(near, torch.inf)
    outside = torch.full_like(near, -torch.inf)  # the last sample before the sign changes
    active = bounds.meets.reshape(-1).nonzero()[:, 0]
    while len(active):
        value = sdf(rays[active].at(low[active]))
        crossed = value < 0
        high[active[crossed]] = low[active[crossed]]
        active, value = active[~crossed], value[~crossed]
        last = low[active]
        outside[active] = last
        ahead = last + (0.5 * value).clamp(smallest, 0.02)
        low[active] = ahead.maximum(last.nextafter(far[active]))  # where a step is less than a number can tell
        active = active[low[active] < far[active]]
    return _bisected(sdf, rays, outside, high).reshape(bounds.near.shape)


def _bisected(sdf: SDF, rays: Rays, outside: Float[Tensor, "n"], inside: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Returns the zero between two samples at most 0.02 apart; `inf` where one of them is not finite."""
    found = (torch.isfinite(inside) & torch.isfinite(outside)).nonzero()[:, 0]
    low, high = outside[found], inside[found]
    for _ in range(15):  # 0.02 / 2^15 < 1e-6
        middle = (low + high) / 2
        solid = sdf(rays[found].at(middle)) < 0
        low, high = torch.where(solid, low, middle), torch.where(solid, middle, high)
    return torch.full_like(inside, torch.inf).index_put((found,), (low + high) / 2)


def reference_depth(sdf: SDF, camera: Camera, radius: float = 1.0) -> Float[Tensor, "height width"]:
    """By `reference_distance`, whose smallest step is at most a twentieth of a pixel at the sphere's middle."""
    rays = camera.rays()
    away = max(float(camera.T_world_camera[:3, 3].norm()), 0.1 * radius)
    finest = float(camera.pixel_angle().amin()) * away / 20
    return camera.depth(reference_distance(sdf, rays, meet_sphere(rays, radius), min(SMALLEST_STEP, finest)))


def measure(cases: Iterable[Case], repeats: int, said: Callable[[str], object] = str) -> list[tuple[Row, Buffers]]:
    """Runs all cases in turn; a row's time is its median."""
    cases = list(cases)
    results = in_turn({case.strategy: case.render for case in cases}, repeats, said)
    return [(_row(case, *results[case.strategy]), results[case.strategy][0]) for case in cases]


def in_turn(
    runs: Mapping[str, Callable[[], Buffers]], repeats: int, said: Callable[[str], object] = str
) -> dict[str, tuple[Buffers, float, int]]:
    """Each once to warm up and then `repeats` times, in turn: the last result, the median time, and of how many runs.

    What takes over a minute runs once. `said` is told what was done.
    """
    results, seconds = {}, {name: [] for name in runs}
    for turn in range(repeats + 1 if repeats > 1 else 1):
        for name, run in runs.items():
            if turn and seconds[name][0] > LONG:
                continue
            results[name], taken = _timed(run)
            seconds[name].append(taken)
            said(f"{name}: {taken:.1f} s")
    timed = {name: times[1:] or times for name, times in seconds.items()}
    return {name: (results[name], median(times), len(times)) for name, times in timed.items()}


@torch.no_grad()
def _timed(run: Callable[[], Buffers]) -> tuple[Buffers, float]:
    began = time.perf_counter()
    buffers = run()
    if buffers.trace.distance.is_cuda:
        torch.cuda.synchronize()
    return buffers, time.perf_counter() - began


def _row(case: Case, buffers: Buffers, seconds: float, runs: int) -> Row:
    trace, errors = buffers.trace, depth_errors(buffers.depth, case.truth)
    if not len(errors):
        raise ValueError("the view shows nothing of this shape; there is nothing to measure")
    return Row(
        strategy=case.strategy,
        queries=round(trace.total_evaluations / case.share),
        setup_queries=trace.setup_evaluations,
        per_pixel=trace.total_evaluations / max(int(torch.isfinite(case.truth).sum()), 1),
        seconds=seconds / case.share,
        runs=runs,
        hits=round(int(buffers.mask.sum()) / case.share),
        iou=iou(buffers.mask, torch.isfinite(case.truth)),
        depth_mean=float(errors.mean()),
        depth_p99=float(errors.quantile(0.99)) if len(errors) < 1 << 24 else float("nan"),
        depth_max=float(errors.max()),
        outliers=round(int((errors > OUTLIER).sum()) / case.share),
        share=case.share,
    )
