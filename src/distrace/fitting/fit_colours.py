"""Fits the colours of a placed shape, and the light on it, to photographs."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from distrace.checkpoints.colours import Colours
from distrace.colour_space import to_linear, to_srgb
from distrace.data.photograph import Photograph
from distrace.fields.base import SDF
from distrace.fitting.rounds import Progress
from distrace.lights import HARMONICS, SphericalHarmonics, white_in_harmonics
from distrace.pose import Similarity
from distrace.render import render

CANDIDATES = 64  # training palettes (colours of a whole shape) that are compared before the fit
CANDIDATE_POINTS = 400
LARGEST = 256  # pixels along the longer side of photographs: a step compares a thousand points
RIDGE = 0.03  # of the light's coefficients in that comparison, for each point
USUAL_BRIGHTNESS = 0.7  # of a white surface in a photograph: brightness and albedo are ambiguous


@dataclass(frozen=True)
class ColourFitConfig:
    """Adam on colour code and light."""

    steps: int = 120
    points: int = 1000  # in each step
    learning_rate: float = 0.03
    code_weight: float = 1e-3  # of the colour code's mean square
    tint_weight: float = 0.02  # of how much the light's red, green and blue differ
    brightness_weight: float = 0.01  # of the squared logarithm of how far it is from USUAL_BRIGHTNESS
    seed: int = 0


@dataclass(frozen=True)
class ColourFit:
    """A colour code, the light of all photographs or of each, in the world's axes, and the losses."""

    colour_code: Float[Tensor, "colour"]
    light: Float[Tensor, "lights 9 3"]
    losses: list[float]

    def light_of(self, view: int) -> SphericalHarmonics:
        """Returns the light of a photograph."""
        return SphericalHarmonics(self.light[view % len(self.light)])


def fit_colours(
    colours: Colours,
    photographs: Sequence[Photograph],
    sdf: SDF,
    code: Float[Tensor, "length"],
    place: Similarity,
    config: ColourFitConfig = ColourFitConfig(),
    same_light: bool = True,
    progress: Progress | None = None,
) -> ColourFit:
    """Finds the colours of a shape with the field `sdf` and a code, from where photographs show it.

    All are on one device. Surfaces count as matt, and lights as far away and without shadows: harmonics up to degree 2.
    A brighter light and a darker surface look alike: only their product is found. Raises `ValueError` where no
    photograph shows the shape.
    """
    random = torch.Generator().manual_seed(config.seed)
    seen = _seen_surface(photographs, sdf, place)
    colour, light = _best_palette(colours, seen, code, config, random)
    colour = colour.clone().requires_grad_()
    light = light.repeat(1 if same_light else len(photographs), 1, 1).requires_grad_()
    adam = torch.optim.Adam([colour, light], lr=config.learning_rate)
    losses = []
    for step in range(config.steps):
        part = seen.drawn(config.points, random)
        brightness = torch.einsum("nh,nhc->nc", part.white, light[part.view % len(light)])
        albedo = to_linear(colours.decoder(part.points, part.normals, code, colour))
        tint = (light - light.mean(-1, keepdim=True)).square().mean()
        loss = (to_srgb(albedo * brightness) - part.colours).abs().mean()
        loss = loss + config.code_weight * colour.square().mean() + config.tint_weight * tint
        loss = loss + config.brightness_weight * _brightness_prior(brightness)
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
        if progress is not None:
            progress(step + 1)
    return ColourFit(colour.detach(), light.detach(), losses)


@dataclass(frozen=True)
class _Samples:
    """Points of a surface in the object's frame, and what the photographs show there."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    white: Float[Tensor, "n 9"]  # how bright each harmonic of the world makes a white surface
    colours: Float[Tensor, "n 3"]  # sRGB
    view: Int[Tensor, "n"]

    def drawn(self, count: int, random: torch.Generator) -> "_Samples":
        """Returns some of the points, or all where there are fewer."""
        rows = torch.randperm(len(self.points), generator=random)[:count].to(self.points.device)
        return _Samples(self.points[rows], self.normals[rows], self.white[rows], self.colours[rows], self.view[rows])


@torch.no_grad()
def _seen_surface(photographs: Sequence[Photograph], sdf: SDF, place: Similarity) -> _Samples:
    """Returns all points of a shape that the photographs show; masks, where they are known, leave out what hides it."""
    parts = []
    occupancy = None
    for number, full in enumerate(photographs):
        view = full.at_most(LARGEST)
        buffers = render(sdf, place.camera_in_object(view.camera), occupancy=occupancy)
        occupancy = buffers.occupancy
        shown = buffers.mask if view.mask is None else buffers.mask & view.mask
        normals = buffers.normal[shown]
        white = white_in_harmonics(place.turned(normals))
        views = torch.full((len(normals),), number, device=normals.device)
        parts.append(_Samples(buffers.points[shown[buffers.mask]], normals, white, view.image[shown], views))
    seen = _Samples(*(torch.cat([getattr(part, name) for part in parts]) for name in _Samples.__dataclass_fields__))
    if not len(seen.points):
        raise ValueError("no photograph shows the shape; its colours cannot be found")
    return seen


@torch.no_grad()
def _best_palette(
    colours: Colours,
    seen: _Samples,
    code: Float[Tensor, "length"],
    config: ColourFitConfig,
    random: torch.Generator,
) -> tuple[Float[Tensor, "colour"], Float[Tensor, "9 3"]]:
    """Returns the training palette, or their mean, and the light that explain the colours best."""
    part = seen.drawn(CANDIDATE_POINTS, random)
    chosen = torch.randperm(len(colours.codes), generator=random)[:CANDIDATES].to(colours.codes.device)
    candidates = torch.cat([colours.codes.mean(0, keepdim=True), colours.codes[chosen]])
    found = []
    losses = []
    for candidate in candidates:
        albedo = to_linear(colours.decoder(part.points, part.normals, code, candidate))
        light = fitted_light(part.white, albedo, to_linear(part.colours))
        brightness = part.white @ light
        loss = (to_srgb(albedo * brightness) - part.colours).abs().mean()
        found.append(light)
        losses.append(loss + config.brightness_weight * _brightness_prior(brightness))
    best = int(torch.stack(losses).argmin())
    return candidates[best], found[best]


def _brightness_prior(brightness: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """Returns the squared logarithm of how much brighter or darker white would be than in most photographs."""
    return (brightness.mean().clamp_min(0.01) / USUAL_BRIGHTNESS).log().square()


def fitted_light(
    white: Float[Tensor, "n 9"], albedo: Float[Tensor, "n 3"], colours: Float[Tensor, "n 3"]
) -> Float[Tensor, "9 3"]:
    """Returns the harmonics' coefficients that explain linear colours of known albedo best, channel by channel."""
    ridge = RIDGE * len(white) * torch.eye(HARMONICS).to(white)
    columns = []
    for channel in range(3):
        basis = white * albedo[:, channel, None]
        columns.append(torch.linalg.solve(basis.T @ basis + ridge, basis.T @ colours[:, channel]))
    return torch.stack(columns, dim=1)
