"""The page of a completion in the frame of its input: the verdict, the input, and the completed shape."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from distrace.data.observation import View
from distrace.fitting.judge import Verdict
from distrace.pose import Similarity
from distrace.report.charts import starts_section
from distrace.report.page import facts_section, figure, page, paragraph, row, section, table, verdict_banner
from distrace.report.scene import surfaces_section
from distrace.shading import Picture, depth_picture

if TYPE_CHECKING:
    import trimesh

ABOUT_VERDICT = (
    "A verdict comes from the input alone. A part that nothing was seen of may still be wrong: there the shape is what"
    " the model takes to be likely."
)
ABOUT_INPUT = "The input: the object that was completed in colours, by depth, with a frame; everything else in grey"
LONGEST = 640  # pixels along the longer side of an input's picture, at most
PALE = 0.4  # of the full contrast, of what is not the object
FRAME = 2  # pixels, of the rectangle's width
ORANGE = (226, 112, 32)
ABOUT_PLACEMENT = (
    "T_input_object takes points of the model's unit sphere to the input's frame; `placement.json` holds it."
)


def input_picture(image: Float[Tensor, "height width"], view: View) -> Picture:
    """Returns a whole depth image in pale grey, its object in colours, and a rectangle around that.

    Of a large image only some rows and columns are drawn.
    """
    step = -(-max(image.shape) // LONGEST)
    depth = view.depth[::step, ::step]
    inside = depth.isfinite().cpu().numpy()
    scene = depth_picture(image[::step, ::step])
    picture = np.repeat(255 - (255 - scene.mean(-1, keepdims=True)) * PALE, 3, axis=-1).astype(np.uint8)
    picture[inside] = depth_picture(depth)[inside]
    rows, columns = inside.nonzero()
    if rows.size:
        top, left = max(rows.min() - FRAME, 0), max(columns.min() - FRAME, 0)
        framed = np.zeros_like(inside)
        framed[top : rows.max() + FRAME + 1, left : columns.max() + FRAME + 1] = True
        framed[top + FRAME : rows.max() + 1, left + FRAME : columns.max() + 1] = False
        picture[framed & ~inside] = ORANGE
    return picture


def scan_page(
    verdict: Verdict,
    observed: Sequence[Picture],
    pictures: Mapping[str, Picture],
    mesh: "trimesh.Trimesh",
    points: Float[np.ndarray, "n 3"],
    losses: Mapping[str, Sequence[float]],
    place: Similarity,
    facts: Mapping[str, str],
    truth: "trimesh.Trimesh | np.ndarray | None" = None,
    origin: str = "",
) -> str:
    """Returns the page as HTML.

    `observed` are the `input_picture` of each view; `pictures` the completion, by where it is seen from; `mesh`,
    `points` and `truth` lie in the input's frame; `losses` are those of each start, the best first; `origin` is the
    model, the command and the version.
    """
    inputs = [figure(picture, ABOUT_INPUT) for picture in observed]
    shapes = [figure(picture, f"The completion from {name}") for name, picture in pictures.items()]
    evidence = [
        ("points near the surface", f"{verdict.explained:.1%}"),
        ("rays of free space that pass through the shape", f"{verdict.blocked:.1%}"),
        ("distance of the other good fits, in sizes", f"{verdict.disagreement:.3f}"),
    ]
    if verdict.prior_deviation is not None:
        evidence.append(("deviations from the likely size and centre", f"{verdict.prior_deviation:.1f}"))
    turn = place.rotation.double().numpy()  # rows of the input's axes, columns of the object's
    if truth is not None:
        truth = truth @ turn if isinstance(truth, np.ndarray) else _turned(truth, turn)
    matrix = [[f"{value:.4f}" for value in line] for line in place.T_world_object.tolist()]
    return page(
        "A shape completed in the frame of its input",
        f"A whole surface from {len(points):,} points, in the frame and the unit of the input.",
        [
            verdict_banner(verdict),
            section("Shape", row(*inputs, *shapes)),
            surfaces_section(_turned(mesh, turn), {"Points of the input": points @ turn}, truth),
            section("Verdict", paragraph(ABOUT_VERDICT), table(("", ""), evidence)),
            section("Placement", paragraph(ABOUT_PLACEMENT), table([""] * 4, matrix)),
            starts_section(losses, next(iter(losses), None)),
            facts_section(facts),
        ],
        origin,
    )


def _turned(mesh: "trimesh.Trimesh", turn: Float[np.ndarray, "3 3"]) -> "trimesh.Trimesh":
    turned = mesh.copy()
    turned.vertices = np.asarray(mesh.vertices) @ turn
    return turned
