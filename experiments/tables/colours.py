"""Colours of held-out textured shapes from photographs, against Mitsuba's renderings of the truth.

Photographs, new views and new lights are rendered by a path tracer, with shadows and light between surfaces, which our
lights do not have. The shape comes from the silhouettes; it is placed as its class.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checkpoints.colours import Colours, load_colours
from distrace.checkpoints.model import Model
from distrace.colour_space import to_linear, to_srgb
from distrace.data.patches import Patch, in_unit_sphere, load_patches
from distrace.data.photograph import Photograph
from distrace.fields.colour import Albedo
from distrace.files import save_json
from distrace.fitting.fit_code import CodeFitConfig
from distrace.fitting.fit_colours import ColourFitConfig, fit_colours, fitted_light
from distrace.lights import Ambient, Directional, Light, SphericalHarmonics, lit, white_in_harmonics
from distrace.photos.silhouettes import shape_of_silhouettes
from distrace.pose import Similarity
from distrace.render import Buffers, render
from distrace.shading import Picture, colour_picture, grid, save_png
from distrace.viewpoint import orbiting
from experiments.clips.mitsuba_scene import Stage, in_lights, photograph, truth
from experiments.datasets.solids import mesh_of
from experiments.datasets.splits import on_side
from experiments.tables.trials import Place, fingerprint, grouped, hash_of, read_json

NEW_VIEWS = 2
SIZE = 96  # pixels
DISTANCE = 3.6  # radii: the shape fills the image
SAMPLES = 48  # light paths a pixel
METHODS = ("ours", "one colour")


@dataclass(frozen=True)
class ColourTrial:
    """A held-out shape, seen in some photographs."""

    category: str
    shape: str
    photographs: int

    @property
    def file(self) -> str:
        return f"{self.category}_{self.shape}_{self.photographs}.json"


@dataclass(frozen=True)
class Agreement:
    """Peak signal-to-noise ratios in decibels, and the agreement of silhouettes in new views."""

    method: str
    psnr_views: float  # where either shape is seen
    psnr_views_colour: float  # where both are seen: the colours alone
    psnr_light: float
    psnr_light_colour: float
    iou: float


@dataclass(frozen=True)
class Truth:
    """What is rendered of a shape: photographs, and new views in the same light and in another one."""

    photographs: list[Photograph]
    views: list[Photograph]
    relit: list[Photograph]
    new_light: list[Light]


def colour_trials(categories: Sequence[str], shapes: int | None, photographs: Sequence[int]) -> list[ColourTrial]:
    """Returns trials of held-out shapes, drawn at random by their names' hashes."""
    trials = []
    for category in categories:
        names = sorted((shape.name for shape in on_side("test", category)), key=hash_of)
        trials += [ColourTrial(category, name, count) for name in names[:shapes] for count in photographs]
    return trials


def coloured(place: Place, trial: ColourTrial) -> tuple[ColourTrial, list[Agreement]]:
    """Returns a trial's agreements, read from the file of a run with the same model and settings, or computed."""
    path = place.out / "trials" / trial.file
    model = place.model_of(trial.category)
    colours = load_colours(dict(place.models)[trial.category])
    if colours is None:
        raise ValueError(f"{model.name} has no colours; `distrace train --colour` adds some")
    mark = fingerprint(model, SIZE, SAMPLES, CodeFitConfig(), ColourFitConfig(), network=colours.decoder)
    if path.is_file():
        content = read_json(path)
        if content["made_by"] == mark:
            return trial, [Agreement(**each) for each in content["agreements"]]
    true = rendered_truth(place.meshes, trial)
    fitted = _fitted(model, colours, true.photographs)
    agreements = []
    pictures = {}
    views = _rendered(model, fitted[0], [view.camera for view in true.views])
    for method, shape in zip(METHODS, fitted):
        predicted = [_picture(buffers, shape, [shape.light]) for buffers in views]
        relit = [_picture(buffers, shape, true.new_light) for buffers in views]
        scale = _brightness(relit, true.relit)
        relit = [(colour * scale, mask) for colour, mask in relit]
        whole = mean(_psnr(each, view) for each, view in zip(predicted, true.views))
        colour = mean(_psnr(each, view, within=True) for each, view in zip(predicted, true.views))
        light = mean(_psnr(each, view) for each, view in zip(relit, true.relit))
        relit_colour = mean(_psnr(each, view, within=True) for each, view in zip(relit, true.relit))
        iou = mean(_iou(mask, view) for (_, mask), view in zip(predicted, true.views))
        agreements.append(Agreement(method, whole, colour, light, relit_colour, iou))
        pictures[method] = [_shown(predicted[0]), _shown(relit[0])]
    save_json(path, {"made_by": mark, "agreements": [asdict(each) for each in agreements]})
    _save_pictures(path.with_suffix(".png"), true, pictures)
    return trial, agreements


