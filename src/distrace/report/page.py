"""Pages of one self-contained HTML file: text, pictures and tables.

Functions escape the plain text that they take. They return `Html`, which other functions insert unchanged.
"""

import base64
import gzip
import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, NewType

import numpy as np
from jaxtyping import UInt8

from distrace.shading import Colour, Picture, error_picture

if TYPE_CHECKING:
    from distrace.fitting.judge import Verdict

Html = NewType("Html", str)

NUMBER = re.compile(r"–?|[-+−]?[\d.,]+(e[-+]?\d+)?\s?%?")  # an empty cell and a dash count as numbers


def page(title: str, lead: str, sections: Sequence[Html], origin: str = "") -> str:
    """Returns a document. Its policy forbids the browser to load anything; a page with a 3-D view includes Plotly.

    `origin` is a line under the lead: the model, the command and the version.
    """
    body = "\n".join(sections)
    scripts = ""
    if '<div class="scene"' in body:
        from plotly.offline import get_plotlyjs

        packed = base64.b64encode(gzip.compress(get_plotlyjs().encode(), mtime=0)).decode()
        scripts = f'<script id="plotly" type="text/plain">{packed}</script>\n<script>{resource("scenes.js")}</script>'
    template = Template(resource("page.html"))
    made_by = f'<p class="origin">{escape(origin)}</p>' if origin else ""
    return template.substitute(title=escape(title), lead=escape(lead), origin=made_by, body=body, scripts=scripts)


def resource(name: str) -> str:
    """Returns a file of this folder."""
    return Path(__file__).with_name(name).read_text(encoding="utf-8")


def section(heading: str, *blocks: Html) -> Html:
    return Html(f"<section><h2>{escape(heading)}</h2>\n" + "\n".join(blocks) + "</section>")


def verdict_banner(verdict: "Verdict") -> Html:
    """Returns a verdict as a line that nobody overlooks."""
    text = escape(f"{verdict.name.capitalize()}: {verdict.reason}.")
    return Html(f'<div class="banner {verdict.name}" role="status">{text}</div>')


def paragraph(text: str) -> Html:
    return Html(f"<p>{escape(text)}</p>")


def figure(picture: Picture, caption: str) -> Html:
    """Returns a picture with its caption; a tiny picture is enlarged without smoothing."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, format="PNG", optimize=True)
    source = "data:image/png;base64," + base64.b64encode(encoded.getvalue()).decode()
    height, width = picture.shape[:2]
    size = f'width="{width}" height="{height}"' + (' class="coarse"' if width < 100 else "")
    text = escape(caption)
    return Html(f'<figure><img src="{source}" alt="{text}" {size}><figcaption>{text}</figcaption></figure>')


def row(*figures: Html) -> Html:
    return Html('<div class="row">' + "".join(figures) + "</div>")


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> Html:
    """Returns a table; columns of numbers are right-aligned, and an empty header is omitted."""
    numeric = [all(NUMBER.fullmatch(cell) for cell in column) for column in zip(*rows)] or [False] * len(header)
    head = f"<thead>{_line('th', header, numeric)}</thead>" if any(header) else ""
    lines = "".join(_line("td", line, numeric) for line in rows)
    return Html(f'<div class="scroll"><table>{head}<tbody>{lines}</tbody></table></div>')


def facts_section(facts: Mapping[str, str]) -> Html:
    return section("Facts", table(("", ""), list(facts.items())))


def short(value: object) -> str:
    """Returns a value as text: counts with separators, other numbers with five digits.

    >>> short(12345), short(0.00123), short(1.5)
    ('12,345', '1.2e-03', '1.5')
    """
    if isinstance(value, float):
        return f"{value:.1e}" if 0 < abs(value) < 0.01 else f"{value:.5g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def key(colours: Mapping[str, Colour]) -> Html:
    """Returns the legend of a picture's colours."""
    entries = (f'<span><i style="background:rgb{colour}"></i>{escape(name)}</span>' for name, colour in colours.items())
    return Html('<div class="key">' + "".join(entries) + "</div>")


def ramp(first: str, last: str, colours: UInt8[np.ndarray, "1 n 3"]) -> Html:
    """Returns the legend of a continuous range of colours."""
    stops = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in colours[0].tolist())
    style = f"background:linear-gradient(90deg, {stops})"
    return Html(
        f'<div class="key"><span>{escape(first)}<i class="ramp" style="{style}"></i>{escape(last)}</span></div>'
    )


def error_ramp(first: str, last: str, start: float = -1.0) -> Html:
    """Returns the legend of `shading.error_picture`; `start` is 0 where no difference is negative."""
    return ramp(first, last, error_picture(np.linspace(start, 1, 64)[None], 1.0))


def _line(tag: str, cells: Sequence[str], numeric: Sequence[bool]) -> str:
    kinds = (' class="number"' if right else "" for right in numeric)
    return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(cells, kinds)) + "</tr>"
