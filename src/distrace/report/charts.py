"""Charts of a page, as SVG in the colour of the page's text."""

import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from distrace.files import atomic_write
from distrace.optional import require
from distrace.report.page import Html, paragraph, section

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
    chart, axes = blank_chart("y")
    for i, (name, values) in enumerate(series.items()):
        leads = emphasised in (None, name)
        (line,) = axes.plot(range(1, len(values) + 1), values, label=plain(name))
        line.set(color=PALETTE[i % len(PALETTE)], linewidth=1.8 if leads else 1.2, alpha=1.0 if leads else 0.7)
        line.set_zorder(3 if leads else 2)
    if series:
        axes.legend(frameon=False)
    axes.set(xlabel=x_label, ylabel=y_label, yscale="log" if log else "linear")
    return as_html(chart)


def starts_section(losses: Mapping[str, Sequence[float]], chosen: str | None) -> Html:
    """Returns the section of a page with the loss of each start; the chosen one is bold."""
    drawn = curves(losses, "iteration", "loss", all(value > 0 for curve in losses.values() for value in curve), chosen)
    if chosen is None or len(losses) < 2:
        return section("Loss", drawn)
    about = (
        f"Each curve is one start of the fit. Bold: {chosen}, the start with the least loss at the end; it is shown."
    )
    return section("Loss", paragraph(about), drawn)


def plot_history(path: Path, values: Sequence[float], every: int, x_label: str, y_label: str) -> None:
    """Writes a PNG of values, one for `every` steps each, on logarithmic axes."""
    chart, axes = blank_chart("both")
    axes.plot(range(every, every * len(values) + 1, every), values, color=PALETTE[0])
    axes.set(xlabel=x_label, ylabel=y_label, xscale="log", yscale="log")
    with atomic_write(path) as file:
        chart.savefig(file, format="png", dpi=110, facecolor="white")


def blank_chart(grid: str) -> "tuple[Figure, Axes]":
    """Returns a chart without curves; `grid` is the axis of its grid: x, y or both."""
    require("a chart", "matplotlib")
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        chart = Figure(figsize=(7.4, 3.6), layout="constrained", facecolor="none")
        axes = chart.add_subplot(facecolor="none")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis=grid, color=THEME_INK, alpha=0.12, linewidth=0.6)  # pyright: ignore[reportArgumentType]
    return chart, axes


def as_html(chart: "Figure") -> Html:
    """Returns a chart as SVG, its ink in the colour of the page's text."""
    from matplotlib import rc_context

    written_svg = io.StringIO()
    with rc_context(STYLE):
        chart.savefig(written_svg, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = written_svg.getvalue().partition("<svg ")[2].replace(THEME_INK, "currentColor")
    return Html('<div class="chart"><svg ' + re.sub(r'<g id="[^"]*">', "<g>", svg) + "</div>")


def plain(name: str) -> str:
    """Returns a name in which Matplotlib sees no formula."""
    return name.replace("$", r"\$")
