"""Loss terms of rays through pixels: colours where the object is hit, outlines elsewhere, and the eikonal term.

After IDR (Yariv et al., NeurIPS 2020, section 3).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.fields.base import value_and_gradient
from distrace.fitting.ray_sampling import band
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.reconstruction.matching import PATCH_WIDTH, PatchMatching
from distrace.reconstruction.networks import ColourNetwork, SurfaceNetwork
from distrace.surface import attach, minimum
from distrace.tracing.sphere_tracing import Trace, TraceConfig, sphere_trace

MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=1e-3, steps=64, least_step=4e-3)
OUTLINE_BAND = 31  # pixels across, from which half of the background's rays are drawn
NEAR_SURFACE = 0.1  # background rays whose least value is larger say nothing
LEAST_SLOPE = 0.2  # |∇f · v| below which a hit does not slide: it would be thrown off the surface, and not come back
SHELL = 0.05  # radii about the surface, for half of the points of the eikonal term
MINIMUM_ROUNDS = 2  # of the search for a ray's least value: to two thousandths of a radius


@dataclass(frozen=True)
class PixelRays:
    """Rays through pixels that meet the unit sphere, and what the photographs show there."""

    rays: Rays
    colours: Float[Tensor, "n 3"]
    is_object: Bool[Tensor, "n"]
    view: Int[Tensor, "n"]
    pixels: Float[Tensor, "n 2"]
    is_inner: Bool[Tensor, "n"]  # a patch about it is object, too, and can be compared

    def __getitem__(self, rows: Tensor) -> "PixelRays":
        return self._mapped(lambda values: values[rows])

    def to(self, device: torch.device) -> "PixelRays":
        return self._mapped(lambda values: values.to(device))

    def moved(self, motions: Float[Tensor, "views 4 4"]) -> "PixelRays":
        """The rays with each view's camera moved, without those that leave the unit sphere; differentiable."""
        rotation = motions[self.view, :3, :3]
        origins = (rotation @ self.rays.origins[..., None])[..., 0] + motions[self.view, :3, 3]
        rays = Rays(origins, (rotation @ self.rays.directions[..., None])[..., 0])
        return replace(self, rays=rays)[_rows(meet_sphere(rays.detach()).meets)]

    def _mapped(self, change: Callable[[Tensor], Tensor]) -> "PixelRays":
        values = (self.colours, self.is_object, self.view, self.pixels, self.is_inner)
        return PixelRays(Rays(change(self.rays.origins), change(self.rays.directions)), *map(change, values))


