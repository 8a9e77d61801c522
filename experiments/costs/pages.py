"""Pages of the costs of tracing and fitting: tables and charts."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from distrace import shading
from distrace.report.page import Html, error_ramp, figure, page, section, short, table
from distrace.shading import Picture
from experiments.charts import courses, growth
from experiments.costs.fields import FieldRow
from experiments.costs.gradients import RatioRow
from experiments.costs.growth import GrowthRow
from experiments.costs.solvers import Curve, SolverRow

DOUBLINGS = 3.0  # of the ratio, at the strongest colour
ENLARGED = 4  # × the size of the maps of ratios


def fields_page(rows: Sequence[FieldRow]) -> str:
    """Returns the page of wrong pixels on fields that break what sphere tracing assumes."""
    names = list(dict.fromkeys(row.strategy for row in rows))
    by_field = {row.field: {} for row in rows}
    for line in rows:
        by_field[line.field][line.strategy] = f"{line.wrong - line.admitted} + {line.admitted}"
    visible = {row.field: row.visible for row in rows}
    lines = [[field, f"{visible[field]}", *(by.get(name, "–") for name in names)] for field, by in by_field.items()]
    lead = "Wrong pixels: missed, added, or off in depth by more than 0.001. Unreported + reported as EXHAUSTED."
    return page(
        "Fields that break the assumption", lead, [section("Wrong pixels", table(["field", "visible", *names], lines))]
    )


def growth_page(rows: Sequence[GrowthRow]) -> str:
    """Returns the page of queries and time against the size of image and network, and the number of views."""
    parts: list[Html] = []
    for axis in dict.fromkeys(row.axis for row in rows):
        of_axis = [row for row in rows if row.axis == axis]
        charts = _charts(of_axis) if axis != "network" else []
        parts.append(section(axis.capitalize(), rows_table(of_axis), *charts))
    return page(
        "How the cost grows", "The poster's view; 256 × 256 pixels for views and networks, 64 × 64 for shapes.", parts
    )


def solvers_page(measured: Sequence[tuple[SolverRow, Curve]]) -> str:
    """Returns the page of the loss against time, by shape, number of depths and solver."""
    charts: dict[str, dict[str, dict[float, float]]] = {}
    for row, curve in measured:
        observed = f"{row.shape}, {row.points or 'all'} depths"
        charts.setdefault(observed, {})[row.solver] = dict(zip(curve.seconds, curve.losses, strict=True))
    lead = (
        "Adam's loss on held-out rays, starting from the mean shape. Seconds exclude the measurement. reached: seconds"
        " until the loss of Adam's last step; ratio: reached / Adam's seconds."
    )
    parts = [section(observed, courses(series, "seconds", "loss")) for observed, series in charts.items()]
    rows = [row for row, _ in measured]
    return page("Adam and Levenberg–Marquardt", lead, [section("Table", rows_table(rows)), *parts])


def gradients_page(rows: Sequence[RatioRow], ratios: Sequence[np.ndarray]) -> str:
    """Returns the page of exact derivatives and DIST's against differences, with maps of their ratio."""
    maps: dict[str, list[Picture]] = {}
    for line, ratio in zip(rows, ratios, strict=True):
        maps.setdefault(f"{line.field} by {line.parameter}", []).append(ratio_map(ratio))
    methods = ", ".join(dict.fromkeys(line.method for line in rows))
    pictures = [figure(shading.side_by_side(by_method), f"{name}: {methods}") for name, by_method in maps.items()]
    scale = error_ramp(f"1 / {2**DOUBLINGS:.0f} or less, or of the wrong sign", f"{2**DOUBLINGS:.0f} times or more")
    return page(
        "Gradients",
        "Derivatives of depth at each pixel against central differences in float64: exact ones, and DIST's.",
        [
            section("How large are the errors?", rows_table(rows)),
            section("Which pixels are off? Ratio of derivative to difference", scale, *pictures),
        ],
    )


def ratio_map(ratio: np.ndarray) -> Picture:
    """Returns ratios as colours: grey is right, red too large, blue too small, white has none."""
    doublings = np.log2(np.where(ratio > 0, ratio, np.where(np.isnan(ratio), np.nan, 2**-DOUBLINGS)))
    return shading.error_picture(doublings, DOUBLINGS).repeat(ENLARGED, 0).repeat(ENLARGED, 1)


def rows_table(rows: Sequence[Any]) -> Html:
    """Returns a table of dataclasses, with short numbers; `share` is left out."""
    lines = [asdict(line) for line in rows]
    names = [name for name in lines[0] if name != "share"]
    return table([name.replace("_", " ") for name in names], [[short(line[name]) for name in names] for line in lines])


def _charts(rows: Sequence[GrowthRow]) -> list[Html]:
    names = dict.fromkeys(row.strategy for row in rows)
    series = [
        {name: {float(row.value): getattr(row, key) for row in rows if row.strategy == name} for name in names}
        for key in ("queries", "seconds")
    ]
    return [growth(lines, rows[0].axis, label) for lines, label in zip(series, ("network evaluations", "seconds"))]
