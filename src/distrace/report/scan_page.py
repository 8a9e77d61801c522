"""The page of a completion in the frame of its input: the verdict, the input, and the completed shape."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from distrace.fitting.judge import Verdict
from distrace.pose import Similarity
from distrace.report.charts import curves
from distrace.report.page import Html, banner, figure, page, paragraph, row, section, table
from distrace.report.scene import scene
from distrace.shading import Picture

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True)
class ScanCompletion:
    """The content of the page."""

    verdict: Verdict
    observed: Sequence[Picture]  # depth of each view
    pictures: Mapping[str, Picture]  # of the completion, by where it is seen from
    mesh: "trimesh.Trimesh"  # in the input's frame
    points: Float[np.ndarray, "n 3"]  # of the input
    losses: Mapping[str, Sequence[float]]  # of each start
    place: Similarity
    facts: Mapping[str, str]


def scan_page(completion: ScanCompletion) -> str:
    """Returns the page as HTML."""
    lead = f"A whole surface from {len(completion.points):,} points, in the frame and the unit of the input."
    inputs = [figure(picture, "The observed depth of the object") for picture in completion.observed]
    shapes = [figure(picture, f"The completion from {name}") for name, picture in completion.pictures.items()]
    sections = [
        verdict_banner(completion.verdict),
        section("Shape", row(*inputs, *shapes)),
        _space(completion),
        section("Verdict", paragraph(ABOUT), table(("", ""), _verdict_rows(completion.verdict))),
        _placement(completion.place),
        section("Loss", curves(completion.losses, "iteration", "loss", True)),
        section("Facts", table(("", ""), list(completion.facts.items()))),
    ]
    return page("A shape completed in the frame of its input", lead, sections)


ABOUT = (
    "A verdict comes from the input alone. A part that nothing was seen of may still be wrong: there the shape is what"
    " the model takes to be likely."
)


def verdict_banner(verdict: Verdict) -> Html:
    """Returns the verdict as the page's first lines."""
    return banner(verdict.name, f"{verdict.name.capitalize()}: {verdict.reason}.")


def _verdict_rows(verdict: Verdict) -> list[tuple[str, str]]:
    return [
        ("points near the surface", f"{verdict.explained:.1%}"),
        ("rays of free space that pass through the shape", f"{verdict.blocked:.1%}"),
        ("distance of the other good fits, in radii of the unit sphere", f"{verdict.disagreement:.3f}"),
    ]


def _space(completion: ScanCompletion) -> Html:
    """Returns the input's points and the surface, upright."""
    turn = completion.place.rotation.double().numpy()  # rows of the input's axes, columns of the object's
    upright = completion.mesh.copy()
    upright.vertices = np.asarray(upright.vertices) @ turn
    usage = "Drag to turn. Buttons switch to moving and zooming; the legend hides and shows."
    clouds = {"Points of the input": completion.points @ turn}
    return section("In space", paragraph(usage), scene({"Completed surface": upright}, clouds))


def _placement(place: Similarity) -> Html:
    about = "T_input_object takes points of the model's unit sphere to the input's frame; `placement.json` holds it."
    rows = [tuple(f"{value:.4f}" for value in line) for line in place.T_world_object.tolist()]
    return section("Placement", paragraph(about), table(("", "", "", ""), rows))
