"""Charts of the tables' pages: series of values over x."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from distrace.report.charts import PALETTE, as_html, blank_chart, plain
from distrace.report.page import Html

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def growth(series: Mapping[str, Mapping[float, float]], x_label: str, y_label: str) -> Html:
    """Returns values over x on logarithmic axes, with a tick at each x."""
    chart, axes = _lines(series)
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    axes.set_xticks(sorted({x for points in series.values() for x in points}), minor=False)
    axes.minorticks_off()
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    return as_html(chart)


def courses(series: Mapping[str, Mapping[float, float]], x_label: str, y_label: str) -> Html:
    """Returns values over x on logarithmic axes, with a mark at the end of each curve."""
    chart, axes = _lines(series, markevery=[-1])
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    return as_html(chart)


def steps_chart(series: Mapping[str, Mapping[str, float]], x_label: str, y_label: str) -> Html:
    """Returns values over named steps; the axis starts at zero."""
    chart, axes = _lines(series)
    axes.set(xlabel=x_label, ylabel=y_label, ylim=(0, None))
    return as_html(chart)


def _lines(series: Mapping[str, Mapping[Any, float]], **style: Any) -> "tuple[Figure, Axes]":
    """Returns a chart of each series over its x, with a legend below."""
    chart, axes = blank_chart("both")
    for i, (name, points) in enumerate(series.items()):
        colour = PALETTE[i % len(PALETTE)]
        axes.plot(list(points), list(points.values()), "o-", label=plain(name), color=colour, **style)
    chart.legend(loc="outside lower left", ncols=2, frameon=False)
    return chart, axes
