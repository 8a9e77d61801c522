"""Interactive 3-D views of a page."""

import math
from collections.abc import Collection, Mapping
from html import escape
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from distrace.optional import require
from distrace.report.charts import PALETTE
from distrace.report.page import Html, paragraph, section

if TYPE_CHECKING:
    import plotly.graph_objects as go
    import trimesh

MOST_FACES = 20_000
MOST_POINTS = 8_000
DIRECTION = (1.4, 0.8, 0.6)  # of the eye, in plotly's axes
FIELD_OF_VIEW = math.pi / 4  # plotly's, upright
ASPECT = 1.5  # a little less than pages have
MARGIN = 1.08
TRUE = "True surface"
SURFACE_COLOURS = ("#cfc3b5", "#8fb3d6", *PALETTE)


def space_section(
    meshes: "Mapping[str, trimesh.Trimesh]", clouds: Mapping[str, np.ndarray] = {}, hidden: Collection[str] = ()
) -> Html:
    """Returns the section of a page with `scene`, and how to use it."""
    usage = "Drag to turn; + and −, or Ctrl and the wheel, zoom. A click on a name of the legend hides or shows it."
    return section("In space", paragraph(usage), scene(meshes, clouds, hidden))


def surfaces_section(
    mesh: "trimesh.Trimesh", clouds: Mapping[str, np.ndarray], truth: "trimesh.Trimesh | np.ndarray | None"
) -> Html:
    """Returns the 3-D view of a completed surface; a true mesh is hidden until the legend shows it."""
    meshes = {"Completed surface": mesh}
    if isinstance(truth, np.ndarray):
        return space_section(meshes, {**clouds, "Points of the true surface": truth})
    if truth is None:
        return space_section(meshes, clouds)
    return space_section({**meshes, TRUE: truth}, clouds, hidden=(TRUE,))


def scene(
    meshes: "Mapping[str, trimesh.Trimesh]", clouds: Mapping[str, np.ndarray], hidden: Collection[str] = ()
) -> Html:
    """Returns an interactive view of meshes and clouds, y up; vertices keep their colours.

    The legend lists each name, and hides or shows it; those in `hidden` are hidden at first.
    """
    require("a 3-D view", "plotly")
    import plotly.graph_objects as go

    surfaces = [_surface(name, mesh, colour) for (name, mesh), colour in zip(meshes.items(), cycle(SURFACE_COLOURS))]
    points = [
        _cloud(name, cloud, colour) for (name, cloud), colour in zip(clouds.items(), ("#e2701f", "#2c68be", *PALETTE))
    ]
    for name, trace in zip((*meshes, *clouds), (*surfaces, *points)):
        if name in hidden:
            trace.visible = "legendonly"
    no_axis = dict(visible=False)
    everything = np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes.values()), *clouds.values()])
    camera = dict(eye=dict(zip("xyz", _eye(everything))))
    layout = go.Layout(
        template="none",
        margin=dict(l=0, r=0, t=0, b=0),
        paper_bgcolor="rgba(0,0,0,0)",
        modebar=dict(bgcolor="rgba(0,0,0,0)", color="#98a2af", activecolor="#4477aa"),
        legend=dict(x=0.015, y=0.985, itemsizing="constant", bgcolor="rgba(0,0,0,0)"),
        scene=dict(xaxis=no_axis, yaxis=no_axis, zaxis=no_axis, aspectmode="data", camera=camera, dragmode="turntable"),
    )
    content = str(go.Figure([*surfaces, *points], layout).to_json()).replace("<", "\\u003c")
    return Html(f'<script type="application/json">{content}</script><div class="scene"></div>')


def _eye(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Returns the eye from which the points' box fills the view; Plotly's unit is the geometric mean of its sides."""
    sides = np.ptp(_turned(points), axis=0) if len(points) else np.ones(3)
    sides = np.maximum(sides, 0.01 * max(sides.max(), 1e-9))
    corners = sides / np.prod(sides) ** (1 / 3) * (np.indices((2, 2, 2)).reshape(3, 8).T - 0.5)
    back = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    right = np.cross((0, 0, 1), back) / np.hypot(*back[:2])
    up = np.cross(back, right)
    half = np.maximum(abs(corners @ up), abs(corners @ right) / ASPECT)
    return (corners @ back + MARGIN * half / np.tan(FIELD_OF_VIEW / 2)).max() * back


def _surface(name: str, mesh: "trimesh.Trimesh", colour: str) -> "go.Mesh3d":
    import plotly.graph_objects as go

    vertices, faces = _decimated(np.hstack([mesh.vertices, _own_colours(mesh)]), np.asarray(mesh.faces))
    colours = ["#" + colour.tobytes().hex() for colour in vertices[:, 3:].astype(np.uint8)]
    light = dict(ambient=0.32, diffuse=0.66, specular=0.1, roughness=0.8, fresnel=0.05)
    return go.Mesh3d(
        **_coordinates(vertices[:, :3]),
        **dict(zip("ijk", faces.astype(np.uint16 if len(vertices) <= 1 << 16 else np.int32).T)),
        name=escape(name),
        color=colour,
        vertexcolor=colours if vertices.shape[1] > 3 else None,
        lighting=light,
        lightposition=dict(x=3, y=-2, z=6),
        showlegend=True,
        hoverinfo="skip",
    )


def _own_colours(mesh: "trimesh.Trimesh") -> np.ndarray:
    """Returns red, green and blue of each vertex, or no columns for a mesh without colours."""
    from trimesh.visual import ColorVisuals

    visual = mesh.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        return np.asarray(visual.vertex_colors)[:, :3]
    return np.empty((len(mesh.vertices), 0))


def _cloud(name: str, points: np.ndarray, colour: str) -> "go.Scatter3d":
    import plotly.graph_objects as go

    sparse = points[:: max(1, math.ceil(len(points) / MOST_POINTS))]
    dot = dict(size=1.8 if len(sparse) > 1000 else 4, color=colour)
    return go.Scatter3d(**_coordinates(sparse), mode="markers", marker=dot, name=escape(name), hoverinfo="skip")


def _coordinates(points: Float[np.ndarray, "n 3"]) -> dict[str, np.ndarray]:
    return dict(zip("xyz", _turned(points).astype(np.float32).T))


def _turned(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Returns world z, x, y as Plotly's x, y, z: its turntable turns around z only."""
    return points[:, [2, 0, 1]]


def _decimated(
    vertices: Float[np.ndarray, "n columns"], faces: Int[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, "_ columns"], Int[np.ndarray, "_ 3"]]:
    """Returns a surface of at most `MOST_FACES`, by vertex clustering (Rossignac and Borrel, 1993).

    All columns of the vertices in one cell of a grid are averaged: positions, and colours where there are some.
    """
    width = np.ptp(vertices[:, :3], axis=0).max() / 160 if len(faces) > MOST_FACES else 0.0
    corners, triangles = vertices, faces
    while len(triangles) > MOST_FACES:
        _, cell = np.unique(np.floor(vertices[:, :3] / width).astype(int), axis=0, return_inverse=True)
        cell = cell.reshape(-1)
        corners = np.stack([np.bincount(cell, axis) for axis in vertices.T], axis=1) / np.bincount(cell)[:, None]
        triangles = cell[faces]
        triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(1)]
        width *= 1.1
    return corners, triangles
