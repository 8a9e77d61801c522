"""What a reconstruction is told by pixels: colours where object was hit, outlines elsewhere, and what a distance is.

After IDR (Yariv et al., NeurIPS 2020, section 3).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.fields.base import value_and_gradient
from distrace.fitting.ray_sampling import band
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.reconstruction.matching import ACROSS, Matching
from distrace.reconstruction.surface_network import ColourNetwork, Surface
from distrace.surface import attach, minimum
from distrace.tracing.sphere_tracing import Trace, TraceConfig, sphere_trace

MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=1e-3, steps=64, least_step=4e-3)
NEAR_OUTLINE = 31  # pixels across the band from which half of the background's rays are drawn
FAR_OFF = 0.1  # rays of the background that come no closer have nothing to say
GRAZING = 0.2  # rays that meet the surface more flatly do not slide: they would be thrown off it, and not come back
SHELL = 0.05  # around the surface, in which half of the points lie whose gradient should have length 1
REFINED = 2  # rounds of the search for a ray's least value: to two thousandths


@dataclass(frozen=True)
class Pixels:
    """Rays that meet the unit sphere, and what photographs show there."""

    rays: Rays
    colours: Float[Tensor, "n 3"]
    is_object: Bool[Tensor, "n"]
    view: Int[Tensor, "n"]  # the photograph's number
    places: Float[Tensor, "n 2"]  # in the photograph
    is_inner: Bool[Tensor, "n"]  # all about it is object, too, so that it can be compared as a patch

    def __getitem__(self, rows: Tensor) -> "Pixels":
        return Pixels(self.rays[rows], *(fact[rows] for fact in self._facts))

    def moved(self, motions: Float[Tensor, "views 4 4"]) -> "Pixels":
        """The same with each view's rays moved, but for those that leave the unit sphere; differentiable."""
        turn, shift = motions[self.view, :3, :3], motions[self.view, :3, 3]
        origins = (turn @ self.rays.origins[..., None])[..., 0] + shift
        moved = Rays(origins, (turn @ self.rays.directions[..., None])[..., 0])
        return Pixels(moved, *self._facts)[_rows(meet_sphere(moved.detach()).meets)]

    def to(self, device: torch.device) -> "Pixels":
        rays = Rays(self.rays.origins.to(device), self.rays.directions.to(device))
        return Pixels(rays, *(fact.to(device) for fact in self._facts))

    @property
    def _facts(self) -> tuple[Tensor, ...]:
        return self.colours, self.is_object, self.view, self.places, self.is_inner


