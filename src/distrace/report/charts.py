"""Charts of a page, as SVG in the colour of the page's text."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distrace.files import written
from distrace.optional import require
from distrace.report.page import Html

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PALETTE = ("#4477aa", "#ee7733", "#228833", "#cc3377", "#8866cc", "#0099aa", "#aa8811", "#888888")
THEME_INK = "#010203"  # replaced by the colour of the page's text
STYLE: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "distrace", "font.size": 10.5} | dict.fromkeys(
    ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), THEME_INK
)


def curves(
    series: Mapping[str, Sequence[float]], x_label: str, y_label: str, log: bool, emphasised: str | None = None
) -> Html:
    """Returns curves over the steps 1, 2, …; one of them may be emphasised."""
    chart, axes = _empty("y")
    for i, (name, values) in enumerate(series.items()):
        leads = emphasised in (None, name)
        (line,) = axes.plot(range(1, len(values) + 1), values, label=_plain(name))
        line.set(color=PALETTE[i % len(PALETTE)], linewidth=1.8 if leads else 1.2, alpha=1.0 if leads else 0.7)
        line.set_zorder(3 if leads else 2)
    if series:
        axes.legend(frameon=False)
    axes.set(xlabel=x_label, ylabel=y_label, yscale="log" if log else "linear")
    return _drawn(chart)


def growth(series: Mapping[str, Mapping[float, float]], x_label: str, y_label: str) -> Html:
    """Returns values over x on logarithmic axes, with a tick at each x."""
    chart, axes = _lines(series)
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    axes.set_xticks(sorted({x for points in series.values() for x in points}), minor=False)
    axes.minorticks_off()
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
    return _drawn(chart)


def courses(series: Mapping[str, Mapping[float, float]], x_label: str, y_label: str) -> Html:
    """Returns values over x on logarithmic axes, with a mark at the end of each curve."""
    chart, axes = _lines(series, markevery=[-1])
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    return _drawn(chart)


def save_course(path: Path, values: Sequence[float], every: int, x_label: str, y_label: str) -> None:
    """Writes a PNG of values, one for `every` steps each, on logarithmic axes."""
    require("a chart", "matplotlib")
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"font.size": 10.5}):
        chart = Figure(figsize=(7.4, 3.6), layout="constrained")
        axes = chart.add_subplot()
        axes.plot(range(every, every * len(values) + 1, every), values, color=PALETTE[0])
        axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
        axes.grid(which="both", alpha=0.12)
        with written(path) as file:
            chart.savefig(file, format="png", dpi=110)


def steps_chart(series: Mapping[str, Mapping[str, float]], x_label: str, y_label: str) -> Html:
    """Returns values over named steps; the axis starts at zero."""
    chart, axes = _lines(series)
    axes.set(xlabel=x_label, ylabel=y_label, ylim=(0, None))
    return _drawn(chart)


def bars(values: Mapping[str, float], x_label: str) -> Html:
    """Returns one bar for each name, the first on top, on a logarithmic axis, with its value."""
    chart, axes = _empty("x", height=0.42 * len(values) + 0.9)
    names = [_plain(name) for name in values]
    drawn = axes.barh(names, list(values.values()), color=PALETTE[0], height=0.62)
    axes.bar_label(drawn, [f" {value:,.3g}" if value < 1000 else f" {value:,.0f}" for value in values.values()])
    axes.set(xlabel=x_label, xscale="log", xlim=(min(values.values()) / 2, max(values.values()) * 4))
    axes.invert_yaxis()
    return _drawn(chart)


def _lines(series: Mapping[str, Mapping[Any, float]], **style: Any) -> "tuple[Figure, Axes]":
    """Returns a chart of each series over its x, with a legend below."""
    chart, axes = _empty("both")
    for i, (name, points) in enumerate(series.items()):
        colour = PALETTE[i % len(PALETTE)]
        axes.plot(list(points), list(points.values()), "o-", label=_plain(name), color=colour, **style)
    chart.legend(loc="outside lower left", ncols=2, frameon=False)
    return chart, axes


def _empty(grid: str, height: float = 3.6) -> "tuple[Figure, Axes]":
    require("a chart", "matplotlib")
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        chart = Figure(figsize=(7.4, height), layout="constrained", facecolor="none")
        axes = chart.add_subplot(facecolor="none")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis=grid, color=THEME_INK, alpha=0.12, linewidth=0.6)  # pyright: ignore[reportArgumentType]
    return chart, axes


def _drawn(chart: "Figure") -> Html:
    from matplotlib import rc_context

    drawn = io.StringIO()
    with rc_context(STYLE):
        chart.savefig(drawn, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = drawn.getvalue().partition("<svg ")[2].replace(THEME_INK, "currentColor")
    return Html('<div class="chart"><svg ' + re.sub(r'<g id="[^"]*">', "<g>", svg) + "</div>")


def _plain(name: str) -> str:
    return name.replace("$", r"\$")
