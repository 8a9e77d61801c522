"""The page of a reconstruction: renderings beside photographs, held-out ones first, and their errors."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.photograph import Photograph, averaged
from distrace.mesh import MeshConfig, extract_mesh
from distrace.metrics import iou
from distrace.reconstruction.losses import normals_and_features, surface_colours
from distrace.reconstruction.state import Reconstruction
from distrace.render import Buffers, render
from distrace.report.charts import curves
from distrace.report.page import Html, facts_section, figure, page, paragraph, section
from distrace.report.scene import space_section
from distrace.shading import Picture, colour_picture, mask_comparison, normal_picture, side_by_side
from distrace.training.losses import STEPS_PER_LOSS

if TYPE_CHECKING:
    import trimesh

AT_ONCE = 1 << 16  # points whose colours are evaluated together
FINER = 2  # rays along each side of a pixel: a photograph has means over areas


@dataclass(frozen=True)
class ComparedView:
    """A photograph and its rendering: their difference, and both side by side."""

    name: str
    psnr: float  # decibels, over the photograph's mask; pixels that are not rendered count as black
    silhouette_iou: float
    picture: Picture  # the photograph, the rendering, its normals, the masks


@torch.no_grad()
def compared_view(state: Reconstruction, photograph: Photograph, size: int) -> ComparedView:
    """Renders the object as a photograph's camera sees it, with `size` pixels along the longer side.

    Raises `ValueError` for a photograph without a mask.
    """
    view = photograph.at_most(size)
    buffers, hit, made = rendered(state, view)
    mask, image = view.known_mask, view.image
    error = (made - image)[mask].square().mean().clamp_min(1e-10)
    pictures = [
        colour_picture(torch.where(mask[..., None], image, 0.4 * image)),
        colour_picture(torch.where(hit[..., None], made, 1.0)),
        normal_picture(buffers.normal[::FINER, ::FINER], buffers.mask[::FINER, ::FINER], view.camera.T_world_camera),
        mask_comparison(mask, hit),
    ]
    return ComparedView(photograph.name, -10 * math.log10(float(error)), iou(mask, hit), side_by_side(pictures))


@torch.no_grad()
def rendered(
    state: Reconstruction, view: Photograph
) -> tuple[Buffers, Bool[Tensor, "height width"], Float[Tensor, "height width 3"]]:
    """Renders the surface as a photograph's camera sees it.

    Returns the buffers, `FINER` rays along each side of a pixel; the pixels that are covered by more than half; and
    their colours, means over a pixel's area in which rays that miss are black.
    """
    camera = view.camera.resized(float(FINER)).to(state.device)
    buffers = render(state.surface, camera)
    made = torch.zeros_like(buffers.rays.directions)
    hits = zip(buffers.points.split(AT_ONCE), buffers.rays.directions[buffers.mask].split(AT_ONCE), strict=True)
    parts = [surface_colours(state.surface, state.colour, points, directions) for points, directions in hits]
    made[buffers.mask] = torch.cat(parts) if parts else made[:0, 0]
    covered = averaged(buffers.mask[..., None].cpu().float(), 1 / FINER)[..., 0]
    return buffers, covered > 0.5, averaged(made.cpu(), 1 / FINER).float()


@torch.no_grad()
def coloured_mesh(state: Reconstruction, config: MeshConfig) -> "trimesh.Trimesh":
    """Returns the surface as triangles; each vertex has the colour that is seen along its normal."""
    import trimesh

    mesh = extract_mesh(state.surface, config)
    vertices = torch.from_numpy(np.asarray(mesh.vertices)).float().to(config.device)
    parts = []
    for points in vertices.split(AT_ONCE):
        normals, features = normals_and_features(state.surface, points)
        parts.append(state.colour(points, normals, -normals, features))
    colours = (255 * torch.cat(parts)).round().byte().cpu().numpy()
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)


def row_of(name: str, method: str, compared: Mapping[str, Sequence[ComparedView]], seconds: float) -> dict[str, object]:
    """Returns a row of the table of photographs: means over held-out views.

    Each key of `compared` names the cameras, and is appended to the columns' names.
    """
    numbers: dict[str, object] = {}
    for cameras, views in compared.items():
        numbers[f"psnr{cameras}"] = round(mean(view.psnr for view in views), 2)
        numbers[f"silhouette_iou{cameras}"] = round(mean(view.silhouette_iou for view in views), 4)
    count = len(next(iter(compared.values())))
    return {"object": name, "method": method, **numbers, "views_held_out": count, "seconds": round(seconds)}


def reconstruction_page(
    name: str,
    held_out: Sequence[ComparedView],
    fitted_to: Sequence[ComparedView],
    loss_history: Mapping[str, Sequence[float]],
    mesh: "trimesh.Trimesh",
    facts: Mapping[str, str],
) -> str:
    """Returns a page with held-out views, views that were fitted to, the mesh and the loss history."""
    about = "The photograph, its background dimmed; the rendering; its normals; the masks (orange missing, blue extra)."
    return page(
        f"{name} from photographs",
        "A surface and its colours, as the weights of two networks: sphere-traced, with exact gradients.",
        [
            *([section("Held-out views", paragraph(about), *map(_shown, held_out))] if held_out else []),
            section("Views that were fitted to", *map(_shown, fitted_to)),
            space_section({"Surface": mesh}),
            section("Loss", curves(loss_history, f"× {STEPS_PER_LOSS} steps", "mean of a term", True)),
            facts_section(facts),
        ],
    )


def _shown(view: ComparedView) -> Html:
    return figure(view.picture, f"{view.name}: {view.psnr:.1f} dB, intersection over union {view.silhouette_iou:.3f}")