def colour_rows(results: Sequence[tuple[ColourTrial, list[Agreement]]]) -> list[dict[str, Any]]:
    """Returns the means of each class, number of photographs and method."""
    each = [(trial, agreement) for trial, agreements in results for agreement in agreements]
    rows = []
    groups = grouped(each, lambda pair: (pair[0].category, pair[0].photographs, pair[1].method))
    for (category, photographs, method), pairs in groups.items():
        found = [agreement for _, agreement in pairs]
        rows.append(
            {
                "class": category,
                "photographs": photographs,
                "method": method,
                "psnr_new_views": round(mean(each.psnr_views for each in found), 2),
                "psnr_new_views_colour": round(mean(each.psnr_views_colour for each in found), 2),
                "psnr_new_light": round(mean(each.psnr_light for each in found), 2),
                "psnr_new_light_colour": round(mean(each.psnr_light_colour for each in found), 2),
                "silhouette_iou": round(mean(each.iou for each in found), 3),
                "n": len(found),
            }
        )
    return rows


def rendered_truth(meshes: Path, trial: ColourTrial) -> Truth:
    """Renders a shape in a random light, and again in another one."""
    shape = next(each for each in on_side("test", trial.category) if each.name == trial.shape)
    patches = in_unit_sphere(load_patches(mesh_of(shape, meshes)), shape.turn)
    random = np.random.default_rng(hash_of(trial.shape))
    first, second = (_lights(random) for _ in range(2))
    cameras = [_camera(random, azimuth) for azimuth in _azimuths(random, 8)]
    new = [_camera(random, azimuth) for azimuth in _azimuths(random, NEW_VIEWS)]
    seen = _photographs(patches, first, cameras[: trial.photographs])
    return Truth(seen, _photographs(patches, first, new), _photographs(patches, second, new), second)


def _azimuths(random: np.random.Generator, count: int) -> Float[np.ndarray, "count"]:
    """Returns directions all around, about evenly; the first is anywhere."""
    around = 360 / count * (np.arange(count) + random.uniform(-0.3, 0.3, count))
    return around + random.uniform(0, 360)


def _camera(random: np.random.Generator, azimuth: float) -> Camera:
    return Camera.orbit(float(azimuth), random.uniform(5, 45), DISTANCE, height=SIZE, width=SIZE)


def _lights(random: np.random.Generator) -> list[Light]:
    """Returns slightly tinted light from everywhere, and a sun somewhere above."""
    tint = torch.from_numpy(random.uniform(0.9, 1.1, (2, 3))).float()
    share = random.uniform(0.35, 0.6)
    sun = orbiting(random.uniform(0, 360), random.uniform(20, 70), 1.0)
    return [Ambient(share * tint[0]), Directional(sun, (1 - share) * 1.2 * tint[1])]


def _photographs(patches: Sequence[Patch], lights: Sequence[Light], cameras: Sequence[Camera]) -> list[Photograph]:
    stage = in_lights(patches, lights)
    return [_photograph(stage, camera, number) for number, camera in enumerate(cameras)]


def _photograph(stage: Stage, camera: Camera, number: int) -> Photograph:
    image = torch.from_numpy(photograph(stage, camera, SAMPLES, number)).float() / 255
    return Photograph(f"{number:02d}", camera, image, torch.from_numpy(truth(stage, camera)[0]))


@dataclass(frozen=True)
class ColouredShape:
    """A placed shape with its albedo, in the light of the photographs."""

    code: Float[Tensor, "length"]
    place: Similarity
    albedo: Albedo
    light: Light


