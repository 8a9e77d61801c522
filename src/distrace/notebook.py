"""How results show themselves in Jupyter: images of a rendering, tables of models and fits.

`_repr_png_` and `_repr_html_`, which Jupyter calls, import this module; nothing else does.
"""

from collections.abc import Callable
from html import escape
from io import BytesIO

import torch
from jaxtyping import Bool, Float
from PIL import Image
from torch import Tensor

from distrace import surface
from distrace.fields.base import SDF
from distrace.rays import Rays
from distrace.shading import depth_picture, grid, normal_picture, shaded_picture

WIDEST = 256  # pixels of a picture
VIEWS = 3  # of a batch
NAMES = 6  # of shapes


@torch.no_grad()
def strip_png(
    rays: Rays,
    distance: Float[Tensor, "*batch"],
    cosines: Float[Tensor, "*batch"],
    field_at: Callable[[Bool[Tensor, "*batch"]], SDF],
) -> bytes | None:
    """Returns pictures of the first views, shaded | normals | depth, at most WIDEST pixels wide; None of no image.

    `field_at` gives the field of chosen pixels, of which every k-th is evaluated.
    """
    if distance.dim() < 2 or not distance.numel():
        return None
    stride = -(-max(distance.shape[-2:]) // WIDEST)
    shown = torch.zeros_like(distance, dtype=torch.bool)
    shown.view(-1, *distance.shape[-2:])[:VIEWS, ::stride, ::stride] = True
    hit = shown & distance.isfinite()
    normals = torch.zeros_like(rays.directions)
    normals = normals.masked_scatter(hit[..., None], surface.normals(field_at(hit), rays[hit].at(distance[hit])))
    height, width = (-(-size // stride) for size in distance.shape[-2:])

    def views(image: Tensor) -> Tensor:
        return image[shown].view(-1, height, width, *image.shape[distance.dim() :])

    rows = [
        [shaded_picture(normal, mask, directions), normal_picture(normal, mask), depth_picture(depth)]
        for normal, mask, directions, depth in zip(
            views(normals), views(hit), views(rays.directions), views(distance * cosines), strict=True
        )
    ]
    file = BytesIO()
    Image.fromarray(grid(rows, gap=0)).save(file, format="PNG")
    return file.getvalue()


def table(title: str, facts: dict[str, object]) -> str:
    """Returns a small HTML table with a title."""
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{_text(fact)}</td></tr>" for name, fact in facts.items())
    return f"<table><caption>{escape(title)}</caption>{rows}</table>"


def _text(fact: object) -> str:
    """Returns a fact in words: of a list of names the first ones."""
    if isinstance(fact, tuple):
        return escape(", ".join(map(str, fact[:NAMES]))) + (", …" if len(fact) > NAMES else "")
    if isinstance(fact, int):
        return f"{fact:,}"
    return f"{fact:.4g}" if isinstance(fact, float) else escape(str(fact))
