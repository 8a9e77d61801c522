"""Pages of what tracing and fitting cost: tables and charts."""

from collections.abc import Sequence

from distrace.benchmarks.pages import cells
from distrace.report.charts import courses, growth
from distrace.report.page import Html, page, section, table
from experiments.costs.fields import FieldRow
from experiments.costs.growth import GrowthRow
from experiments.costs.solvers import Curve, SolverRow


def fields_page(rows: Sequence[FieldRow]) -> str:
    """Which pixels strategies get wrong on fields that are not what sphere tracing assumes."""
    names = list(dict.fromkeys(row.strategy for row in rows))
    by_field = {row.field: {} for row in rows}
    for line in rows:
        by_field[line.field][line.strategy] = f"{line.wrong - line.admitted} + {line.admitted}"
    visible = {row.field: row.visible for row in rows}
    lines = [[field, f"{visible[field]}", *(by.get(name, "–") for name in names)] for field, by in by_field.items()]
    lead = "Pixels that are wrong (hit or not, or depth by more than a thousandth): unnoticed + said to be EXHAUSTED."
    return page(
        "Fields that break the assumption", lead, [section("Wrong pixels", table(["field", "visible", *names], lines))]
    )


def growth_page(rows: Sequence[GrowthRow]) -> str:
    """Queries and time as images, networks and the number of views grow."""
    parts: list[Html] = []
    for axis in dict.fromkeys(row.axis for row in rows):
        some = [row for row in rows if row.axis == axis]
        parts.append(section(axis.capitalize(), table(*cells(some)), *(_charts(some) if axis != "network" else ())))
    return page(
        "How the cost grows", "The poster's view; 256 × 256 pixels for views and networks, 64 × 64 for shapes.", parts
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
    return page("Adam and Levenberg–Marquardt", lead, [section("Table", table(*cells(rows))), *parts])


def _charts(rows: Sequence[GrowthRow]) -> list[Html]:
    names = dict.fromkeys(row.strategy for row in rows)
    series = [
        {name: {float(row.value): getattr(row, key) for row in rows if row.strategy == name} for name in names}
        for key in ("queries", "seconds")
    ]
    return [growth(lines, rows[0].axis, label) for lines, label in zip(series, ("network evaluations", "seconds"))]
