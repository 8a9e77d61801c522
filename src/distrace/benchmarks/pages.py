"""Pages of `bench trace` and `bench gradients`: tables, charts, and maps of evaluations and errors."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from distrace import shading
from distrace.benchmarks.derivatives import RatioRow, Timing
from distrace.benchmarks.measuring import OUTLIER, Row
from distrace.render import Buffers
from distrace.report.charts import bars
from distrace.report.page import Html, figure, page, paragraph, ramp, row, section, short, table
from distrace.shading import Picture

MAPPED = ("coarse_to_fine", "fast", "fast_next")
MOST_QUERIES = 20.0  # the strongest colour
DOUBLINGS = 3.0  # of the ratio, at the strongest colour
ENLARGED = 4  # × the size of the maps of ratios


def trace_page(model: str, measured: Sequence[tuple[Row, Buffers]], truths: Sequence[np.ndarray]) -> str:
    """Returns the page of one view: cost and errors of each strategy, and where in the image they lie."""
    rows = [line for line, _ in measured]
    sampled = next((f" naive: extrapolated from {line.share:.2%} of its rays." for line in rows if line.share < 1), "")
    mapped = [
        (line.strategy, buffers, truth)
        for (line, buffers), truth in zip(measured, truths, strict=True)
        if line.strategy in MAPPED
    ]
    return page(
        f"Tracing {model}",
        f"One view, runs in turn in one process. An outlier is a depth off by more than {OUTLIER:g} radii.{sampled}",
        [
            section("What does each strategy cost?", table(*cells(rows))),
            section("Queries", bars({line.strategy: line.queries for line in rows}, "network evaluations")),
            section("Time", bars({line.strategy: line.seconds for line in rows}, "seconds")),
            section(
                "Which pixels take most queries?",
                row(*(figure(query_map(buffers), name) for name, buffers, _ in mapped)),
                _scale("none", f"{MOST_QUERIES:.0f} evaluations or more", 0.5),
            ),
            section(
                "Which depths are off?",
                row(*(figure(error_map(buffers, truth), name) for name, buffers, truth in mapped)),
                _scale(f"too near by {OUTLIER:g}", f"too far by {OUTLIER:g}", 0.0),
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
    both = np.isfinite(depth) & np.isfinite(truth)
    picture = shading.error_picture(np.where(both, depth - np.where(both, truth, 0), np.nan), OUTLIER)
    picture[np.isfinite(depth) != np.isfinite(truth)] = 0
    return picture


def gradients_page(rows: Sequence[RatioRow], ratios: Sequence[np.ndarray], timings: Sequence[Timing]) -> str:
    """Returns the page of `bench gradients`: derivatives against differences, and the time of a backward pass."""
    maps: dict[str, list[Picture]] = {}
    for line, ratio in zip(rows, ratios, strict=True):
        maps.setdefault(f"{line.field} by {line.parameter}", []).append(ratio_map(ratio))
    methods = ", ".join(dict.fromkeys(line.method for line in rows))
    pictures = [figure(shading.side_by_side(by_method), f"{name}: {methods}") for name, by_method in maps.items()]
    scale = _scale(f"1 / {2**DOUBLINGS:.0f} or less, or of the wrong sign", f"{2**DOUBLINGS:.0f} times or more", 0.0)
    return page(
        "Gradients",
        "Derivatives of depth at each pixel against central differences in float64: exact ones, and DIST's.",
        [
            section("How large are the errors?", table(*cells(rows))),
            section("Which pixels are off? Ratio of derivative to difference", scale, *pictures),
            section("How long does a backward pass take?", table(*cells(timings))),
        ],
    )


def ratio_map(ratio: np.ndarray) -> Picture:
    """Returns ratios as colours: grey is right, red too large, blue too small, white has none."""
    doublings = np.log2(np.where(ratio > 0, ratio, np.where(np.isnan(ratio), np.nan, 2**-DOUBLINGS)))
    return shading.error_picture(doublings, DOUBLINGS).repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def cells(rows: Sequence[Any]) -> tuple[list[str], list[list[str]]]:
    """Returns header and lines of a table of dataclasses or mappings, with short numbers; `share` is left out."""
    lines = [dict(line) if isinstance(line, Mapping) else asdict(line) for line in rows]
    names = [name for name in lines[0] if name != "share"]
    return [name.replace("_", " ") for name in names], [[short(line[name]) for name in names] for line in lines]


def _scale(first: str, last: str, start: float) -> Html:
    return ramp(first, last, shading.error_picture(np.linspace(2 * start - 1, 1, 64)[None], 1.0))
