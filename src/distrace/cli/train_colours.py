"""`train --colour`: a colour decoder for the shapes of a model, from textured meshes."""

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from distrace.checkpoints.colours import Colours, save_colours
from distrace.checkpoints.model import Model, load_model, model_folder, save_model
from distrace.cli.common import Orbit
from distrace.cli.console import Run, console, progress
from distrace.coloured import coloured_picture, studio
from distrace.data.coloured_points import ColouredPoints, ColourJob, colour_jobs
from distrace.data.shapes import Shape, every_mesh, read_split
from distrace.fitting.placement_network import PLACEMENT_FILE, load_placement_network, save_placement_network
from distrace.processes import parallel_map
from distrace.render import render
from distrace.shading import save_png, side_by_side
from distrace.training.colours import ColourTrainConfig, ColourTraining, start_colours
from distrace.training.colours import train_colours as trained_steps

POINTS = 20_000  # of each mesh
PREVIEWED = 5  # shapes


def train_colours(run: Run, meshes: Path, splits: Sequence[Path], name: str, config: ColourTrainConfig) -> None:
    """Writes the model `name` with colours into the run's folder, and a preview.

    `meshes` holds the textured meshes of its shapes. Raises `ValueError` where none has a shape's name.
    """
    model = load_model(name)
    _check_folder(run.out, name)
    config = replace(config, specs=replace(config.specs, shape_code=model.codes.shape[1]))
    chosen = _shapes(model, meshes, splits)
    samples = _sampled(colour_jobs(chosen, meshes, run.out / "coloured-points", POINTS))
    shapes = tuple(samples)
    codes = torch.stack([model.code_of(shape) for shape in shapes]).to(run.device)
    training = start_colours(len(shapes), config, run.device)
    loss = math.nan
    with progress("training colours", config.steps) as bar:
        for latest in trained_steps(training, list(samples.values()), codes, config):
            loss = latest if math.isnan(loss) else 0.98 * loss + 0.02 * latest
            bar.advance(f"loss {loss:.4f}")
    colours = _ordered(training, shapes, config)
    save_model(run.out, model)
    network = load_placement_network(name)
    if network is not None:
        save_placement_network(run.out / PLACEMENT_FILE, network)
    save_colours(run.out, colours)
    save_png(run.out / "preview.png", side_by_side(_previews(model.to(run.device), colours)))
    run.finish({"steps": config.steps, "loss": loss, "shapes": len(shapes)})


def _check_folder(out: Path, name: str) -> None:
    """Raises `ValueError` where the model would be written over another one."""
    if out.resolve() == model_folder(name).resolve():
        raise ValueError(f"--out {out} is the folder of --begin-with {name}; give another")
    for other in ("checkpoint.pt", "ModelParameters"):
        if (out / other).exists():
            raise ValueError(f"--out {out} holds a run of `train` without --colour; give another folder")


def _shapes(model: Model, meshes: Path, splits: Sequence[Path]) -> list[Shape]:
    known = [shape for split in splits for shape in read_split(split)] if splits else every_mesh(meshes)
    chosen = [shape for shape in known if shape.split == "train" and shape.name in model.shapes]
    if not chosen:
        raise ValueError(f"no mesh of {meshes} is called like a shape of {model.name}; `distrace shapes` lists these")
    return chosen


def _sampled(jobs: Sequence[ColourJob]) -> dict[str, ColouredPoints]:
    """Returns the points of each mesh that has a surface; those of an earlier run are taken again."""
    with progress("reading colours", len(jobs)) as bar:
        for job, problem in parallel_map(ColourJob.run, jobs, os.cpu_count() or 1):
            bar.advance(job.name)
            if problem:
                console.print(f"{job.name} is left out: {problem}")
    samples = {job.name: ColouredPoints.load(job.out) for job in jobs if job.out.is_file()}
    if not samples:
        raise ValueError("none of the meshes bounds a solid; there are no colours to learn")
    return samples


def _ordered(training: ColourTraining, shapes: tuple[str, ...], config: ColourTrainConfig) -> Colours:
    """Returns the trained colours, the shapes' own first."""
    codes = training.codes.detach().reshape(len(shapes), config.palettes, -1).transpose(0, 1).flatten(0, 1)
    return Colours(training.decoder.eval().requires_grad_(False), codes, shapes)


@torch.no_grad()
def _previews(model: Model, colours: Colours) -> list:
    camera = Orbit(size=192).camera().to(model.codes.device)
    pictures = []
    for shape in colours.shapes[:: max(len(colours.shapes) // PREVIEWED, 1)]:
        code = model.code_of(shape)
        buffers = render(model.field(code), camera)
        pictures.append(
            coloured_picture(buffers, colours.decoder.albedo(code, colours.code_of(shape)), studio(buffers))
        )
    return pictures
