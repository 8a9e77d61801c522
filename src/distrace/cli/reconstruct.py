"""`reconstruct`: shape and colours of any object, without a model, from photographs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from distrace.cli.common import NONE, Every, Flag, Format, Views, check_formats
from distrace.cli.console import Run, console, progress, start
from distrace.cli.metrics_log import Log, MetricsLog, check_log, is_due
from distrace.cli.reconstructed import Reconstructed
from distrace.data.photograph import Photograph
from distrace.data.photographs import load_photographs, notes
from distrace.files import run_lock, save_json
from distrace.mesh import MeshConfig
from distrace.photos.visual_hull import MaskOverlap, mask_overlaps, visual_hull
from distrace.reconstruction.multiview_depth import NO_DEPTHS, ConsistentDepths
from distrace.reconstruction.networks import SurfaceSpecs
from distrace.reconstruction.reconstruct import informative_depths, initialise, reconstruct
from distrace.reconstruction.state import (
    ReconstructConfig,
    Reconstruction,
    fingerprint,
    load_reconstruction,
    save_reconstruction,
)
from distrace.report.reconstruction_page import compared_view
from distrace.shading import save_png
from distrace.threads import flushed_denormals

PREVIEWS = 40  # of a run, evenly over its steps; they make its film
PREVIEWED = 160  # pixels along the longer side


@dataclass(frozen=True)
class Reconstruct:
    """Reconstruct any object from photographs with known cameras.

    Photographs need masks or a dark background. A run that was interrupted continues when run again.
    """

    views: tyro.conf.Positional[Views]
    out: Path = Path("out/reconstruct")
    steps: int = ReconstructConfig.steps  # of shape and colours
    retouching: int = ReconstructConfig.refinement_steps  # further steps, of the colours alone
    sizes: tuple[int, ...] = ReconstructConfig.sizes  # pixels along the images' longer sides, from coarse to fine
    rays: int = ReconstructConfig.rays  # in each step
    width: int = SurfaceSpecs.width  # of the surface's network
    silhouettes_only: Flag = False  # fit the shape to silhouettes alone; colours do not shape it
    held_out: int = 8  # compare one view in so many instead of fitting to it; 0 for none
    leave_out: Annotated[tuple[str, ...], NONE] = ()  # names of views to ignore
    resolution: int = 256  # cells along each side of the mesh's grid
    format: tuple[Format, ...] = ("ply",)  # of the mesh, one or several
    seed: int = 0
    save_every: float = 60.0  # seconds between checkpoints
    log: Log = "none"  # beside metrics.jsonl, write event files to OUT/tensorboard
    device: str = "cpu"

    @flushed_denormals()
    def run(self) -> None:
        saving = Every(self.save_every)
        check_formats(self.format)
        check_log(self.log)
        from distrace.data.background_segmentation import masked  # brings scikit-image

        run = start(self.out, self.device)
        resolved = MeshConfig(self.resolution, device=run.device)
        found = masked(load_photographs(self.views))
        for note in notes(found):
            console.print(note)
        found = replace(found, views=without(found.views, self.leave_out))
        for each in mask_overlaps(found.views):
            if each.is_outlier:
                run.warn(_doubt(each))
        fitted_to, held_out = parted(found.views, self.held_out)
        with run_lock(run.out):
            state = fitted(run, fitted_to, (held_out or fitted_to)[0], self.config, self.specs, saving, self.log)
            found_shape = Reconstructed(self.views.name, state, self.config, found.unit_sphere, fitted_to, held_out)
            found_shape.save(run, resolved, self.format)

    @property
    def config(self) -> ReconstructConfig:
        own = {name: getattr(self, name) for name in ("steps", "sizes", "rays", "seed")}
        return ReconstructConfig(**own, refinement_steps=self.retouching, shape_from_colour=not self.silhouettes_only)

    @property
    def specs(self) -> SurfaceSpecs:
        return SurfaceSpecs(width=self.width)


def without(views: Sequence[Photograph], names: Sequence[str]) -> tuple[Photograph, ...]:
    """Returns the views of other names. Raises `ValueError` for a name that no view has."""
    unknown = set(names) - {view.name for view in views}
    if unknown:
        existing = ", ".join(view.name for view in views)
        raise ValueError(f"--leave-out {' '.join(sorted(unknown))}: no such view; there are {existing}")
    return tuple(view for view in views if view.name not in names)


def parted(views: Sequence[Photograph], every: int) -> tuple[list[Photograph], list[Photograph]]:
    """Returns the views to fit to, and those held out: one in `every`, of the views that show the object.

    Raises `ValueError` where fewer than two remain to fit to.
    """
    if every < 0:
        raise ValueError(f"--held-out {every} was given; one view in so many is held out, 0 for none")
    numbers = set(range(every // 2 - 1, len(views), every)) if every > 1 else set()
    numbers = {number for number in numbers if views[number].mask is None or views[number].known_mask.any()}
    fitted_to = [view for number, view in enumerate(views) if number not in numbers]
    if every == 1 or len(fitted_to) < 2:
        raise ValueError(
            f"--held-out {every} leaves too few of {len(views)} views to fit to; give a larger number, or 0"
        )
    return fitted_to, [views[number] for number in sorted(numbers)]


def fitted(
    run: Run,
    views: Sequence[Photograph],
    shown: Photograph,
    config: ReconstructConfig,
    specs: SurfaceSpecs,
    saving: Every,
    log: Log = "none",
) -> Reconstruction:
    """Continues from the folder's checkpoint to the last step; saves checkpoints, losses, and previews of one view."""
    marks = [fingerprint(view) for view in views]
    state = load_reconstruction(run.out, config, specs, marks, run.device)
    if state.step:
        console.print(f"continuing from step {state.step} of {config.total}")
    else:
        for preview in (run.out / "previews").glob("*.png"):
            preview.unlink()  # of a run whose checkpoint was moved away
    depths = _initialised(state, views, config)
    names = [view.name for view in views]
    save_json(run.out / "config.json", {**asdict(config), **asdict(specs), "photographs": names})
    due = -(-config.total // PREVIEWS)
    with progress("reconstructing", config.total) as bar, MetricsLog(run.out, state.step, log) as metrics:
        for step in reconstruct(views, state, config, depths):
            bar.advance(", ".join(f"{name} {values[-1]:.4f}" for name, values in state.loss_history.items()), to=step)
            if is_due(step, config.steps, config.total):
                metrics.write(step, _metrics(state, config, len(depths) > 0))
            if step % due == 0:
                small = compared_view(state, shown, PREVIEWED)
                save_png(run.out / "previews" / f"{step:07d}.png", small.picture)
            if saving.passed():
                save_reconstruction(run.out, state, config, marks)
    save_reconstruction(run.out, state, config, marks)
    return state


def _initialised(state: Reconstruction, views: Sequence[Photograph], config: ReconstructConfig) -> ConsistentDepths:
    """Initialises a new run from the visual hull; returns the multi-view depths that the remaining steps use."""
    depths = NO_DEPTHS
    compared = config.shape_from_colour and state.step < config.steps
    if state.step and not compared:
        return depths
    hull = visual_hull(views)
    if compared:
        console.print("comparing photographs with their neighbours")
        depths = informative_depths(views, hull)
        if len(depths):
            console.print(f"{len(depths):,} depths agree across views")
    if not state.step:
        console.print("initialising the network from silhouettes and depths")
        initialise(state, hull, config, depths)
    return depths


def _metrics(state: Reconstruction, config: ReconstructConfig, with_depths: bool) -> dict[str, float]:
    """Returns the loss of the last steps, its terms before their weights, and the learning rate."""
    terms = {name: values[-1] for name, values in state.loss_history.items()}
    colours = terms.pop("refinement", None)
    if colours is not None:
        return {"loss": colours, "learning_rate": config.rate_at(state.step - 1)}
    loss = sum(config.weight(name, with_depths) * value for name, value in terms.items())
    return {"loss": loss, **terms, "learning_rate": config.rate_at(state.step - 1)}


def _doubt(view: MaskOverlap) -> str:
    overlap = f"its outline overlaps with theirs by {view.iou:.0%}"
    remedy = f"check its camera, or drop it by --leave-out {view.name}"
    return f"{view.name} disagrees with the other views: {overlap}; {remedy}"
