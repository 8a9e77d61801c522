"""Pages of the benchmarks: tables, charts, and maps of where queries and errors are."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np

from distrace import shading
from distrace.evaluation.backward import Timing
from distrace.evaluation.bench import Row
from distrace.evaluation.fields import FieldRow
from distrace.evaluation.gradients import RatioRow
from distrace.evaluation.growth import GrowthRow
from distrace.evaluation.solvers import Curve, SolverRow
from distrace.pages.charts import bars, courses, growth
from distrace.pages.page import Html, figure, page, paragraph, ramp, section, short, table
from distrace.pages.page import row as beside
from distrace.render import Buffers
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
            section("Table", table(*_cells(rows))),
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


def fields_page(rows: Sequence[FieldRow]) -> str:
    """Which pixels strategies get wrong on fields that are not what sphere tracing assumes."""
    names = list(dict.fromkeys(row.strategy for row in rows))
    by_field = {row.field: {} for row in rows}
    for line in rows:
        by_field[line.field][line.strategy] = f"{line.wrong - line.admitted} + {line.admitted}"
    visible = {row.field: row.visible for row in rows}
    cells = [[field, f"{visible[field]}", *(by.get(name, "–") for name in names)] for field, by in by_field.items()]
    lead = "Pixels that are wrong (hit or not, or depth by more than a thousandth): unnoticed + said to be EXHAUSTED."
    return page(
        "Fields that break the assumption", lead, [section("Wrong pixels", table(["field", "visible", *names], cells))]
    )


def growth_page(rows: Sequence[GrowthRow]) -> str:
    """Queries and time as images, networks and the number of views grow."""
    parts: list[Html] = []
    for axis in dict.fromkeys(row.axis for row in rows):
        some = [row for row in rows if row.axis == axis]
        parts.append(section(axis.capitalize(), table(*_cells(some)), *(_charts(some) if axis != "network" else ())))
    return page(
        "How the cost grows", "The poster's view; 256 × 256 pixels for views and networks, 64 × 64 for shapes.", parts
    )


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
            section("Table", table(*_cells(rows))),
            section("Ratio of derivative to difference", scale, *pictures),
            section("Time of a depth image and of its gradient", table(*_cells(timings))),
        ],
    )


def solvers_page(measured: Sequence[tuple[SolverRow, Curve]]) -> str:
    """How the loss falls with time, of each shape and number of depths by each solver."""
    charts: dict[str, dict[str, dict[float, float]]] = {}
    for row, curve in measured:
        seen = f"{row.shape}, {row.points or 'all'} depths"
        charts.setdefault(seen, {})[row.solver] = dict(zip(curve.seconds, curve.losses, strict=True))
    lead = (
        "Adam's loss, on rays that both are measured on and neither is told, from the mean shape on. Seconds leave"
        " the measuring out; reached: when the loss was no more than Adam's last; ratio: that over Adam's seconds."
    )
    parts = [section(seen, courses(series, "seconds", "loss")) for seen, series in charts.items()]
    rows = [row for row, _ in measured]
    return page("Adam and Levenberg–Marquardt", lead, [section("Table", table(*_cells(rows))), *parts])


def ratio_map(ratio: np.ndarray) -> Picture:
    """Grey is right, red too large, blue too small; white where there is nothing to compare."""
    doublings = np.log2(np.where(ratio > 0, ratio, np.where(np.isnan(ratio), np.nan, 2**-DOUBLINGS)))
    return shading.error_picture(doublings, DOUBLINGS).repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def _charts(rows: Sequence[GrowthRow]) -> list[Html]:
    names = dict.fromkeys(row.strategy for row in rows)
    series = [
        {name: {float(row.value): getattr(row, key) for row in rows if row.strategy == name} for name in names}
        for key in ("queries", "seconds")
    ]
    return [growth(lines, rows[0].axis, label) for lines, label in zip(series, ("network evaluations", "seconds"))]


def _cells(
    rows: Sequence[Row] | Sequence[GrowthRow] | Sequence[RatioRow] | Sequence[Timing] | Sequence[SolverRow],
) -> tuple[list[str], list[list[str]]]:
    """Header and lines; counts with separators, small numbers in as few digits as tell."""
    lines = [{key: value for key, value in asdict(line).items() if key != "share"} for line in rows]
    return list(lines[0]), [[short(value) for value in line.values()] for line in lines]


def _scale(first: str, last: str, begins: float) -> Html:
    colours = shading.error_picture(np.linspace(2 * begins - 1, 1, 64)[None], 1.0)
    return ramp(first, last, colours)
