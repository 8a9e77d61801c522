"""`reconstruct`: shape and colours of any object from photographs with masks or a dark background; no model needed."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import tyro

from distrace.cli.common import Every, Flag, Views
from distrace.cli.console import Run, console, progress, start
from distrace.cli.reconstructed import Reconstructed
from distrace.data.background_segmentation import masked
from distrace.data.photograph import Photograph
from distrace.data.photographs import load_photographs, notes
from distrace.files import alone, save_json
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
from distrace.report.reconstruction_page import judged
from distrace.shading import save_png
from distrace.threads import flushed_denormals

PREVIEWS = 40  # of a run, evenly over its steps; they make its film
PREVIEWED = 160  # pixels along the longer side


@dataclass(frozen=True)
class Reconstruct:
    """Find shape and colours of any object from photographs with known cameras, by the weights of a network.

    They need masks, or a dark background. Run it again to go on after a stop.
    """

    views: tyro.conf.Positional[Views]
    out: Path = Path("out/reconstruct")
    steps: int = ReconstructConfig.steps  # that shape
    retouching: int = ReconstructConfig.refinement_steps  # steps after them, of the colours alone
    sizes: tuple[int, ...] = ReconstructConfig.sizes  # of the images' longer sides, in pixels, one after the other
    rays: int = ReconstructConfig.rays  # of each step
    width: int = SurfaceSpecs.width  # of the surface's network
    silhouettes_only: Flag = False  # colours do not shape the surface: a visual hull, painted
    held_out: int = 8  # one view in so many is not fitted to, but compared; 0 for none
    leave_out: tuple[str, ...] = ()  # names of views that are not used at all
    resolution: int = 256  # of the mesh
    seed: int = 0
    save_every: float = 60.0  # seconds between checkpoints, of which a killed run loses at most one
    device: str = "cpu"

    @flushed_denormals()
    def run(self) -> None:
        saving = Every(self.save_every)
        run = start(self.out, self.device)
        resolved = MeshConfig(self.resolution, device=run.device)
        found = masked(load_photographs(self.views))
        for note in notes(found):
            console.print(note, markup=False)
        found = replace(found, views=without(found.views, self.leave_out))
        for each in mask_overlaps(found.views):
            if each.is_outlier:
                console.print(_doubt(each), markup=False)
        told, kept_back = parted(found.views, self.held_out)
        with alone(run.out):
            state = fitted(run, told, (kept_back or told)[0], self.config, self.specs, saving)
            Reconstructed(self.views.name, state, self.config, found.placement, told, kept_back).save(run, resolved)

    @property
    def config(self) -> ReconstructConfig:
        own = {name: getattr(self, name) for name in ("steps", "sizes", "rays", "seed")}
        return ReconstructConfig(**own, refinement_steps=self.retouching, shape_from_colour=not self.silhouettes_only)

    @property
    def specs(self) -> SurfaceSpecs:
        return SurfaceSpecs(width=self.width)


def without(views: Sequence[Photograph], names: Sequence[str]) -> tuple[Photograph, ...]:
    """The views of other names. Raises `ValueError` for a name that no view has."""
    unknown = set(names) - {view.name for view in views}
    if unknown:
        known = ", ".join(view.name for view in views)
        raise ValueError(f"--leave-out {' '.join(sorted(unknown))}: no such view; there are {known}")
    return tuple(view for view in views if view.name not in names)


def parted(views: Sequence[Photograph], every: int) -> tuple[list[Photograph], list[Photograph]]:
    """Views to fit to, and one in so many to compare, of those that show the object.

    Raises `ValueError` where fewer than two are left.
    """
    if every < 0:
        raise ValueError(f"--held-out {every} was given; one view in so many is held out, 0 for none")
    apart = set(range(every // 2 - 1, len(views), every)) if every > 1 else set()
    apart = {number for number in apart if views[number].mask is None or views[number].known_mask.any()}
    told = [view for number, view in enumerate(views) if number not in apart]
    if every == 1 or len(told) < 2:
        raise ValueError(
            f"--held-out {every} leaves too few of {len(views)} views to fit to; give a larger number, or 0"
        )
    return told, [views[number] for number in sorted(apart)]


def fitted(
    run: Run,
    views: Sequence[Photograph],
    shown: Photograph,
    config: ReconstructConfig,
    specs: SurfaceSpecs,
    saving: Every,
) -> Reconstruction:
    """Fits to the end from wherever the folder's checkpoint is; saves now and then, with a look at one view."""
    marks = [fingerprint(view) for view in views]
    state = load_reconstruction(run.out, config, specs, marks, run.device)
    if state.step:
        console.print(f"going on from step {state.step} of {config.total}")
    else:
        for preview in (run.out / "previews").glob("*.png"):
            preview.unlink()  # of a run whose checkpoint was moved away
    depths = _begun(state, views, config)
    names = [view.name for view in views]
    save_json(run.out / "config.json", {**asdict(config), **asdict(specs), "photographs": names})
    due = -(-config.total // PREVIEWS)
    with progress("reconstructing", config.total) as bar:
        for step in reconstruct(views, state, config, depths):
            bar.advance(", ".join(f"{name} {values[-1]:.4f}" for name, values in state.loss_history.items()), to=step)
            if step % due == 0:
                small = judged(state, shown, PREVIEWED)
                save_png(run.out / "previews" / f"{step:07d}.png", small.picture)
            if saving.passed():
                save_reconstruction(run.out, state, config, marks)
    save_reconstruction(run.out, state, config, marks)
    return state


def _begun(state: Reconstruction, views: Sequence[Photograph], config: ReconstructConfig) -> ConsistentDepths:
    """A fresh run begins; the depths that count in the steps that are left."""
    depths, compared = NO_DEPTHS, config.shape_from_colour and state.step < config.steps
    if state.step and not compared:
        return depths
    hull = visual_hull(views)
    if compared:
        console.print("comparing photographs with their neighbours")
        depths = informative_depths(views, hull)
        if len(depths):
            console.print(f"{len(depths):,} depths that photographs agree on tell what outlines do not")
    if not state.step:
        console.print("teaching the network what is known before colours")
        initialise(state, hull, config, depths)
    return depths


def _doubt(view: MaskOverlap) -> str:
    agreed = f"its outline and that of all others have {view.iou:.0%} in common"
    return (
        f"{view.name} does not agree with the others: {agreed}; is its camera right? --leave-out {view.name} drops it"
    )
