"""The page of a completed shape: the observation, the fitted shape and its errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from distrace import shading
from distrace.fitting.judge import Verdict
from distrace.metrics import POINTS, Chamfer, iou
from distrace.render import Buffers
from distrace.report.charts import curves
from distrace.report.page import Html, figure, key, page, paragraph, ramp, row, section, table
from distrace.report.scan_page import verdict_banner
from distrace.report.scene import scene
from distrace.shading import Picture

if TYPE_CHECKING:
    import trimesh

DENSE = 0.05  # share of pixels with a depth, above which dots would hide each other


@dataclass(frozen=True)
class View:
    """One rendered state."""

    depth: Float[np.ndarray, "height width"]  # inf where there is none
    normal: Float[np.ndarray, "height width 3"]  # in world axes
    mask: Bool[np.ndarray, "height width"]
    shaded: UInt8[np.ndarray, "height width 3"]

    @staticmethod
    def of(buffers: Buffers) -> "View":
        shaded = shading.shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions)
        depth, normal, mask = (image.detach().cpu().numpy() for image in (buffers.depth, buffers.normal, buffers.mask))
        return View(depth, normal, mask, shaded)


@dataclass(frozen=True)
class Completion:
    """The content of the page of a shape that was fitted to one depth view; what is unknown is None."""

    verdict: Verdict
    title: str
    observed_depth: Float[np.ndarray, "height width"]  # inf where there is none
    observed_mask: Bool[np.ndarray, "height width"] | None
    points_world: Float[np.ndarray, "n 3"]
    before: View
    after: View
    truth: View | None
    losses: dict[str, list[float]]  # a curve for each start, or for each term
    mesh: "trimesh.Trimesh"
    truth_points: Float[np.ndarray, "m 3"] | None
    chamfer: Chamfer | None
    facts: dict[str, str]
    others: Sequence[Sequence[Picture]] = ()  # rows from the camera and from behind: the spread, then each
    chosen: str | None = None  # the curve whose result is shown


def completion_page(completion: Completion) -> str:
    """Returns the page as HTML."""
    count = f"{len(completion.points_world):,}"
    lead = f"A whole surface from {count} points: what was observed, the fitted shape and its errors."
    sections = [
        verdict_banner(completion.verdict),
        _observed(completion),
        _shapes(completion),
        _space(completion),
        *([_distances(completion.chamfer)] if completion.chamfer else []),
        _silhouettes(completion),
        _depths(completion),
        _normals(completion),
        *([_others(completion)] if completion.others else []),
        _losses(completion),
        section("Facts", table(("", ""), list(completion.facts.items()))),
    ]
    return page(completion.title, lead, sections)


def _states(completion: Completion) -> dict[str, View]:
    states = {"Before the fit": completion.before, "After the fit": completion.after}
    return states if completion.truth is None else states | {"Truth": completion.truth}


def _depth_range(completion: Completion) -> tuple[float, float]:
    """One range for all depths of the page."""
    return shading.depth_range(completion.observed_depth, *(view.depth for view in _states(completion).values()))


def _observed(completion: Completion) -> Html:
    depth, mask = completion.observed_depth, completion.observed_mask
    near, far = _depth_range(completion)
    if np.isfinite(depth).mean() > DENSE:
        points = figure(shading.depth_picture(depth, near, far), "The observed depth")
    else:
        base, where = _under_points(completion)
        points = figure(shading.dots_picture(base, depth, near, far), f"The observed points{where}")
    silhouette = [] if mask is None else [figure(shading.mask_picture(mask), "The observed silhouette")]
    return section("Observed", row(points, *silhouette), _depth_key(near, far))


def _under_points(completion: Completion) -> tuple[Picture, str]:
    """Returns the picture under the dots, and its words in the caption."""
    if completion.truth is not None:
        return completion.truth.shaded, ", over a picture of the true surface"
    if completion.observed_mask is not None:
        return shading.mask_picture(completion.observed_mask), ", over the observed silhouette"
    return np.full((*completion.observed_depth.shape, 3), 255, np.uint8), ""


def _shapes(completion: Completion) -> Html:
    return section("Shape", row(*(figure(view.shaded, name) for name, view in _states(completion).items())))


def _space(completion: Completion) -> Html:
    clouds = {"Observed points": completion.points_world}
    if completion.truth_points is not None:
        clouds["Points of the true surface"] = completion.truth_points
    usage = "Drag to turn. Buttons switch to moving and zooming; the legend hides and shows."
    return section("In space", paragraph(usage), scene({"Completed surface": completion.mesh}, clouds))


def _distances(chamfer: Chamfer) -> Html:
    unit = (
        f"Chamfer distance: the mean squared distance × 1000 from {POINTS:,} points on one surface to the other,"
        " in the frame in which the shape lies in the unit sphere."
    )
    rows = [
        ("Completed to true", f"{chamfer.to:.4f}", "Large where there is surface that should not be there."),
        ("True to completed", f"{chamfer.from_:.4f}", "Large where surface is missing."),
        ("Sum", f"{chamfer.sum:.4f}", "Both errors together."),
    ]
    return section(
        "Distance to the truth", paragraph(unit), table(("Direction", "Mean square × 1000", "What it means"), rows)
    )


def _silhouettes(completion: Completion) -> Html:
    truth = None if completion.truth is None else completion.truth.mask
    reference, name = (truth, "true") if completion.observed_mask is None else (completion.observed_mask, "observed")
    if reference is None:
        return section("Silhouettes", row(figure(shading.mask_picture(completion.after.mask), "After the fit")))
    pairs = {"Before the fit": completion.before, "After the fit": completion.after}
    compared = [
        figure(shading.mask_comparison(reference, view.mask), f"{state}: {_overlap(reference, view.mask)}")
        for state, view in pairs.items()
    ]
    colours = {"agree": shading.AGREE, f"{name}, not rendered": shading.MISSING, f"rendered, not {name}": shading.EXTRA}
    return section("Silhouettes", row(*compared), key(colours))


def _overlap(first: Bool[np.ndarray, "height width"], second: Bool[np.ndarray, "height width"]) -> str:
    return f"{iou(torch.from_numpy(first), torch.from_numpy(second)):.1%} intersection over union"


def _depths(completion: Completion) -> Html:
    states, (near, far) = _states(completion), _depth_range(completion)
    rendered = [figure(shading.depth_picture(view.depth, near, far), name) for name, view in states.items()]
    return section("Depth", row(*rendered), _depth_key(near, far), *_depth_errors(completion))


def _depth_errors(completion: Completion) -> list[Html]:
    """Returns pictures of the errors in depth; none without the true depth."""
    if completion.truth is None:
        return []
    before, after = (_difference(view.depth, completion.truth.depth) for view in (completion.before, completion.after))
    limit = max(float(np.nanquantile(np.abs(before), 0.9)), 1e-6) if np.isfinite(before).any() else 1.0
    names = ("Before the fit: depth − true depth", "After the fit: depth − true depth")
    pictures = [shading.error_picture(difference, limit) for difference in (before, after)]
    return [row(*map(figure, pictures, names)), _error_key(limit)]


def _difference(depth: Float[np.ndarray, "h w"], truth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Returns depth − truth; NaN where one of them is not finite."""
    return np.subtract(depth, truth, out=np.full_like(depth, np.nan), where=np.isfinite(depth) & np.isfinite(truth))