@dataclass(frozen=True)
class Pool:
    """All pixels of photographs of one size, from which those of a step are drawn."""

    pixels: Pixels
    groups: tuple[Tensor, Tensor, Tensor]  # rows of the object, of the background by the outline, of all background

    @staticmethod
    def of(photographs: Sequence[Photograph]) -> "Pool":
        """Raises `ValueError` for a photograph without a mask, and for masks without object."""
        parts = []
        for number, each in enumerate(photographs):
            mask, rays = each.known_mask, each.camera.rays().flat()
            meets, near = meet_sphere(rays).meets, band(mask, NEAR_OUTLINE).reshape(-1)
            view, places = torch.full_like(near, number, dtype=torch.long), each.camera.pixels().reshape(-1, 2)
            inner = mask & ~band(mask, ACROSS)
            facts = (each.image.reshape(-1, 3), mask.reshape(-1), view, places, inner.reshape(-1), near)
            parts.append([part[meets] for part in (rays.origins, rays.directions, *facts)])
        origins, directions, *facts, near = (torch.cat(part) for part in zip(*parts, strict=True))
        pixels = Pixels(Rays(origins, directions), *facts)
        is_object = pixels.is_object
        if not is_object.any():
            raise ValueError("the masks of the photographs mark no pixel in the unit sphere as object")
        return Pool(pixels, (_rows(is_object), _rows(~is_object & near), _rows(~is_object)))

    def drawn(self, count: int, random: torch.Generator) -> Pixels:
        """Half of them of the object, a quarter of the background by its outlines."""
        shares = (count // 2, count // 4, count - count // 2 - count // 4)
        rows = [
            group[torch.randint(len(group), (share,), generator=random)]
            for group, share in zip(self.groups, shares, strict=True)
            if len(group)
        ]
        return self.pixels[torch.cat(rows)]


def _rows(some: Bool[Tensor, "n"]) -> Tensor:
    return some.nonzero()[:, 0]


def terms_of(
    pixels: Pixels,
    matching: Matching,
    surface: Surface,
    colour: ColourNetwork,
    random: torch.Generator,
    shapes: bool,
    sharpness: float,
) -> dict[str, Tensor]:
    """The mean of each term. Colours and patches pull at the surface where they are to tell `shapes`.

    Differentiable in the rays, too, and in the matching's poses.
    """
    rays = pixels.rays.detach()
    bounds = meet_sphere(rays)
    trace = sphere_trace(surface, rays, bounds, MARCH)
    right = trace.hit & pixels.is_object
    points = rays[trace.hit].at(trace.distance[trace.hit])
    seen, distance = pixels[right], trace.distance[right]
    if shapes:
        seen_at = seen.rays.at(attach(surface, seen.rays, distance, least_slope=GRAZING))
    else:
        seen_at = seen.rays.detach().at(distance)
    normals, features = described(surface, seen_at, shapes)
    made = colour(seen_at, normals, seen.rays.directions, features)
    inner = [part[seen.is_inner] for part in (seen.view, seen.places, seen_at, normals)]
    return {
        "colour": (made - seen.colours).abs().sum() / 3 / pixels.is_object.sum().clamp_min(1),
        "patches": matching.term(surface, *inner) if shapes else made.new_zeros(()),
        "outline": _outline_term(pixels, bounds, trace, ~right | ~pixels.is_inner, surface, sharpness),
        "eikonal": _eikonal_term(points, surface, random),
    }


def described(
    surface: Surface, points: Float[Tensor, "n 3"], shapes: bool = True
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n features"]]:
    """Normals and features at points; without `shapes` nothing pulls at the surface through them."""
    keep = torch.is_grad_enabled() and shapes
    with torch.enable_grad():
        asked = points if points.requires_grad else points.detach().requires_grad_()
        value, features = surface.features(asked)
        (gradient,) = torch.autograd.grad(value.sum(), asked, retain_graph=keep, create_graph=keep)
    normals = F.normalize(gradient, dim=-1)
    return (normals, features) if keep else (normals.detach(), features.detach())


def coloured(
    surface: Surface, colour: ColourNetwork, points: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]
) -> Float[Tensor, "n 3"]:
    """Colours of points of the surface, as rays of these directions see them."""
    normals, features = described(surface, points)
    return colour(points, normals, directions, features)


def _outline_term(
    pixels: Pixels, bounds: Bounds, trace: Trace, asked: Bool[Tensor, "n"], surface: Surface, sharpness: float
) -> Float[Tensor, ""]:
    """Cross entropy of some rays' least values, as a share of all rays.

    IDR asks those that miss the object or should: background that is rightly missed pushes outlines inwards, and
    nothing pulls. Here object that is rightly hit, by an outline, does.
    """
    rows = _rows(asked)
    with torch.no_grad():
        close = surface(pixels.rays[rows].at(trace.closest[rows])) < FAR_OFF
    rows = rows[close | pixels.is_object[rows]]
    rays, closest = pixels.rays[rows], trace.closest[rows]
    within = Bounds(bounds.near[rows], bounds.far[rows])
    values = surface(rays.at(minimum(surface, rays, closest, within, reach=SHELL, refine=REFINED)))
    object_is_there = pixels.is_object[rows].to(values)
    lacking = F.binary_cross_entropy_with_logits(-sharpness * values, object_is_there, reduction="sum")
    return lacking / sharpness / len(asked)


def _eikonal_term(hits: Float[Tensor, "n 3"], surface: Surface, random: torch.Generator) -> Float[Tensor, ""]:
    """At points anywhere and about the surface (Gropp et al., ICML 2020)."""
    count = max(len(hits), 1)
    anywhere = 2 * torch.rand(count, 3, generator=random) - 1
    about = hits + (SHELL * torch.randn(hits.shape, generator=random)).to(hits)
    _, gradient = value_and_gradient(surface, torch.cat([anywhere.to(hits), about]))
    return unit_length(gradient)


def unit_length(gradient: Float[Tensor, "n 3"]) -> Float[Tensor, ""]:
    """The mean of (|∇f| − 1)²."""
    return (gradient.norm(dim=-1) - 1).square().mean()
