"""The page of a clip: frames, the surface of each method, and its distance from the true surface."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.data.photograph import Photograph
from distrace.data.photographs import load_photographs
from distrace.data.solid import Solid
from distrace.files import save_text
from distrace.report.page import figure, page, paragraph, ramp, row, section, short, table
from distrace.report.scene import scene
from distrace.shading import Picture, colour_picture, error_picture, grid, save_png
from experiments.datasets.solids import observe
from experiments.tables.multiview import ClipResult, ClipTrial, Surface, clip_done, described, surface_of
from experiments.tables.sparse_depth import true_solid

SHOWN = 6  # frames
EYES = 2  # of these cameras, from which shapes are rendered
SIZE = 192  # pixels
LIMIT = 0.1  # radii from the true surface: the strongest colour


def save_clip_page(out: Path, folder: Path, trials: Sequence[ClipTrial], meshes: Path) -> None:
    """Writes the page of finished trials, and its comparison as a picture."""
    clip = described(folder)
    true = true_solid(meshes, clip["split"], clip["shape"])
    surfaces = {trial.method: surface_of(trial) for trial in trials}
    name = f"{clip['shape']}_{clip['background']}"
    results = [clip_done(trial) for trial in trials]
    frames = _frames(folder)
    picture = comparison(frames, surfaces, true)
    save_png(out / f"{name}.png", picture)
    save_text(out / f"{name}.html", clip_page(frames, picture, results, surfaces, true))


def clip_page(
    frames: Sequence[Photograph],
    picture: Picture,
    results: Sequence[ClipResult],
    surfaces: Mapping[str, Surface],
    true: Solid,
) -> str:
    """Returns the page: frames, shapes, figures, and all surfaces in 3-D."""
    first = results[0]
    meshes = {name: each for name, each in surfaces.items() if isinstance(each, trimesh.Trimesh)}
    clouds = {name: each for name, each in surfaces.items() if isinstance(each, np.ndarray)}
    rows = [[each.method, *map(short, (each.chamfer_to, each.chamfer_from, each.chamfer))] for each in results]
    colours = error_picture(np.linspace(0, LIMIT, 9)[None], LIMIT)
    return page(
        f"{first.shape} from a clip",
        f"{first.category}, {first.background} background; all methods have the cameras, one the masks.",
        [
            section("Frames", row(*(figure(colour_picture(view.image), view.name) for view in frames))),
            section(
                "Shapes",
                paragraph(
                    f"The true shape, then {', '.join(surfaces)}. Below: the distance of each from the true surface."
                ),
                figure(picture, "from two of the frames' cameras"),
                ramp("on the surface", f"{LIMIT:g} radii away", colours),
            ),
            section("Chamfer distance × 1000", table(["method", "to the truth", "from the truth", "sum"], rows)),
            section("In space", scene({"truth": true.surface, **meshes}, clouds)),
        ],
    )


def comparison(frames: Sequence[Photograph], surfaces: Mapping[str, Surface], true: Solid) -> Picture:
    """Returns, for EYES cameras, the shaded surfaces, and below each its distance from the true one."""
    lines: list[list[Picture]] = []
    for frame in frames[1 :: -(-len(frames) // EYES)]:  # the first camera faces the front
        truth = _shaded(observe(true, frame.camera))
        views = [_observed(surface, frame.camera) for surface in surfaces.values()]
        errors = [_error_picture(view, true) for view in views]
        lines += [[truth, *map(_shaded, views)], [np.full_like(truth, 255), *errors]]
    return grid(lines)


def _frames(folder: Path) -> list[Photograph]:
    views = load_photographs(folder).views
    return [view.at_most(SIZE) for view in views[:: -(-len(views) // SHOWN)]]


def _observed(surface: Surface, camera: Camera) -> View:
    if isinstance(surface, np.ndarray):
        return Cloud(torch.from_numpy(surface).float()).seen_from(camera)
    return observe(Solid(surface, surface), camera)


def _shaded(view: View) -> Picture:
    """Shades a mesh as clay, and points, which have no normals, as dots."""
    if view.shaded is not None:
        return view.shaded
    return np.where(view.seen[..., None].numpy(), 96, 255).repeat(3, axis=-1).astype(np.uint8)


def _error_picture(view: View, true: Solid) -> Picture:
    """Returns the distance of the visible points from the true surface as colours."""
    distance = np.full(view.depth.shape, np.nan)
    distance[view.seen.numpy()] = true.apart(view.points().double().numpy())
    return error_picture(distance, LIMIT)
