"""Pages of the benchmarks: tables, charts, and maps of where queries and errors are."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from distrace import shading
from distrace.benchmarks.backward import Timing
from distrace.benchmarks.derivatives import RatioRow
from distrace.benchmarks.measuring import Row
from distrace.render import Buffers
from distrace.report.charts import bars
from distrace.report.page import Html, figure, page, paragraph, ramp, section, short, table
from distrace.report.page import row as beside
from distrace.shading import Picture

MAPPED = ("coarse_to_fine", "fast", "fast_next")
MOST_QUERIES, LARGEST_ERROR = 20.0, 1e-3
DOUBLINGS, ENLARGED = 3.0, 4  # of the maps of ratios


def trace_page(model: str, measured: Sequence[tuple[Row, Buffers]], truths: Sequence[np.ndarray]) -> str:
    """What each strategy cost and missed on the poster's view of a model."""
    rows = [row for row, _ in measured]
    naive = next((f" naive: extrapolated from {row.share:.2%} of its rays." for row in rows if row.share < 1), "")
    maps = [
        (row.strategy, query_map(buffers), error_map(buffers, truth))
        for (row, buffers), truth in zip(measured, truths, strict=True)
        if row.strategy in MAPPED
    ]
    return page(
        f"Tracing {model}",
        "The poster's view, in one process, runs in turn. A pixel off by more than a thousandth is an outlier." + naive,
        [
            section("Table", table(*cells(rows))),
            section("Queries", bars({row.strategy: row.queries for row in rows}, "network evaluations")),
            section("Time", bars({row.strategy: row.seconds for row in rows}, "seconds")),
            section(
                "Where the queries are",
                beside(*(figure(queries, name) for name, queries, _ in maps)),
                _scale("none", f"{MOST_QUERIES:.0f} evaluations or more", 0.5),
            ),
            section(
                "Where depth is off",
                beside(*(figure(errors, name) for name, _, errors in maps)),
                _scale(f"too near by {LARGEST_ERROR}", f"too far by {LARGEST_ERROR}", 0.0),
                paragraph("Pixels that are seen in one image only are black."),
            ),
        ],
    )


def query_map(buffers: Buffers) -> Picture:
    evaluations = buffers.trace.evaluations.float()
    return shading.error_picture(evaluations.masked_fill(evaluations == 0, float("nan")), MOST_QUERIES)


def error_map(buffers: Buffers, truth: np.ndarray) -> Picture:
    depth = buffers.depth.detach().cpu().numpy()
    seen = np.isfinite(depth) & np.isfinite(truth)
    picture = shading.error_picture(np.where(seen, depth - np.where(seen, truth, 0), np.nan), LARGEST_ERROR)
    picture[np.isfinite(depth) != np.isfinite(truth)] = 0
    return picture


def gradients_page(rows: Sequence[RatioRow], ratios: Sequence[np.ndarray], timings: Sequence[Timing]) -> str:
    """How the derivatives of depth relate to finite differences, by each method, and what a backward pass costs."""
    maps: dict[str, list[Picture]] = {}
    for row, ratio in zip(rows, ratios, strict=True):
        maps.setdefault(f"{row.field} by {row.parameter}", []).append(ratio_map(ratio))
    methods = ", ".join(dict.fromkeys(row.method for row in rows))
    pictures = [figure(shading.side_by_side(several), f"{name}: {methods}") for name, several in maps.items()]
    lead = "Derivatives of depth, pixel by pixel, against central differences in float64: exact, and as DIST has them."
    scale = _scale(f"1 / {2**DOUBLINGS:.0f} or less, or of the wrong sign", f"{2**DOUBLINGS:.0f} times or more", 0.0)
    return page(
        "Gradients",
        lead,
        [
            section("Table", table(*cells(rows))),
            section("Ratio of derivative to difference", scale, *pictures),
            section("Time of a depth image and of its gradient", table(*cells(timings))),
        ],
    )


def ratio_map(ratio: np.ndarray) -> Picture:
    """Grey is right, red too large, blue too small; white where there is nothing to compare."""
    doublings = np.log2(np.where(ratio > 0, ratio, np.where(np.isnan(ratio), np.nan, 2**-DOUBLINGS)))
    return shading.error_picture(doublings, DOUBLINGS).repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def cells(rows: Sequence[Any]) -> tuple[list[str], list[list[str]]]:
    """Header and lines; counts with separators, small numbers in as few digits as tell."""
    lines = [{key: value for key, value in asdict(line).items() if key != "share"} for line in rows]
    return list(lines[0]), [[short(value) for value in line.values()] for line in lines]


def _scale(first: str, last: str, begins: float) -> Html:
    colours = shading.error_picture(np.linspace(2 * begins - 1, 1, 64)[None], 1.0)
    return ramp(first, last, colours)
