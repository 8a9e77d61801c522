"""The page of a clip: some of its frames, what each method made of them, and how far that is from the true surface."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View, observe
from distrace.data.photograph import Photograph
from distrace.data.photographs import load_photographs
from distrace.data.solid import Solid
from distrace.files import save_text
from distrace.report.page import figure, page, paragraph, ramp, row, section, short, table
from distrace.report.scene import scene
from distrace.shading import Picture, colour_picture, error_picture, grid, save_png
from experiments.tables.multiview import ClipResult, ClipTrial, Surface, clip_done, described, surface_of
from experiments.tables.sparse_depth import true_solid

SHOWN = 6  # frames
EYES = 2  # of these that shapes are drawn from
SIZE = 192  # pixels
LIMIT = 0.1  # distance from the true surface that has the strongest colour


def save_clip_page(out: Path, folder: Path, trials: Sequence[ClipTrial], meshes: Path) -> None:
    """The page of trials that are done, and its comparison as a picture."""
    clip = described(folder)
    true = true_solid(meshes, clip["split"], clip["shape"])
    surfaces = {trial.method: surface_of(trial) for trial in trials}
    name, results = f"{clip['shape']}_{clip['background']}", [clip_done(trial) for trial in trials]
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
    """Frames, shapes and figures of one clip, and all surfaces to turn."""
    first = results[0]
    meshes = {name: each for name, each in surfaces.items() if isinstance(each, trimesh.Trimesh)}
    clouds = {name: each for name, each in surfaces.items() if isinstance(each, np.ndarray)}
    rows = [[each.method, *map(short, (each.chamfer_to, each.chamfer_from, each.chamfer))] for each in results]
    colours = error_picture(np.linspace(0, LIMIT, 9)[None], LIMIT)
    return page(
        f"{first.shape} from a clip",
        f"{first.category}, {first.background} background; cameras were known, and masks to silhouettes alone.",
        [
            section("Frames", row(*(figure(colour_picture(view.image), view.name) for view in frames))),
            section(
                "Shapes",
                paragraph(f"The true shape, then {', '.join(surfaces)}: below, how far each is from the true surface."),
                figure(picture, "from two of the frames' cameras"),
                ramp("on the surface", f"{LIMIT:g} radii away", colours),
            ),
            section("Chamfer distance × 1000", table(["method", "to the truth", "from the truth", "sum"], rows)),
            section("In space", scene({"truth": true.surface, **meshes}, clouds)),
        ],
    )


def comparison(frames: Sequence[Photograph], surfaces: Mapping[str, Surface], true: Solid) -> Picture:
    """From some frames' cameras: the true shape and those found, shaded; under each its distance from the truth."""
    lines: list[list[Picture]] = []
    for frame in frames[1 :: -(-len(frames) // EYES)]:  # the first would see the shape from straight ahead
        truth = _shaded(observe(true, frame.camera))
        seen = [_seen(surface, frame.camera) for surface in surfaces.values()]
        lines += [[truth, *map(_shaded, seen)], [np.full_like(truth, 255), *(_apart(view, true) for view in seen)]]
    return grid(lines)


def _frames(folder: Path) -> list[Photograph]:
    views = load_photographs(folder).views
    return [view.at_most(SIZE) for view in views[:: -(-len(views) // SHOWN)]]


def _seen(surface: Surface, camera: Camera) -> View:
    if isinstance(surface, np.ndarray):
        return Cloud(torch.from_numpy(surface).float()).seen_from(camera)
    return observe(Solid(surface, surface), camera)


def _shaded(view: View) -> Picture:
    """As clay; points, which have no normals, as dots."""
    if view.shaded is not None:
        return view.shaded
    return np.where(view.seen[..., None].numpy(), 96, 255).repeat(3, axis=-1).astype(np.uint8)


def _apart(view: View, true: Solid) -> Picture:
    """How far what is seen is from the true surface."""
    distance = np.full(view.depth.shape, np.nan)
    distance[view.seen.numpy()] = true.apart(view.points().double().numpy())
    return error_picture(distance, LIMIT)
