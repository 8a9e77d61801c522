"""Pages of `bench`: tables, charts, maps of evaluations and errors, and the worst views as pictures."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from distrace import shading, surface
from distrace.benchmarks import agreement
from distrace.benchmarks.agreement import Measured, Summary, ViewRow
from distrace.benchmarks.backward import Timing
from distrace.benchmarks.measuring import OUTLIER, Row
from distrace.benchmarks.random_views import Mixture
from distrace.render import Buffers
from distrace.report.charts import bars
from distrace.report.completion_page import View as Rendered
from distrace.report.page import Html, error_ramp, figure, key, page, paragraph, row, section, short, table
from distrace.shading import Picture

MAPPED = ("coarse_to_fine", "fast", "fast_next")
MOST_QUERIES = 20.0  # the strongest colour
SIDE = 256  # pixels; smaller pictures of views are enlarged towards it
MARGIN = 4  # pixels around the object
COLOURS = {"both": shading.AGREE, "missed": shading.MISSING, "added": shading.EXTRA}
BAR = (
    f"A view passes with an IoU of at least {agreement.LEAST_IOU}, no connected loss above {agreement.LARGEST_LOSS}"
    f" pixels, and at most one depth in {agreement.OFF_EACH} off by more than {OUTLIER:g}. An object of fewer than"
    f" {agreement.SMALL} pixels needs at most {agreement.WRONG} wrong pixels instead of the IoU. A model passes if all"
    f" of its views do, with a median IoU of at least {agreement.LEAST_MEDIAN}."
)


def trace_page(model: str, measured: Sequence[tuple[Row, Buffers]], truths: Sequence[np.ndarray]) -> str:
    """Returns the page of one view: cost and errors of each strategy, and where in the image they lie."""
    rows = [line for line, _ in measured]
    sampled = next((f" naive: extrapolated from {line.share:.2%} of its rays." for line in rows if line.share < 1), "")
    evaluations = []
    errors = []
    for (line, buffers), truth in zip(measured, truths, strict=True):
        if line.strategy in MAPPED:
            evaluations.append(figure(query_map(buffers), line.strategy))
            errors.append(figure(error_map(buffers, truth), line.strategy))
    return page(
        f"Tracing {model}",
        f"One view, runs in turn in one process. An outlier is a depth off by more than {OUTLIER:g} radii.{sampled}",
        [
            section("What does each strategy cost?", rows_table(rows)),
            section("Queries", bars({line.strategy: line.queries for line in rows}, "network evaluations")),
            section("Time", bars({line.strategy: line.seconds for line in rows}, "seconds")),
            section(
                "Which pixels take most queries?",
                row(*evaluations),
                error_ramp("none", f"{MOST_QUERIES:.0f} evaluations or more", 0.0),
            ),
            section(
                "Which depths are off?",
                row(*errors),
                error_ramp(f"too near by {OUTLIER:g}", f"too far by {OUTLIER:g}"),
                paragraph("Black: pixels that only one of the two images hits."),
            ),
        ],
    )


def query_map(buffers: Buffers) -> Picture:
    """Returns the evaluations of each ray as colours; white where there are none."""
    evaluations = buffers.trace.evaluations.float()
    return shading.error_picture(evaluations.masked_fill(evaluations == 0, float("nan")), MOST_QUERIES)


def error_map(buffers: Buffers, truth: np.ndarray) -> Picture:
    """Returns the errors of depth as colours; black where only one image has a hit."""
    depth = buffers.depth.detach().cpu().numpy()
    picture = shading.error_picture(shading.difference(depth, truth), OUTLIER)
    picture[np.isfinite(depth) != np.isfinite(truth)] = 0
    return picture


def gradients_page(rows: Sequence[Mapping[str, object]], timings: Sequence[Timing]) -> str:
    """Returns the page of `bench gradients`: derivatives against differences, and the time of a backward pass."""
    return page(
        "Gradients",
        "Derivatives of an image at each pixel against central differences.",
        [
            section("How large are the errors?", rows_table(rows)),
            section("How long does a backward pass take?", rows_table(timings)),
        ],
    )


def views_page(
    strategy: str, seed: int, found: Sequence[Summary], rows: Sequence[ViewRow], worst: Sequence[Measured]
) -> str:
    """Returns the page of `bench views`: a summary of each model, the worst views, and every view that fails."""
    failing = [_line(line) for line in rows if line.fails]
    pictures = [
        row(*(figure(picture, words) for picture, words in zip(pictures_of(measured), _captions(measured.row))))
        for measured in worst
    ]
    return page(
        "Random views against the reference",
        f"{len(rows) - len(failing)} of {len(rows)} random views pass. Strategy: {strategy}; seed: {seed}.",
        [
            section("Which models pass?", rows_table(found), paragraph(BAR)),
            section("Which views are worst?", key(COLOURS), *pictures),
            section("Which views fail?", rows_table(failing) if failing else paragraph("None.")),
        ],
    )


def pictures_of(measured: Measured) -> list[Picture]:
    """Returns the shaded reference, the shaded rendering, and the difference of their masks.

    The pictures are cropped to the object in either, and enlarged where it is small.
    """
    buffers = measured.buffers
    visible = torch.isfinite(measured.truth)
    rays = buffers.rays.detach()
    distance = measured.truth / buffers.cosines
    normal = torch.zeros_like(rays.directions)
    with torch.no_grad():
        normal[visible] = surface.normals(measured.view.sdf, rays[visible].at(distance[visible]))
        rendered = Rendered.of(buffers).shaded
    reference = shading.shaded_picture(normal, visible, rays.directions)
    crop = _crop(visible | buffers.mask)
    times = max(1, SIDE // max(visible[crop].shape))
    pictures = (reference, rendered, shading.mask_comparison(visible, buffers.mask))
    return [picture[crop].repeat(times, 0).repeat(times, 1) for picture in pictures]


def _crop(mask: Bool[Tensor, "height width"]) -> tuple[slice, slice]:
    """Returns the rows and columns of a mask with a margin; all of them for an empty mask."""
    pixels = mask.nonzero()
    if not len(pixels):
        return slice(None), slice(None)
    (top, left), (bottom, right) = pixels.amin(0).tolist(), pixels.amax(0).tolist()
    return slice(max(0, top - MARGIN), bottom + MARGIN + 1), slice(max(0, left - MARGIN), right + MARGIN + 1)


def described(code: int | Mixture | None) -> str:
    """Returns a code in words: its number, or the parts of a mixture."""
    if isinstance(code, Mixture):
        return f"{1 - code.share:.2f} · {code.first} + {code.share:.2f} · {code.second}"
    return "" if code is None else str(code)


def _captions(line: ViewRow) -> tuple[str, str, str]:
    shot = line.camera
    camera = f"{shot.azimuth:.0f}°, {shot.elevation:.0f}°, distance {shot.distance:.2f}, {shot.focal_mm:.0f} mm"
    reference = f"{line.model} {described(line.code)}: {camera}, {shot.size} × {shot.size}, {line.pixels:,} pixels"
    wrong = f"{line.missed:,} missed, {line.added:,} added, IoU {line.iou:.4f}, {line.off:,} depths off"
    return reference, f"{line.strategy}: {line.per_pixel:.1f} evaluations a pixel", wrong


def _line(line: ViewRow) -> dict[str, object]:
    shot = line.camera
    numbers = ("pixels", "missed", "added", "iou", "largest_loss", "off", "exhausted")
    return {
        "model": line.model,
        "code": described(line.code),
        "azimuth": f"{shot.azimuth:.1f}",
        "elevation": f"{shot.elevation:.1f}",
        "distance": f"{shot.distance:.2f}",
        "focal mm": f"{shot.focal_mm:.0f}",
        "size": str(shot.size),
        **{name: getattr(line, name) for name in numbers},
        "fails": ", ".join(line.fails),
    }


def rows_table(rows: Sequence[Any]) -> Html:
    """Returns a table of dataclasses or mappings, with short numbers; `share` is left out."""
    lines = [dict(line) if isinstance(line, Mapping) else asdict(line) for line in rows]
    names = [name for name in lines[0] if name != "share"]
    return table([name.replace("_", " ") for name in names], [[short(line[name]) for name in names] for line in lines])
