"""Random views of models, rendered and compared with a cautious march of every ray.

A view passes the bar if few pixels are wrong, no connected part of the object is lost, and few depths are off. A
model passes if all of its views do, and the median view is nearly perfect.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from statistics import median
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from torch import Tensor

from distrace.benchmarks.measuring import OUTLIER, in_turn, reference_depth
from distrace.benchmarks.random_views import Mixture, Shot, View
from distrace.files import save_arrays
from distrace.metrics import depth_errors, iou
from distrace.render import Buffers, Config, render
from distrace.tracing.sphere_tracing import Outcome

LEAST_IOU = 0.995  # of a view …
SMALL, WRONG = 1600, 8  # … but an object of fewer pixels may have so many wrong ones instead
LARGEST_LOSS = 8  # pixels of the largest connected part that is missed
OFF_EACH = 5000  # one depth in so many may be off by more than OUTLIER, and one in every view
LEAST_MEDIAN = 0.9995  # IoU of a model's median view


@dataclass(frozen=True)
class ViewRow:
    """How far a rendering is from the reference. Counts are of pixels, but `evaluations` of the field."""

    model: str
    code: int | Mixture | None
    camera: Shot
    strategy: str
    pixels: int  # of the reference
    missed: int
    added: int
    iou: float
    largest_loss: int  # of the connected parts of the missed pixels
    off: int  # of the pixels of both, in depth, by more than 1e-3
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
    view: View
    buffers: Buffers
    truth: Float[Tensor, "size size"]  # depth by the reference


@dataclass(frozen=True)
class Summary:
    """All views of one model. `off_per_5000` is the number of depths that are off per 5,000 pixels of both masks."""

    model: str
    views: int
    worst_iou: float
    median_iou: float
    largest_loss: int
    off_per_5000: float
    failing: int  # views below the bar
    per_pixel: float  # the median over views
    seconds: float  # the median over views
    bar: str  # "met", or what is not


def measure_view(
    view: View, strategy: str = "default", config: Config | None = None, kept: Path | None = None
) -> Measured:
    """Renders a view by a configuration, or as `render` does by default, and compares it with the reference.

    The reference is read from the folder `kept`, or computed and kept there. Raises `ValueError` for a file in its
    place that is none.
    """
    camera = view.camera()

    def rendered() -> Buffers:
        return render(view.sdf, camera) if config is None else render(view.sdf, camera, config=config)

    buffers, seconds, _ = in_turn({strategy: rendered}, 1)[strategy]
    truth, took = _reference(view, kept)
    return Measured(_row(view, strategy, buffers, truth, seconds, took), view, buffers, truth)


def _reference(view: View, kept: Path | None) -> tuple[Float[Tensor, "size size"], float]:
    """The depth that a cautious march finds, and the seconds that it took."""
    path = kept and kept / f"{_digest(view)}.npz"
    if path and path.exists():
        try:
            with np.load(path) as content:
                depth, took = (torch.from_numpy(content[name]) for name in ("depth", "seconds"))
        except (OSError, ValueError, KeyError, BadZipFile) as error:
            raise ValueError(f"{path} holds no reference ({error}); delete it, and it is computed anew") from None
        return depth.to(view.device), float(took)
    began = time.perf_counter()
    depth = reference_depth(lambda points: view.sdf(points) / view.steepest, view.camera())
    took = time.perf_counter() - began
    if path:
        save_arrays(path, {"depth": depth, "seconds": torch.tensor(took)})
    return depth, took


def _digest(view: View) -> str:
    """Tells views apart: by their camera, and by the values of their field at some points."""
    points = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, (64, 3))).float().to(view.device)
    with torch.no_grad():
        values = view.sdf(points).cpu().numpy().round(5)
    return sha256(f"{view.shot} {view.steepest} {values.tolist()}".encode()).hexdigest()[:24]


def largest_part(mask: Bool[np.ndarray, "height width"]) -> int:
    """Pixels of the largest part that is connected, also by corners; 0 of an empty mask."""
    labels = np.zeros(mask.shape, dtype=np.int32)
    ndimage.label(mask, structure=np.ones((3, 3)), output=labels)
    return int(np.bincount(labels.ravel())[1:].max(initial=0))


def summaries(rows: Sequence[ViewRow]) -> list[Summary]:
    """One for each model, in the order of the rows."""
    names = dict.fromkeys(row.model for row in rows)
    return [_summary(name, [row for row in rows if row.model == name]) for name in names]


def badness(measured: Measured) -> tuple[bool, float, int]:
    """What the worst views are the greatest by: a missed bar first, then the share of wrong pixels."""
    row = measured.row
    return bool(row.fails), 1 - row.iou, row.largest_loss


def _row(
    view: View, strategy: str, buffers: Buffers, truth: Float[Tensor, "h w"], seconds: float, reference_seconds: float
) -> ViewRow:
    trace, true = buffers.trace, torch.isfinite(truth)
    with torch.no_grad():
        off = int((depth_errors(buffers.depth, truth) > OUTLIER).sum())
    row = ViewRow(
        model=view.model,
        code=view.code,
        camera=view.shot,
        strategy=strategy,
        pixels=int(true.sum()),
        missed=int((true & ~buffers.mask).sum()),
        added=int((buffers.mask & ~true).sum()),
        iou=iou(buffers.mask, true),
        largest_loss=largest_part((true & ~buffers.mask).cpu().numpy()),
        off=off,
        evaluations=trace.total_evaluations,
        setup_evaluations=trace.setup_evaluations,
        per_pixel=trace.total_evaluations / max(int(true.sum()), 1),
        exhausted=int((trace.outcome == Outcome.EXHAUSTED).sum()),
        seconds=seconds,
        reference_seconds=reference_seconds,
        fails=(),
    )
    return replace(row, fails=_fails(row))


def _fails(row: ViewRow) -> tuple[str, ...]:
    small = row.pixels < SMALL
    reached = {
        "wrong pixels": not small or row.missed + row.added <= WRONG,
        "IoU": small or row.iou >= LEAST_IOU,
        "connected loss": row.largest_loss <= LARGEST_LOSS,
        "depth": row.off <= max(1, row.pixels / OFF_EACH),
    }
    return tuple(name for name, met in reached.items() if not met)


def _summary(model: str, rows: Sequence[ViewRow]) -> Summary:
    both = sum(row.pixels - row.missed for row in rows)
    middle, failing = median(row.iou for row in rows), sum(bool(row.fails) for row in rows)
    fails = dict.fromkeys(name for row in rows for name in row.fails)
    missed = [*fails, *(["median IoU"] if middle < LEAST_MEDIAN else [])]
    return Summary(
        model=model,
        views=len(rows),
        worst_iou=min(row.iou for row in rows),
        median_iou=middle,
        largest_loss=max(row.largest_loss for row in rows),
        off_per_5000=OFF_EACH * sum(row.off for row in rows) / max(both, 1),
        failing=failing,
        per_pixel=median(row.per_pixel for row in rows),
        seconds=median(row.seconds for row in rows),
        bar="fails: " + ", ".join(missed) if missed else "met",
    )
