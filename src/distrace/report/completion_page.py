"""The page of a completed shape: the observation, the fitted shape and its errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from distrace import shading
from distrace.antialiasing import smooth_outline
from distrace.camera import Camera
from distrace.fitting.judge import Verdict
from distrace.metrics import POINTS, Chamfer, iou
from distrace.render import Buffers
from distrace.report.charts import starts_section
from distrace.report.page import (
    Html,
    error_ramp,
    facts_section,
    figure,
    key,
    page,
    paragraph,
    ramp,
    row,
    section,
    table,
    verdict_banner,
)
from distrace.report.scene import surfaces_section
from distrace.shading import Picture

if TYPE_CHECKING:
    import trimesh

DENSE = 0.05  # share of pixels with a depth, above which dots would hide each other


@dataclass(frozen=True)
class RenderedView:
    """One rendered state."""

    depth: Float[np.ndarray, "height width"]  # inf where there is none
    normal: Float[np.ndarray, "height width 3"]  # in world axes
    mask: Bool[np.ndarray, "height width"]
    shaded: UInt8[np.ndarray, "height width 3"]

    @staticmethod
    def of(buffers: Buffers, camera: Camera) -> "RenderedView":
        """Returns the state as arrays."""
        depth, normal, mask = (image.detach().cpu().numpy() for image in (buffers.depth, buffers.normal, buffers.mask))
        return RenderedView(depth, normal, mask, smooth_outline(buffers, camera))


@dataclass(frozen=True)
class Completion:
    """The content of the page of a shape that was fitted to one depth view; what is unknown is None."""

    verdict: Verdict
    title: str
    observed_depth: Float[np.ndarray, "height width"]  # inf where there is none
    observed_mask: Bool[np.ndarray, "height width"] | None
    points_world: Float[np.ndarray, "n 3"]
    before: RenderedView
    after: RenderedView
    truth: RenderedView | None
    losses: dict[str, list[float]]  # a curve for each start, or for each term
    mesh: "trimesh.Trimesh"
    truth_surface: "trimesh.Trimesh | np.ndarray | None"  # a mesh, or points [m, 3]
    chamfer: Chamfer | None
    facts: dict[str, str]
    others: Sequence[Sequence[Picture]] = ()  # rows from the camera and from behind: the spread, then each
    chosen: str | None = None  # the curve whose result is shown
    origin: str = ""  # the model, the command and the version


def completion_page(completion: Completion) -> str:
    """Returns the page as HTML."""
    count = f"{len(completion.points_world):,}"
    states = {"Before the fit": completion.before, "After the fit": completion.after}
    if completion.truth is not None:
        states["Truth"] = completion.truth
    near, far = shading.depth_range(completion.observed_depth, *(view.depth for view in states.values()))
    depths = [figure(shading.depth_picture(view.depth, near, far), name) for name, view in states.items()]
    depth_key = ramp(f"near {near:.2f}", f"{far:.2f} far", shading.depth_picture(np.linspace(near, far, 9)[None]))
    normals = [figure(shading.normal_picture(view.normal, view.mask), name) for name, view in states.items()]
    axes = key({"faces +x": (255, 128, 128), "faces +y, up": (128, 255, 128), "faces +z": (128, 128, 255)})
    sections = [
        verdict_banner(completion.verdict),
        section("Observed", row(*_observed(completion, near, far)), depth_key),
        section("Shape", row(*(figure(view.shaded, name) for name, view in states.items()))),
        surfaces_section(completion.mesh, {"Observed points": completion.points_world}, completion.truth_surface),
        *([_distances(completion.chamfer)] if completion.chamfer else []),
        _silhouettes(completion),
        section("Depth", row(*depths), depth_key, *_depth_errors(completion)),
        section("Normals", row(*normals), axes),
        *([_others(completion.others)] if completion.others else []),
        starts_section(completion.losses, completion.chosen),
        facts_section(completion.facts),
    ]
    lead = f"A whole surface from {count} points: what was observed, the fitted shape and its errors."
    return page(completion.title, lead, sections, completion.origin)


def _observed(completion: Completion, near: float, far: float) -> list[Html]:
    """Returns pictures of the depths, as dots where they are few, and of the silhouette."""
    depth = completion.observed_depth
    mask = completion.observed_mask
    silhouette = [] if mask is None else [figure(shading.mask_picture(mask), "The observed silhouette")]
    if np.isfinite(depth).mean() > DENSE:
        return [figure(shading.depth_picture(depth, near, far), "The observed depth"), *silhouette]
    base = np.full((*depth.shape, 3), 255, np.uint8)
    words = "The observed points"
    if completion.truth is not None:
        base = completion.truth.shaded
        words = "The observed points, over a picture of the true surface"
    elif mask is not None:
        base = shading.mask_picture(mask)
        words = "The observed points, over the observed silhouette"
    return [figure(shading.dots_picture(base, depth, near, far), words), *silhouette]


def _distances(chamfer: Chamfer) -> Html:
    unit = (
        f"Chamfer distance: the mean squared distance × 1000 from {POINTS:,} points on one surface to the other,"
        " in the frame in which the shape lies in the unit sphere."
    )
    header = ("Direction", "Mean square × 1000", "What it means")
    rows = [
        ("Completed to true", f"{chamfer.to:.4f}", "Large where there is surface that should not be there."),
        ("True to completed", f"{chamfer.from_:.4f}", "Large where surface is missing."),
        ("Sum", f"{chamfer.sum:.4f}", "Both errors together."),
    ]
    return section("Distance to the truth", paragraph(unit), table(header, rows))


def _silhouettes(completion: Completion) -> Html:
    name, reference = "observed", completion.observed_mask
    if reference is None and completion.truth is not None:
        name, reference = "true", completion.truth.mask
    if reference is None:
        return section("Silhouettes", row(figure(shading.mask_picture(completion.after.mask), "After the fit")))
    compared = []
    for state, view in (("Before the fit", completion.before), ("After the fit", completion.after)):
        overlap = iou(torch.from_numpy(reference), torch.from_numpy(view.mask))
        words = f"{state}: {overlap:.1%} intersection over union"
        compared.append(figure(shading.mask_comparison(reference, view.mask), words))
    colours = {"agree": shading.AGREE, f"{name}, not rendered": shading.MISSING, f"rendered, not {name}": shading.EXTRA}
    return section("Silhouettes", row(*compared), key(colours))


def _depth_errors(completion: Completion) -> list[Html]:
    """Returns pictures of the errors in depth; none without the true depth."""
    if completion.truth is None:
        return []
    before = shading.depth_difference(completion.before.depth, completion.truth.depth)
    after = shading.depth_difference(completion.after.depth, completion.truth.depth)
    limit = max(float(np.nanquantile(np.abs(before), 0.9)), 1e-6) if np.isfinite(before).any() else 1.0
    pictures = [
        figure(shading.error_picture(before, limit), "Before the fit: depth − true depth"),
        figure(shading.error_picture(after, limit), "After the fit: depth − true depth"),
    ]
    return [row(*pictures), error_ramp(f"too near −{limit:.2g}", f"+{limit:.2g} too far")]


def _others(pictures: Sequence[Sequence[Picture]]) -> Html:
    about = (
        "Each is fitted to the same observation, with another guess of the unobserved parts. Colours show how far these"
        " surfaces are from the completed one, in radii of the sphere. The lower row is the view from behind."
    )
    shown = figure(shading.grid(pictures), "Spread, and the other shapes")
    return section("Other shapes that fit", paragraph(about), shown, error_ramp("0", "0.1 and more", 0.0))
