"""`multiview`: a shape from photographs with known cameras, by a model of its class."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from distrace.checkpoints.codes import save_code
from distrace.checkpoints.colours import colours_of
from distrace.checkpoints.model import Model
from distrace.cli.common import Flag, Format, ModelName, Views, check_formats, opened_for, save_meshes
from distrace.cli.console import console, progress, start
from distrace.cli.multiview_colours import find_colours
from distrace.coloured import coloured_mesh
from distrace.data.photo_readers.transforms import save_transforms
from distrace.data.photographs import Photograph, Photographs, load_photographs, notes
from distrace.fields.colour import Albedo
from distrace.files import save_text
from distrace.fitting.fit_colours import ColourFit
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world
from distrace.movie import save_gif
from distrace.photos.fit_photos import KNOWN_PLACE, UNKNOWN_PLACE, PhotoConfig, PhotoFit, PhotoStep, fit_photos
from distrace.photos.judge import ViewAgreement, view_agreements
from distrace.photos.photo_set import PhotoSet
from distrace.photos.problem import ComparisonConfig, PlacedShape
from distrace.photos.silhouettes import shape_of_silhouettes
from distrace.prior import prior_of
from distrace.report.views_page import colours_beside, forming, views_page
from distrace.shading import Picture

if TYPE_CHECKING:
    import trimesh

COLOURED_VIEWS = 4  # on the page


@dataclass(frozen=True)
class Multiview:
    """Find a shape and its placement from photographs with known cameras.

    It needs a model of the object's class. It uses masks where the folder has some. With --fixed a single photograph
    with a mask is enough; there, and with --colour where all have masks, the silhouettes alone tell the shape.
    """

    model: tyro.conf.Positional[ModelName]
    views: tyro.conf.Positional[Views]
    out: Path = Path("out/multiview")
    starts: int = PhotoConfig.starts  # of the multi-start fit
    fixed: Flag = False  # find only the code: the object is placed as the model's shapes are
    changing_light: Flag = False  # ignore local brightness and contrast of colours
    ignore_masks: Flag = False  # use no masks
    colour: Flag = False  # also find its colours and the light, by a model that has colours
    size: int = 1024  # pixels along the longer side; larger photographs are scaled down
    rays: int = ComparisonConfig.rays  # of all views together, in each round
    resolution: int = 256  # cells along each side of the mesh's grid
    format: tuple[Format, ...] = ("ply",)  # of the mesh, one or several
    seed: int = 0
    device: str = "cpu"

    def run(self) -> None:
        check_formats(self.format)
        run = start(self.out, self.device)
        resolved = MeshConfig(self.resolution, device=run.device)
        model = opened_for(run, self.model)
        found = load_photographs(self.views, 1 if self.fixed else 2)  # of one, the silhouette tells the shape
        console.print(f"{len(found.views)} views, {found.layout}; {_described(found)}")
        for note in notes(found):
            console.print(note)
        if self.size < 8:
            raise ValueError(f"--size {self.size} was given; at least 8 pixels are needed")
        views = [view.at_most(self.size).to(run.device) for view in found.views]
        views = [replace(view, mask=None) for view in views] if self.ignore_masks else views
        usual = KNOWN_PLACE if self.fixed else UNKNOWN_PLACE
        comparison = replace(usual.comparison, rays=self.rays, same_light=not self.changing_light)
        config = replace(usual, starts=self.starts, seed=self.seed, comparison=comparison)
        colours = colours_of(model, self.model) if self.colour else None
        masked = all(view.mask is not None for view in views)
        by_silhouettes = self.fixed and (len(views) == 1 or (self.colour and masked))
        fit = shape_of_silhouettes(model, views) if by_silhouettes else _fitted(model, views, config)
        last = fit.last
        coloured = None
        albedo = None
        if colours is not None:
            coloured = find_colours(run, model, colours, views, last, not self.changing_light)
            albedo = colours.decoder.albedo(last.code, coloured.colour_code)
        agreed = _agreements(model, views, last, comparison)
        for view in agreed:
            if view.is_outlier:
                run.warn(_doubt(view))
        mesh = _mesh(model, last, found, resolved, albedo)
        save_meshes(run.out, mesh, self.format)
        save_code(run.out, last.code)
        save_gif(run.out / "forming.gif", forming(model, fit.steps, views[0].camera))
        with run.optional("report.html"):
            page = views_page(model, views, fit.steps, agreed, mesh, _pictures(model, views, last, coloured, albedo))
            save_text(run.out / "report.html", page)
        save_transforms(run.out, {view.name: view.source for view in found.views if view.source is not None})
        run.finish(
            {
                "loss": last.loss,
                "terms": last.terms,
                "start": last.start,
                "T_unit_object": last.place.T_world_object.tolist(),
                "unit_sphere": found.unit_sphere.described(),
                "doubtful": [view.name for view in agreed if view.is_outlier],
                "light": None if coloured is None else coloured.light.tolist(),
                "evaluations": fit.evaluations,
                "setup_evaluations": fit.setup_evaluations,
            }
        )


def _fitted(model: Model, views: Sequence[Photograph], config: PhotoConfig) -> PhotoFit:
    with progress("fitting", config.total) as bar:

        def advance(step: PhotoStep) -> None:
            bar.advance(f"{step.name}, loss {step.loss:.4f}")

        return fit_photos(model.decoder, views, prior_of(model.codes), config, callback=advance)


def _agreements(
    model: Model, views: Sequence[Photograph], step: PhotoStep, config: ComparisonConfig
) -> Sequence[ViewAgreement]:
    """Returns how well each view agrees with the others; of a single one, nothing."""
    if len(views) == 1:
        return []
    prior = prior_of(model.codes)
    photos = PhotoSet(model.decoder, [view.resized(0.5) for view in views], prior, config)
    return view_agreements(photos, PlacedShape(prior.coordinates(step.code), step.place))


def _pictures(
    model: Model, views: Sequence[Photograph], step: PhotoStep, fit: ColourFit | None, albedo: Albedo | None
) -> list[list[Picture]]:
    """Returns a few photographs, each beside the coloured shape in the light that was found, and in another one."""
    if fit is None or albedo is None:
        return []
    shown = enumerate(views[:COLOURED_VIEWS])
    return [colours_beside(model, view, step, albedo, fit.light_of(number)) for number, view in shown]


def _mesh(
    model: Model, step: PhotoStep, found: Photographs, config: MeshConfig, albedo: Albedo | None
) -> "trimesh.Trimesh":
    """Returns the mesh in the folder's world, with the colours of its vertices where they are known."""
    surface = extract_mesh(model.field(step.code), config)
    if albedo is not None:
        surface = coloured_mesh(surface, albedo, step.code.device)
    mesh_unit = mesh_in_world(surface, step.place)
    return mesh_in_world(mesh_unit, found.unit_sphere.similarity)


def _described(found: Photographs) -> str:
    centre = ", ".join(f"{x:.4g}" for x in found.unit_sphere.centre.tolist())
    return f"the unit sphere lies around ({centre}) with a radius of {found.unit_sphere.radius:.4g}"


def _doubt(view: ViewAgreement) -> str:
    return f"{view.name} does not agree with the others: its colours are off by {view.colour:.2f}; is its camera right?"
