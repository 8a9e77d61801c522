"""Measures strategies of tracing on one view against a cautious reference."""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from statistics import median

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.metrics import depth_errors, iou
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.render import Buffers

OUTLIER = 1e-3  # radii: a depth with a larger error is an outlier
LONG = 60.0  # seconds; a longer run is not repeated
SMALLEST_STEP = 5e-5  # radii
LARGEST_STEP = 0.02  # radii


@dataclass(frozen=True)
class Row:
    """The cost and the errors of one strategy. `queries` include `setup_queries`.

    `share` is below 1 where only a sample of the rays was traced; counts and times are then extrapolated.
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
    """A strategy, a function that renders by it, and the true depth."""

    strategy: str
    render: Callable[[], Buffers]
    truth: Float[Tensor, "*batch"]
    share: float = 1.0  # of all rays that enter the sphere


def poster_view(size: int = 512) -> Camera:
    """Returns the view of all tables; at 512 × 512, 122,172 of its rays enter the unit sphere.

    The published table has 122,166: some rays graze the sphere within the rounding of float32.
    """
    return Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=size, width=size)


@torch.no_grad()
def reference_distance(
    sdf: SDF, rays: Rays, bounds: Bounds, smallest: float = SMALLEST_STEP
) -> Float[Tensor, "*batch"]:
    """Returns the distance of the first surface on each ray, `inf` where there is none.

    The march steps by half the value, at most LARGEST_STEP, until the sign changes. Bisection then finds the root to
    1e-6. Steps are never below `smallest`, so that a march along a surface ends. A ray that starts in the solid sees
    nothing, as for every strategy (`Outcome.INSIDE`).
    """
    rays = rays.flat()
    near = bounds.near.reshape(-1)
    far = bounds.far.reshape(-1)
    position = near.clone()
    inside = torch.full_like(near, torch.inf)
    outside = torch.full_like(near, -torch.inf)  # the last sample before the sign changes
    active = bounds.meets.reshape(-1).nonzero()[:, 0]
    while len(active):
        value = sdf(rays[active].at(position[active]))
        crossed = value < 0
        inside[active[crossed]] = position[active[crossed]]
        active = active[~crossed]
        last = position[active]
        outside[active] = last
        ahead = last + (0.5 * value[~crossed]).clamp(smallest, LARGEST_STEP)
        position[active] = ahead.maximum(last.nextafter(far[active]))  # a step may vanish in rounding
        active = active[position[active] < far[active]]
    return _bisected(sdf, rays, outside, inside).reshape(bounds.near.shape)


def _bisected(sdf: SDF, rays: Rays, outside: Float[Tensor, "n"], inside: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Returns the root between two samples at most LARGEST_STEP apart; `inf` where one of them is not finite."""
    bracketed = (torch.isfinite(inside) & torch.isfinite(outside)).nonzero()[:, 0]
    low = outside[bracketed]
    high = inside[bracketed]
    for _ in range(15):  # 0.02 / 2^15 < 1e-6
        middle = (low + high) / 2
        solid = sdf(rays[bracketed].at(middle)) < 0
        low = torch.where(solid, low, middle)
        high = torch.where(solid, middle, high)
    return torch.full_like(inside, torch.inf).index_put((bracketed,), (low + high) / 2)


def reference_depth(sdf: SDF, camera: Camera) -> Float[Tensor, "height width"]:
    """Returns the depth by `reference_distance`, with steps down to a twentieth of a pixel at the sphere's middle."""
    rays = camera.rays()
    distance = max(float(camera.T_world_camera[:3, 3].norm()), 0.1)
    finest = float(camera.pixel_angle().amin()) * distance / 20
    return camera.depth(reference_distance(sdf, rays, meet_sphere(rays, 1.0), min(SMALLEST_STEP, finest)))


def measure(
    cases: Iterable[Case], repeats: int, report: Callable[[str], object] = lambda text: None
) -> list[tuple[Row, Buffers]]:
    """Runs all cases in turn; a row's time is its median. `report` gets a line after each run.

    Raises `ValueError` for a view that shows nothing.
    """
    cases = list(cases)
    results = in_turn({case.strategy: case.render for case in cases}, repeats, report)
    return [(_row(case, *results[case.strategy]), results[case.strategy][0]) for case in cases]


def in_turn(
    runs: Mapping[str, Callable[[], Buffers]], repeats: int, report: Callable[[str], object] = lambda text: None
) -> dict[str, tuple[Buffers, float, int]]:
    """Returns the last result of each run, its median time in seconds, and the number of timed runs.

    Each runs once to warm up and then `repeats` times, in turn. A run of more than LONG seconds is not repeated.
    """
    results: dict[str, Buffers] = {}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for turn in range(repeats + 1 if repeats > 1 else 1):
        for name, run in runs.items():
            if turn and seconds[name][0] > LONG:
                continue
            results[name], duration = timed(run)
            seconds[name].append(duration)
            report(f"{name}: {duration:.1f} s")
    counted = {name: durations[1:] or durations for name, durations in seconds.items()}
    return {name: (results[name], median(durations), len(durations)) for name, durations in counted.items()}


@torch.no_grad()
def timed(run: Callable[[], Buffers]) -> tuple[Buffers, float]:
    """Returns the result of a run, and its seconds."""
    start = time.perf_counter()
    buffers = run()
    if buffers.trace.distance.is_cuda:
        torch.cuda.synchronize()
    return buffers, time.perf_counter() - start


def _row(case: Case, buffers: Buffers, seconds: float, runs: int) -> Row:
    trace = buffers.trace
    errors = depth_errors(buffers.depth, case.truth)
    if not len(errors):
        raise ValueError("the view shows nothing of this shape; there is nothing to measure")
    visible = torch.isfinite(case.truth)
    return Row(
        strategy=case.strategy,
        queries=round(trace.total_evaluations / case.share),
        setup_queries=trace.setup_evaluations,
        per_pixel=trace.total_evaluations / max(int(visible.sum()), 1),
        seconds=seconds / case.share,
        runs=runs,
        hits=round(int(buffers.mask.sum()) / case.share),
        iou=iou(buffers.mask, visible),
        depth_mean=float(errors.mean()),
        depth_p99=float(errors.quantile(0.99)) if len(errors) < 1 << 24 else float("nan"),
        depth_max=float(errors.max()),
        outliers=round(int((errors > OUTLIER).sum()) / case.share),
        share=case.share,
    )