@dataclass(frozen=True)
class PixelSampler:
    """All pixels of photographs at one size, from which each step draws its rays."""

    pixels: PixelRays
    groups: tuple[Tensor, Tensor, Tensor]  # rows of the object, of the background by its outline, of all background

    @staticmethod
    def of(photographs: Sequence[Photograph]) -> "PixelSampler":
        """Raises `ValueError` for a photograph without a mask, and for masks without object."""
        parts = []
        for number, photograph in enumerate(photographs):
            mask = photograph.known_mask
            rays = photograph.camera.rays().flat()
            near_outline = band(mask, OUTLINE_BAND).reshape(-1)
            values = (
                photograph.image.reshape(-1, 3),
                mask.reshape(-1),
                torch.full_like(near_outline, number, dtype=torch.long),
                photograph.camera.pixels().reshape(-1, 2),
                (mask & ~band(mask, PATCH_WIDTH)).reshape(-1),
            )
            meets = meet_sphere(rays).meets
            parts.append([part[meets] for part in (rays.origins, rays.directions, *values, near_outline)])
        origins, directions, *values, near_outline = (torch.cat(part) for part in zip(*parts, strict=True))
        pixels = PixelRays(Rays(origins, directions), *values)
        is_object = pixels.is_object
        if not is_object.any():
            raise ValueError("the masks of the photographs mark no pixel in the unit sphere as object")
        return PixelSampler(pixels, (_rows(is_object), _rows(~is_object & near_outline), _rows(~is_object)))

    def sample(self, count: int, random: torch.Generator) -> PixelRays:
        """Half of the rays on the object, a quarter beside its outline, and a quarter on all background."""
        shares = (count // 2, count // 4, count - count // 2 - count // 4)
        rows = [
            group[torch.randint(len(group), (share,), generator=random)]
            for group, share in zip(self.groups, shares, strict=True)
            if len(group)
        ]
        return self.pixels[torch.cat(rows)]


def _rows(flags: Bool[Tensor, "n"]) -> Tensor:
    return flags.nonzero()[:, 0]


def loss_terms(
    observed: PixelRays,
    matching: PatchMatching,
    surface: SurfaceNetwork,
    colour: ColourNetwork,
    random: torch.Generator,
    shape_from_colour: bool,
    sharpness: float,
) -> dict[str, Float[Tensor, ""]]:
    """The mean of each term: colour, patches, outline, eikonal.

    Colours and patches change the surface only if `shape_from_colour`. `sharpness` is that of outlines, per radius.
    Differentiable in the rays, too, and in the matching's poses.
    """
    rays = observed.rays.detach()
    bounds = meet_sphere(rays)
    trace = sphere_trace(surface, rays, bounds, MARCH)
    right = trace.hit & observed.is_object
    hits = rays[trace.hit].at(trace.distance[trace.hit])
    shown = observed[right]
    distance = trace.distance[right]
    if shape_from_colour:
        points = shown.rays.at(attach(surface, shown.rays, distance, least_slope=LEAST_SLOPE))
    else:
        points = shown.rays.detach().at(distance)
    normals, features = normals_and_features(surface, points, shape_from_colour)
    rendered = colour(points, normals, shown.rays.directions, features)
    patches = rendered.new_zeros(())
    if shape_from_colour:
        inner = [part[shown.is_inner] for part in (shown.view, shown.pixels, points, normals)]
        patches = matching.loss(surface, *inner)
    return {
        "colour": (rendered - shown.colours).abs().sum() / 3 / observed.is_object.sum().clamp_min(1),
        "patches": patches,
        "outline": _outline_term(observed, bounds, trace, ~right | ~observed.is_inner, surface, sharpness),
        "eikonal": _eikonal_term(hits, surface, random),
    }


def normals_and_features(
    surface: SurfaceNetwork, points: Float[Tensor, "n 3"], differentiable: bool = True
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n features"]]:
    """Unit normals and features at points; constants unless `differentiable` and grad mode is on."""
    keep = torch.is_grad_enabled() and differentiable
    with torch.enable_grad():
        inputs = points if points.requires_grad else points.detach().requires_grad_()
        value, features = surface.features(inputs)
        (gradient,) = torch.autograd.grad(value.sum(), inputs, retain_graph=keep, create_graph=keep)
    normals = F.normalize(gradient, dim=-1)
    return (normals, features) if keep else (normals.detach(), features.detach())


def surface_colours(
    surface: SurfaceNetwork, colour: ColourNetwork, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Colours of points of the surface as rays of these directions see them."""
    normals, features = normals_and_features(surface, points)
    return colour(points, normals, directions, features)


def _outline_term(
    observed: PixelRays,
    bounds: Bounds,
    trace: Trace,
    compared: Bool[Tensor, "n"],
    surface: SurfaceNetwork,
    sharpness: float,
) -> Float[Tensor, ""]:
    """The cross entropy of the compared rays' least values, divided by the number of all rays.

    IDR compares rays that miss the object or should: background that is rightly missed pushes outlines inwards, and
    nothing pulls. Here object that is rightly hit beside an outline does.
    """
    rows = _rows(compared)
    with torch.no_grad():
        near = surface(observed.rays[rows].at(trace.closest[rows])) < NEAR_SURFACE
    rows = rows[near | observed.is_object[rows]]
    rays = observed.rays[rows]
    within = Bounds(bounds.near[rows], bounds.far[rows])
    values = surface(rays.at(minimum(surface, rays, trace.closest[rows], within, reach=SHELL, refine=MINIMUM_ROUNDS)))
    target = observed.is_object[rows].to(values)
    entropy = F.binary_cross_entropy_with_logits(-sharpness * values, target, reduction="sum")
    return entropy / sharpness / len(compared)


def _eikonal_term(hits: Float[Tensor, "n 3"], surface: SurfaceNetwork, random: torch.Generator) -> Float[Tensor, ""]:
    """`eikonal` at points anywhere, and about the surface (Gropp et al., ICML 2020)."""
    anywhere = 2 * torch.rand(max(len(hits), 1), 3, generator=random) - 1
    about = hits + (SHELL * torch.randn(hits.shape, generator=random)).to(hits)
    _, gradient = value_and_gradient(surface, torch.cat([anywhere.to(hits), about]))
    return eikonal(gradient)


def eikonal(gradient: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean of (|∇f| − 1)²."""
    return (gradient.norm(dim=-1) - 1).square().mean()