def _depth_key(near: float, far: float) -> Html:
    colours = shading.depth_picture(np.linspace(near, far, 9)[None], near, far)
    return ramp(f"near {near:.2f}", f"{far:.2f} far", colours)


def _error_key(limit: float) -> Html:
    colours = shading.error_picture(np.linspace(-limit, limit, 9)[None], limit)
    return ramp(f"too near −{limit:.2g}", f"+{limit:.2g} too far", colours)


def _normals(completion: Completion) -> Html:
    states = _states(completion).items()
    figures = [figure(shading.normal_picture(view.normal, view.mask), name) for name, view in states]
    axes = key({"faces +x": (255, 128, 128), "faces +y, up": (128, 255, 128), "faces +z": (128, 128, 255)})
    return section("Normals", row(*figures), axes)


def _others(completion: Completion) -> Html:
    about = (
        "Each is fitted to the same observation, with another guess of the unobserved parts. Colours show how far these"
        " surfaces are from the completed one, in radii of the sphere. The lower row is the view from behind."
    )
    colours = shading.error_picture(np.linspace(0, 1, 9)[None], 1)
    return section(
        "Other shapes that fit",
        paragraph(about),
        figure(shading.grid(completion.others), "Spread, and the other shapes"),
        ramp("0", "0.1 and more", colours),
    )


def _losses(completion: Completion) -> Html:
    values = [value for curve in completion.losses.values() for value in curve]
    drawn = curves(completion.losses, "iteration", "loss", all(value > 0 for value in values), completion.chosen)
    note = [] if completion.chosen is None else [paragraph(f"The shape shown is that of {completion.chosen}.")]
    return section("Loss", *note, drawn)
