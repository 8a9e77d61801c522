"""Compares renderings of random views with a cautious march of every ray.

A view passes if few pixels are wrong, no connected part of the object is lost, and few depths are off. A model passes
if all of its views pass and the median view is nearly perfect.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.benchmarks.measuring import OUTLIER, reference_depth, timed
from distrace.benchmarks.random_views import Mixture, RandomView, Shot
from distrace.metrics import depth_errors, iou
from distrace.render import Buffers, Config, render
from distrace.tracing.sphere_tracing import Outcome

Reference = tuple[Float[Tensor, "size size"], float]
"""The depth by the reference, and its seconds."""

LEAST_IOU = 0.995  # of a view
SMALL_OBJECT = 1600  # pixels: a smaller object is judged by WRONG instead of by IoU
WRONG = 8  # pixels missed or added
LARGEST_LOSS = 8  # pixels of the largest connected part that is missed
OFF_EACH = 5000  # one depth in so many may be an outlier, and one in every view
LEAST_MEDIAN = 0.9995  # IoU of a model's median view


@dataclass(frozen=True)
class ViewRow:
    """The difference of a rendering from the reference. Counts are pixels; `evaluations` are of the field."""

    model: str
    code: int | Mixture | None
    camera: Shot
    strategy: str
    pixels: int  # of the reference
    missed: int
    added: int
    iou: float
    largest_loss: int  # of the connected parts of the missed pixels
    off: int  # pixels of both whose depths differ by more than 1e-3
    evaluations: int
    setup_evaluations: int
    per_pixel: float  # evaluations per pixel of the reference
    exhausted: int
    seconds: float  # of the rendering
    reference_seconds: float
    fails: tuple[str, ...]  # names of the bars that are missed


@dataclass(frozen=True)
class Measured:
    """A row, and the two images that it compares."""

    row: ViewRow
    view: RandomView
    buffers: Buffers
    truth: Float[Tensor, "size size"]  # depth by the reference


@dataclass(frozen=True)
class Summary:
    """All views of one model. `off_per_5000` counts outliers per 5,000 pixels of both masks."""

    model: str
    views: int
    worst_iou: float
    median_iou: float
    largest_loss: int
    off_per_5000: float
    failing: int  # views below the bar
    per_pixel: float  # the median over views
    seconds: float  # the median over views
    bar: str  # "met", or the bars that fail


def reference_of(view: RandomView) -> Reference:
    """Computes the reference of a view."""
    start = time.perf_counter()
    depth = reference_depth(lambda points: view.sdf(points) / view.lipschitz, view.camera())
    return depth, time.perf_counter() - start


def measure_view(
    view: RandomView,
    strategy: str = "default",
    config: Config | None = None,
    reference: Callable[[RandomView], Reference] = reference_of,
) -> Measured:
    """Renders a view by a configuration, or by the default of `render`, and compares it with the reference."""
    options: dict[str, Any] = {} if config is None else {"config": config}
    buffers, seconds = timed(lambda: render(view.sdf, view.camera(), **options))
    truth, reference_seconds = reference(view)
    return Measured(_row(view, strategy, buffers, truth, seconds, reference_seconds), view, buffers, truth)


def largest_part(mask: Bool[np.ndarray, "height width"]) -> int:
    """Returns the pixels of the largest part connected by edges or corners; 0 for an empty mask."""
    from skimage.measure import label

    parts = np.asarray(label(mask, connectivity=2))
    return int(np.bincount(parts.ravel())[1:].max(initial=0))


def summaries(rows: Sequence[ViewRow]) -> list[Summary]:
    """Returns one summary for each model, in the order of the rows."""
    names = dict.fromkeys(row.model for row in rows)
    return [_summary(name, [row for row in rows if row.model == name]) for name in names]


def badness(measured: Measured) -> tuple[bool, float, int]:
    """Returns the key that sorts views from best to worst: failed bars first, then the share of wrong pixels."""
    row = measured.row
    return bool(row.fails), 1 - row.iou, row.largest_loss


def _row(
    view: RandomView,
    strategy: str,
    buffers: Buffers,
    truth: Float[Tensor, "h w"],
    seconds: float,
    reference_seconds: float,
) -> ViewRow:
    trace = buffers.trace
    visible = torch.isfinite(truth)
    missed = visible & ~buffers.mask
    with torch.no_grad():
        errors = depth_errors(buffers.depth, truth)
    row = ViewRow(
        model=view.model,
        code=view.code,
        camera=view.shot,
        strategy=strategy,
        pixels=int(visible.sum()),
        missed=int(missed.sum()),
        added=int((buffers.mask & ~visible).sum()),
        iou=iou(buffers.mask, visible),
        largest_loss=largest_part(missed.cpu().numpy()),
        off=int((errors > OUTLIER).sum()),
        evaluations=trace.total_evaluations,
        setup_evaluations=trace.setup_evaluations,
        per_pixel=trace.total_evaluations / max(int(visible.sum()), 1),
        exhausted=int((trace.outcome == Outcome.EXHAUSTED).sum()),
        seconds=seconds,
        reference_seconds=reference_seconds,
        fails=(),
    )
    return replace(row, fails=_fails(row))


def _fails(row: ViewRow) -> tuple[str, ...]:
    small = row.pixels < SMALL_OBJECT
    met = {
        "wrong pixels": not small or row.missed + row.added <= WRONG,
        "IoU": small or row.iou >= LEAST_IOU,
        "connected loss": row.largest_loss <= LARGEST_LOSS,
        "depth": row.off <= max(1, row.pixels / OFF_EACH),
    }
    return tuple(name for name, passes in met.items() if not passes)


def _summary(model: str, rows: Sequence[ViewRow]) -> Summary:
    both = sum(row.pixels - row.missed for row in rows)
    median_iou = median(row.iou for row in rows)
    fails = [*dict.fromkeys(name for row in rows for name in row.fails)]
    if median_iou < LEAST_MEDIAN:
        fails.append("median IoU")
    return Summary(
        model=model,
        views=len(rows),
        worst_iou=min(row.iou for row in rows),
        median_iou=median_iou,
        largest_loss=max(row.largest_loss for row in rows),
        off_per_5000=OFF_EACH * sum(row.off for row in rows) / max(both, 1),
        failing=sum(bool(row.fails) for row in rows),
        per_pixel=median(row.per_pixel for row in rows),
        seconds=median(row.seconds for row in rows),
        bar="fails: " + ", ".join(fails) if fails else "met",
    )
