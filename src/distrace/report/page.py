"""Pages of one self-contained HTML file: text, pictures and tables.

Functions escape the plain text that they take. They return `Html`, which other functions insert unchanged.
"""

import base64
import io
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import NewType

import numpy as np
from jaxtyping import UInt8

from distrace.shading import Colour, Picture

Html = NewType("Html", str)

NUMBER = re.compile(r"–?|[-+−]?[\d.,]+(e[-+]?\d+)?\s?%?")  # an empty cell and a dash count as numbers

STYLE = """
:root { color-scheme: light dark; --ink: #1c2128; --soft: #616b78; --paper: #fbfbfa; --card: #fff; --line: #e3e5e8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e7eb; --soft: #98a2af; --paper: #15181c; --card: #1d2126; --line: #333a42; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.55 Inter, system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 56px 24px 80px; }
h1 { font-size: clamp(1.7rem, 4vw, 2.3rem); line-height: 1.15; letter-spacing: -.02em; margin: 0 0 12px; }
h2 { font-size: 1.2rem; letter-spacing: -.01em; margin: 0 0 6px; }
p { max-width: 72ch; text-wrap: pretty; margin: 0 0 14px; color: var(--soft); }
header p { font-size: 1.1rem; margin: 0; }
section { margin-top: 44px; padding-top: 26px; border-top: 1px solid var(--line); }
.row { display: grid; gap: 20px; margin: 18px 0; grid-template-columns: repeat(3, 1fr); }
@media (max-width: 640px) { .row { gap: 12px; grid-template-columns: repeat(2, 1fr); } }
figure { margin: 0; }
figure img { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line);
  border-radius: 10px; }
figure img.coarse { image-rendering: pixelated; }
figcaption { margin-top: 8px; font-size: .875rem; line-height: 1.4; color: var(--soft); }
.scroll { overflow-x: auto; margin: 18px 0; }
table { border-collapse: collapse; font-size: .94rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 8px 28px 8px 0; border-bottom: 1px solid var(--line); }
th { font-weight: 600; color: var(--soft); font-size: .85rem; white-space: nowrap; }
.number { text-align: right; white-space: nowrap; }
.key { display: flex; flex-wrap: wrap; gap: 6px 22px; font-size: .875rem; color: var(--soft); margin: 10px 0; }
.key i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin-right: 8px; }
.key i.ramp { width: 140px; margin: 0 8px; }
.chart { max-width: 820px; margin: 18px 0; }
.chart svg { display: block; width: 100%; height: auto; }
.chart text { font-family: inherit !important; }
.banner { margin-top: 28px; padding: 14px 18px; border-radius: 10px; border: 1px solid; font-weight: 600; }
.banner.trusted { color: #1b5e36; background: #e5f4ea; border-color: #9fd0b1; }
.banner.doubtful { color: #6b4a00; background: #fff4d6; border-color: #e6c564; }
.banner.failed { color: #8a1c1c; background: #fde7e7; border-color: #e7a3a3; }
.scene { height: min(600px, 85vw, 80vh); margin: 18px 0; border: 1px solid var(--line); border-radius: 10px;
  background: var(--card); overflow: hidden; }
"""

SHOW_SCENES = """
const ink = () => getComputedStyle(document.body).color;
for (const view of document.querySelectorAll(".scene")) {
  const { data, layout } = JSON.parse(view.previousElementSibling.textContent);
  layout.font = { color: ink(), family: getComputedStyle(document.body).fontFamily, size: 13 };
  Plotly.newPlot(view, data, layout, { displaylogo: false, displayModeBar: true, responsive: true, scrollZoom: false,
    modeBarButtons: [["tableRotation", "pan3d", "zoom3d", "resetCameraDefault3d", "toImage"]] });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () =>
    Plotly.relayout(view, { "font.color": ink() }));
}
"""


def page(title: str, lead: str, sections: Sequence[Html]) -> str:
    """Returns a document. Its policy forbids the browser to load anything; a page with a 3-D view includes Plotly."""
    body = "\n".join(sections)
    scripts = ""
    if '<div class="scene"' in body:
        from plotly.offline import get_plotlyjs

        scripts = f"<script>{get_plotlyjs()}</script>\n<script>{SHOW_SCENES}</script>"
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
  content="default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; script-src 'unsafe-inline'">
<title>{escape(title)}</title>
<link rel="icon" href="data:,">
<style>{STYLE}</style>
</head>
<body>
<main>
<header><h1>{escape(title)}</h1><p>{escape(lead)}</p></header>
{body}
</main>
{scripts}
</body>
</html>
"""


def section(heading: str, *blocks: Html) -> Html:
    return Html(f"<section><h2>{escape(heading)}</h2>\n" + "\n".join(blocks) + "</section>")


def banner(kind: str, text: str) -> Html:
    """Returns a line that nobody overlooks; `kind` is `trusted`, `doubtful` or `failed`."""
    return Html(f'<div class="banner {kind}" role="status">{escape(text)}</div>')


def paragraph(text: str) -> Html:
    return Html(f"<p>{escape(text)}</p>")


def figure(picture: Picture, caption: str) -> Html:
    """Returns a picture with its caption; a small picture is enlarged without smoothing."""
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, format="PNG", optimize=True)
    source = "data:image/png;base64," + base64.b64encode(encoded.getvalue()).decode()
    height, width = picture.shape[:2]
    size = f'width="{width}" height="{height}"' + (' class="coarse"' if width < 200 else "")
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


def _line(tag: str, cells: Sequence[str], numeric: Sequence[bool]) -> str:
    kinds = (' class="number"' if right else "" for right in numeric)
    return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(cells, kinds)) + "</tr>"
