"""Cost of the default tracer against the size of image and network, and the number of views and shapes."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import torch
from torch import Tensor

from distrace.benchmarks.measuring import in_turn, poster_view
from distrace.camera import Camera
from distrace.checkpoints.codes import named_code
from distrace.checkpoints.model import Model, load_model
from distrace.fields.base import SDF
from distrace.fields.batch import BatchField
from distrace.movie import filmed, turntable
from distrace.render import STRATEGIES, Buffers, render
from experiments.costs.counting import Operations, recorded
from experiments.fields.untrained import ball

BOTH = ("fast", "coarse_to_fine")
MEASURED = (1024, 2048)  # pixels along each side, for which memory is measured
SIZES = (64, 128, 256, 512, 1024, 2048)  # pixels along each side
NETWORKS = ((4, 128), (4, 256), (8, 256), (8, 512))  # layers × width
VIEWS = (1, 2, 4, 8, 16)
SHAPES = (1, 8, 32)
COUNT = 29  # of rows
Runs = dict[str, Callable[[], list[Buffers]]]
Device = torch.device | str


@dataclass(frozen=True)
class GrowthRow:
    """The cost of one image, or of several images together. Times are medians, of runs in turn."""

    axis: str
    value: str
    strategy: str
    visible: int
    queries: int
    per_pixel: float
    operations: int  # of PyTorch
    seconds: float
    runs: int


def by_size(sdf: SDF, repeats: int, device: Device = "cpu") -> Iterator[GrowthRow]:
    """Yields `fast` and `coarse_to_fine` on the poster's view; the latter up to 512 pixels, where it takes a minute."""
    for size in SIZES:
        strategies = BOTH if size <= 512 else BOTH[:1]
        yield from _rows("pixels", f"{size}", _runs(sdf, [poster_view(size).to(device)], strategies), repeats)


def by_network(repeats: int, device: Device = "cpu") -> Iterator[GrowthRow]:
    """Yields untrained networks whose surface is about a sphere."""
    for layers, width in NETWORKS:
        runs = _runs(ball(layers, width, device), [poster_view(256).to(device)], BOTH)
        yield from _rows("network", f"{layers} × {width}", runs, repeats)


def by_views(sdf: SDF, repeats: int, device: Device = "cpu") -> Iterator[GrowthRow]:
    """Yields views around a shape, which share the occupancy of the first."""
    for count in VIEWS:
        view = poster_view(256).to(device)
        cameras = turntable(view, count) if count > 1 else [view]
        yield from _rows("views", f"{count}", _runs(sdf, cameras, BOTH[:1]), repeats)


def by_shapes(model: Model, repeats: int) -> Iterator[GrowthRow]:
    """Yields several shapes in one call, at 64 × 64 pixels each, and the network evaluations of that call alone."""
    for count in (count for count in SHAPES if count <= len(model.codes)):
        field = model.field(model.codes[:count])
        view = poster_view(64).to(model.codes.device)
        poses = view.T_world_camera.expand(count, -1, -1)
        camera = replace(view, T_world_camera=poses, intrinsics=view.intrinsics.expand(count, -1, -1))
        with recorded() as calls:
            buffers = render(field, camera)
        runs = _runs(field, [camera], BOTH[:1]) | {"its evaluations": partial(_repeat, calls, [buffers])}
        yield from _rows("shapes", f"{count}", runs, repeats)


def _repeat(calls: list[partial[Tensor]], views: list[Buffers]) -> list[Buffers]:
    for call in calls:
        call()
    return views


def _runs(sdf: SDF | BatchField, cameras: list[Camera], strategies: tuple[str, ...]) -> Runs:
    """Returns a function for each strategy that renders the views; all views reuse the first one's occupancy."""

    def run(strategy: str) -> list[Buffers]:
        return list(filmed(sdf, cameras, config=STRATEGIES[strategy]))

    return {strategy: partial(run, strategy) for strategy in strategies}


def _rows(axis: str, value: str, runs: Runs, repeats: int) -> Iterator[GrowthRow]:
    counted: dict[str, tuple[int, int, int]] = {}

    def run(name: str) -> Buffers:
        if name in counted:
            return runs[name]()[-1]
        with Operations() as operations:  # in the warm-up run only, since counting takes time
            views = runs[name]()
        visible = sum(int(view.mask.sum()) for view in views)
        queries = sum(view.trace.total_evaluations for view in views)
        counted[name] = (visible, queries, operations.count)
        return views[-1]

    for name, (_, seconds, times) in in_turn({name: partial(run, name) for name in runs}, repeats).items():
        visible, queries, operations = counted[name]
        yield GrowthRow(axis, value, name, visible, queries, queries / max(visible, 1), operations, seconds, times)


def peak_memory(model: str, code: str, size: int) -> float:
    """Returns the MiB that rendering the poster's view adds to the process; it uses a process of its own."""
    with get_context("spawn").Pool(1) as pool:
        return pool.apply(_peak, (model, code, size))


def _peak(name: str, code: str, size: int) -> float:
    model = load_model(name)
    field = model.field(named_code(model, code))
    with torch.no_grad():
        render(field, poster_view(32))
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = _memory("VmRSS")
        _ = render(field, poster_view(size)).depth
    return _memory("VmHWM") - before


def _memory(name: str) -> float:
    """Returns a value of Linux's `/proc/self/status`, in MiB."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[name].split()[0]) / 1024
