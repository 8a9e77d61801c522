"""Pages of one HTML file: pictures, tables, curves and 3-D views, with all that they need inside.

Functions take plain text and escape it; what they return, `Html`, goes into others as it is.
"""

import base64
import io
import math
import re
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any, NewType

import numpy as np
import plotly.graph_objects as go
import trimesh
from jaxtyping import Float, Int, UInt8
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image
from plotly.offline import get_plotlyjs

from distrace.shading import Colour, Picture

Html = NewType("Html", str)

MOST_FACES = 60_000
MOST_POINTS = 8_000
PALETTE = ("#4477aa", "#ee7733", "#228833", "#cc3377", "#8866cc", "#0099aa", "#aa8811", "#888888")
THEME_INK = "#010203"  # stands in a chart for the colour of the page's text
NUMBER = re.compile(r"–?|[-+−]?[\d.,]+(e[-+]?\d+)?\s?%?")  # or none
CHART: dict[Any, Any] = {"svg.fonttype": "none", "svg.hashsalt": "distrace", "font.size": 10.5} | dict.fromkeys(
    ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), THEME_INK
)

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
    """A whole document. Its policy forbids the browser to load anything; plotly is inside where there is a 3-D view."""
    body = "\n".join(sections)
    scripts = (
        f"<script>{get_plotlyjs()}</script>\n<script>{SHOW_SCENES}</script>" if '<div class="scene"' in body else ""
    )
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


def paragraph(text: str) -> Html:
    return Html(f"<p>{escape(text)}</p>")


def figure(picture: Picture, caption: str) -> Html:
    """A picture with its caption; one of few pixels is shown with its pixels."""
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
    """A table, its columns of numbers to the right; without a head where the header is empty."""
    numeric = [all(NUMBER.fullmatch(cell) for cell in column) for column in zip(*rows)] or [False] * len(header)
    head = f"<thead>{_line('th', header, numeric)}</thead>" if any(header) else ""
    lines = "".join(_line("td", line, numeric) for line in rows)
    return Html(f'<div class="scroll"><table>{head}<tbody>{lines}</tbody></table></div>')


def key(colours: Mapping[str, Colour]) -> Html:
    """What the colours of a picture mean."""
    entries = (f'<span><i style="background:rgb{colour}"></i>{escape(name)}</span>' for name, colour in colours.items())
    return Html('<div class="key">' + "".join(entries) + "</div>")


def ramp(first: str, last: str, colours: UInt8[np.ndarray, "1 n 3"]) -> Html:
    """What the colours of a picture mean where they change evenly."""
    stops = ", ".join(f"rgb({r}, {g}, {b})" for r, g, b in colours[0].tolist())
    style = f"background:linear-gradient(90deg, {stops})"
    return Html(
        f'<div class="key"><span>{escape(first)}<i class="ramp" style="{style}"></i>{escape(last)}</span></div>'
    )


def curves(
    series: Mapping[str, Sequence[float]], x_label: str, y_label: str, log: bool, emphasised: str | None = None
) -> Html:
    """Curves over the steps 1, 2, …, in the colours of the page; the others step back from an emphasised one."""
    drawn = io.StringIO()
    with rc_context(CHART):
        chart = _chart(series, emphasised)
        chart.axes[0].set(xlabel=x_label, ylabel=y_label, yscale="log" if log else "linear")
        chart.savefig(drawn, format="svg", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type")))
    svg = drawn.getvalue().partition("<svg ")[2].replace(THEME_INK, "currentColor")
    return Html('<div class="chart"><svg ' + re.sub(r'<g id="[^"]*">', "<g>", svg) + "</div>")


def scene(meshes: Mapping[str, trimesh.Trimesh], clouds: Mapping[str, np.ndarray]) -> Html:
    """A view to turn, y up. Each name stands in the legend, which hides and shows it."""
    surfaces = [_surface(name, mesh) for name, mesh in meshes.items()]
    points = [
        _cloud(name, cloud, colour) for (name, cloud), colour in zip(clouds.items(), ("#e2701f", "#2c68be", *PALETTE))
    ]
    hidden = dict(visible=False)
    camera = dict(eye=dict(x=1.4, y=0.8, z=0.6))
    layout = go.Layout(
        template="none",
        margin=dict(l=0, r=0, t=0, b=0),
        paper_bgcolor="rgba(0,0,0,0)",
        modebar=dict(bgcolor="rgba(0,0,0,0)", color="#98a2af", activecolor="#4477aa"),
        legend=dict(x=0.015, y=0.985, itemsizing="constant", bgcolor="rgba(0,0,0,0)"),
        scene=dict(xaxis=hidden, yaxis=hidden, zaxis=hidden, aspectmode="data", camera=camera, dragmode="turntable"),
    )
    content = str(go.Figure([*surfaces, *points], layout).to_json()).replace("<", "\\u003c")
    return Html(f'<script type="application/json">{content}</script><div class="scene"></div>')


def _line(tag: str, cells: Sequence[str], numeric: Sequence[bool]) -> str:
    kinds = (' class="number"' if right else "" for right in numeric)
    return "<tr>" + "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(cells, kinds)) + "</tr>"


def _chart(series: Mapping[str, Sequence[float]], emphasised: str | None) -> Figure:
    chart = Figure(figsize=(7.4, 3.6), layout="constrained", facecolor="none")
    axes = chart.add_subplot(facecolor="none")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y", color=THEME_INK, alpha=0.12, linewidth=0.6)
    for i, (name, values) in enumerate(series.items()):
        leads = emphasised in (None, name)
        (line,) = axes.plot(range(1, len(values) + 1), values, label=name.replace("$", r"\$"))
        line.set(color=PALETTE[i % len(PALETTE)], linewidth=1.8 if leads else 1.2, alpha=1.0 if leads else 0.7)
        line.set_zorder(3 if leads else 2)
    if series:
        axes.legend(frameon=False)
    return chart


def _surface(name: str, mesh: trimesh.Trimesh) -> go.Mesh3d:
    vertices, faces = _decimated(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    light = dict(ambient=0.32, diffuse=0.66, specular=0.1, roughness=0.8, fresnel=0.05)
    return go.Mesh3d(
        **_coordinates(vertices),
        **dict(zip("ijk", faces.astype(np.int32).T)),
        name=escape(name),
        color="#cfc3b5",
        lighting=light,
        lightposition=dict(x=3, y=-2, z=6),
        showlegend=True,
        hoverinfo="skip",
    )


def _cloud(name: str, points: np.ndarray, colour: str) -> go.Scatter3d:
    some = points[:: max(1, math.ceil(len(points) / MOST_POINTS))]
    dot = dict(size=1.8 if len(some) > 1000 else 4, color=colour)
    return go.Scatter3d(**_coordinates(some), mode="markers", marker=dot, name=escape(name), hoverinfo="skip")


def _coordinates(points: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
    """World z, x, y as plotly's x, y, z: its turntable turns around its z alone."""
    return dict(zip("xyz", points[:, [2, 0, 1]].astype(np.float32).T))


def _decimated(
    vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]:
    """A surface of at most `MOST_FACES`: vertices of one cell of a grid become one (Rossignac and Borrel, 1993)."""
    width = np.ptp(vertices, axis=0).max() / 160 if len(faces) > MOST_FACES else 0.0
    corners, triangles = vertices, faces
    while len(triangles) > MOST_FACES:
        _, cell = np.unique(np.floor(vertices / width).astype(int), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        corners = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / np.bincount(cell)[:, None]
        triangles = cell[faces]
        triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(1)]
        width *= 1.1
    return corners, triangles