def _fitted(model: Model, colours: Colours, photographs: Sequence[Photograph]) -> list[ColouredShape]:
    """Returns the shape by each method."""
    last = shape_of_silhouettes(model, photographs).last
    fit = fit_colours(colours, photographs, model.field(last.code), last.code, last.place)
    albedo = colours.decoder.albedo(last.code, fit.colour_code)
    ours = ColouredShape(last.code, last.place, albedo, fit.light_of(0))
    return [ours, _of_one_colour(model, photographs, last.code, last.place)]


def _of_one_colour(
    model: Model, photographs: Sequence[Photograph], code: Float[Tensor, "length"], place: Similarity
) -> ColouredShape:
    """Returns the shape in white, and the light that explains the photographs best, its tint being the shape's."""
    white = []
    seen = []
    for view in photographs:
        buffers = render(model.field(code), place.camera_in_object(view.camera))
        both = buffers.mask & view.known_mask
        white.append(white_in_harmonics(place.turned(buffers.normal[both])))
        seen.append(to_linear(view.image[both]))
    colours = torch.cat(seen)
    light = SphericalHarmonics(fitted_light(torch.cat(white), torch.ones_like(colours), colours))
    return ColouredShape(code, place, lambda points, normals: torch.ones_like(points), light)


@torch.no_grad()
def _rendered(model: Model, shape: ColouredShape, cameras: Sequence[Camera]) -> list[Buffers]:
    """Returns what cameras see of a shape; its field is measured once."""
    field = model.field(shape.code)
    views: list[Buffers] = []
    for camera in cameras:
        occupancy = views[0].occupancy if views else None
        views.append(render(field, shape.place.camera_in_object(camera), occupancy=occupancy))
    return views


@torch.no_grad()
def _picture(buffers: Buffers, shape: ColouredShape, lights: Sequence[Light]) -> tuple[Tensor, Tensor]:
    """Returns linear colours, black where nothing is seen, and the mask; the placement is the world's own."""
    return shade(buffers, lit(shape.albedo, lights), torch.zeros(3)), buffers.mask


def _brightness(pictures: Sequence[tuple[Tensor, Tensor]], true: Sequence[Photograph]) -> Float[Tensor, "3"]:
    """Returns the factor of each channel that fits best: photographs do not tell a dark surface from little light."""
    ours = torch.cat([colour[mask & view.known_mask] for (colour, mask), view in zip(pictures, true)])
    theirs = torch.cat([to_linear(view.image[mask & view.known_mask]) for (_, mask), view in zip(pictures, true)])
    return (ours * theirs).sum(0) / ours.square().sum(0).clamp_min(1e-6)


def _psnr(picture: tuple[Tensor, Tensor], true: Photograph, within: bool = False) -> float:
    """Returns decibels where either shape is seen, both on white; or, `within`, where both are."""
    colour, mask = picture
    chosen = mask & true.known_mask if within else mask | true.known_mask
    ours = torch.where(mask[..., None], to_srgb(colour).clamp(0, 1), 1.0)
    theirs = torch.where(true.known_mask[..., None], true.image, 1.0)
    error = float((ours - theirs)[chosen].square().mean())
    return -10 * math.log10(max(error, 1e-10))


def _iou(mask: Tensor, true: Photograph) -> float:
    return float((mask & true.known_mask).sum() / (mask | true.known_mask).sum().clamp_min(1))


def _shown(picture: tuple[Tensor, Tensor]) -> Picture:
    colour, mask = picture
    return colour_picture(torch.where(mask[..., None], to_srgb(colour), 1.0))


def _save_pictures(path: Path, true: Truth, pictures: dict[str, list[Picture]]) -> None:
    """Writes a photograph, and a new view and a new light of the truth and of each method, one below the other."""
    white = [torch.where(each.known_mask[..., None], each.image, 1.0) for each in (true.views[0], true.relit[0])]
    rows = [[colour_picture(each) for each in white], *pictures.values()]
    first = colour_picture(true.photographs[0].image)
    save_png(path, grid([[first, *row] for row in rows]))
