"""Images in colour whose gradient knows of outlines: a loss on them moves the edge of a shape, without any mask.

A pixel changes because what it sees changes, and because an outline moves across it. The first is the derivative of
each hit. The second is an integral along all outlines, of the step in colour times the outline's motion (Li et al.,
*Differentiable Monte Carlo Ray Tracing through Edge Sampling*, SIGGRAPH Asia 2018). Wang et al. (*A Simple Approach to
Differentiable Rendering of SDFs*, SIGGRAPH Asia 2024) widen it to a band; here it is a sum over the places where
outlines cross the lines that join the centres of neighbouring pixels, which needs no width.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from distrace import surface
from distrace.fields.base import SDF, at_rows, value_and_gradient
from distrace.rays import Bounds, Rays
from distrace.render import Buffers

Colour = Callable[[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]], Float[Tensor, "n channels"]]
"""From points, unit normals and ray directions to colours."""

UNEXPLAINED = 0.5  # pixels before the tangent plane of what a neighbour sees: above, an outline may lie between
ASIDE = 0.1  # pixels along the ray, to both sides of the least value, where the field is looked at
ROUNDS = 2  # of Newton's, to where an outline crosses
FEW = 64  # hits that tell whether exact normals have a derivative
FLAT = 1e-4  # per radius: normals that turn less than this are constant
BEYOND = 0.1  # pixels by which a ray that grazes the surface may be taken to miss it


def shade(
    buffers: Buffers, colour: Colour, background: Float[Tensor, "channels"]
) -> Float[Tensor, "*batch height width channels"]:
    """An image of what was hit, as `colour` has it, on a background.

    Values are those at the centres of pixels. The gradient is that of the image seen through a tent two pixels wide,
    and reaches whatever requires grad in the field, the camera, the colour and the background. It costs evaluations
    for the pixels beside outlines alone, and none where grad mode is off or nothing requires grad.

    `colour` gets exact normals. Where those are constant in pieces, as a ReLU network's are, their derivative is that
    of the footprint normals, at 32 evaluations a hit; a `colour` that does not use normals does not pay for it. Raises
    `ValueError` for rays that are no image.
    """
    hit = buffers.mask
    if hit.dim() < 2:
        raise ValueError(f"buffers of shape {list(hit.shape)} were given; outlines are found in images [height, width]")
    seen = colour(buffers.points, _normals(buffers, colour), buffers.rays.directions[hit])
    image = background.expand(*hit.shape, -1).masked_scatter(hit[..., None], seen)
    if not buffers.points.requires_grad:
        return image
    moving = image.reshape(-1, image.shape[-1])
    for axis in (-1, -2):
        crossed = _crossed(buffers, _jumps(buffers, axis))
        change = _change(buffers, crossed, colour, image.detach().reshape(moving.shape))
        for pixels, share in ((crossed.near, 1 - crossed.where), (crossed.far, crossed.where)):
            moving = moving.index_add(0, pixels, share[:, None] * change)
    return moving.reshape(image.shape)


def _normals(buffers: Buffers, colour: Colour) -> Float[Tensor, "hits 3"]:
    """Exact normals of hits, with the footprint normals' derivative if `colour` needs one and they have none."""
    exact, points = buffers.normal[buffers.mask], buffers.points
    if not (len(points) and points.requires_grad):
        return exact
    directions = buffers.rays.directions[buffers.mask]
    if not (_uses_normals(colour, points, exact, directions) and _constant_normals(buffers)):
        return exact
    smooth = buffers.footprint_normal[buffers.mask]
    return exact.detach() + (smooth - smooth.detach())


def _uses_normals(colour: Colour, points: Tensor, normals: Tensor, directions: Tensor) -> bool:
    """Whether colours depend on normals, by those of the first hit."""
    normal = normals[:1].detach().requires_grad_()
    seen = colour(points[:1].detach(), normal, directions[:1].detach())
    return seen.requires_grad and torch.autograd.grad(seen.sum(), normal, allow_unused=True)[0] is not None


def _constant_normals(buffers: Buffers) -> bool:
    """Whether exact normals do not turn as the points move, at most of a few hits."""
    every = -(-len(buffers.points) // FEW)
    points = buffers.points[::every].detach().requires_grad_()
    field = at_rows(buffers.field_at(buffers.mask), torch.arange(len(buffers.points), device=points.device)[::every])
    normals = surface.normals(field, points)
    aside = torch.linalg.cross(normals.detach(), normals.detach().roll(1, -1) + 0.1)
    (turning,) = torch.autograd.grad((normals * aside).sum(), points, allow_unused=True)
    return turning is None or bool((turning.norm(dim=-1) < FLAT / buffers.radius).float().mean() > 0.5)


@dataclass(frozen=True)
class _Pairs:
    """Neighbouring pixels with an outline between: one sees the surface that it bounds, the other sees past it."""

    near: Int[Tensor, "n"]
    far: Int[Tensor, "n"]
    aside: Int[Tensor, "n"]  # the near one's neighbour along the other axis of the image
    where: Float[Tensor, "n"]  # the outline on the way from the near one, 0, to the far one, 1
    distance: Float[Tensor, "n"]  # at which the ray there touches the surface

    def __getitem__(self, some: Tensor) -> "_Pairs":
        return _Pairs(self.near[some], self.far[some], self.aside[some], self.where[some], self.distance[some])

    def at(self, where: Float[Tensor, "n"], distance: Float[Tensor, "n"]) -> "_Pairs":
        return _Pairs(self.near, self.far, self.aside, where, distance)

    def rays(self, rays: Rays) -> Rays:
        """Those through the outline."""
        near, far, part = rays[self.near], rays[self.far], self.where[:, None]
        directions = normalize(torch.lerp(near.directions, far.directions, part), dim=-1)
        return Rays(torch.lerp(near.origins, far.origins, part), directions)

    def apart(self, rays: Rays) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """By how much the points at the distance move per pixel: from near to far, and aside."""
        here = rays[self.near].at(self.distance)
        return rays[self.far].at(self.distance) - here, rays[self.aside].at(self.distance) - here


@torch.no_grad()
def _jumps(buffers: Buffers, axis: int) -> _Pairs:
    """Neighbours along an axis, the near one well before the tangent plane at what the far one sees, if anything."""
    shape, t = buffers.mask.shape, buffers.trace.distance.reshape(-1)
    index = torch.arange(len(t), device=t.device).reshape(shape)
    first, second = (index.narrow(axis, i, shape[axis] - 1).reshape(-1) for i in (0, 1))
    near, far = torch.where(t[first] < t[second], torch.stack([first, second]), torch.stack([second, first]))
    near, far = near[t[near].isfinite()], far[t[near].isfinite()]
    rays, normals = buffers.rays.detach().flat(), buffers.normal.detach().reshape(-1, 3)
    other = -3 - axis  # of the last two
    pairs = _Pairs(near, far, _aside(near, shape, other), torch.ones_like(t[near]), t[near])
    before = rays[near].at(t[near]) - rays[far].at(t[far])
    unexplained = (before * normals[far]).sum(-1) > UNEXPLAINED * pairs.apart(rays)[0].norm(dim=-1)
    return pairs[unexplained | t[far].isinf()]


def _aside(pixels: Int[Tensor, "n"], shape: torch.Size, axis: int) -> Int[Tensor, "n"]:
    """The next pixel along an axis; at the end of the image the one before."""
    stride, size = (1, shape[-1]) if axis == -1 else (shape[-1], shape[-2])
    return pixels + torch.where(pixels // stride % size + 1 < size, stride, -stride if size > 1 else 0)


@torch.no_grad()
def _crossed(buffers: Buffers, pairs: _Pairs) -> _Pairs:
    """Pairs with the place of the outline between, by Newton's method from the far pixel: those that have one.

    There the ray passes the surface that the near pixel hits, so that f has a least value, and that is positive.
    """
    rays, t = buffers.rays.detach().flat(), buffers.trace.distance.reshape(-1)
    pixel = pairs.apart(rays)[0].norm(dim=-1)
    reach = (0.1 * buffers.radius * pixel).sqrt()  # how far behind the near pixel's hit round shapes are touched
    for _ in range(ROUNDS):
        if not len(pairs.near):
            break
        ray = pairs.rays(rays)
        bounds = Bounds(torch.zeros_like(pixel), (t[pairs.near] + t[pairs.far]) / 2)
        found = surface.minimum(buffers.sdf, ray, pairs.distance, bounds, reach=reach.median().item())
        pairs = pairs.at(pairs.where, found)
        value, gradient, _ = _least(buffers.sdf, ray, found, ASIDE * pixel)
        slope = (gradient * pairs.apart(rays)[0]).sum(-1)
        where = pairs.where - value / slope
        some = (slope > 0) & (where < 1 + BEYOND)
        pairs, pixel = pairs.at(where.clamp(0, 1), found)[some], pixel[some]
        reach = pixel
    return pairs


def _change(buffers: Buffers, crossed: _Pairs, colour: Colour, image: Float[Tensor, "pixels channels"]) -> Tensor:
    """Zero, with the gradient of the step in colour times the motion of the outline, from near to far, in pixels.

    On a ray that touches the surface the least value of f is zero: d where = −df / (∇f · d point / d where). Rows and
    columns share an outline by the fourth powers of its normal, so that neither counts where it hardly crosses them.
    """
    rays = buffers.rays.flat()
    ray = crossed.rays(rays)
    steps = crossed.apart(rays.detach())
    value, gradient, normal = _least(buffers.sdf, ray, crossed.distance, ASIDE * steps[0].norm(dim=-1))
    along, aside = ((gradient * step).sum(-1) for step in steps)
    motion = -(value - value.detach()) * along**3 / (along**4 + aside**4).clamp_min(1e-30)
    with torch.no_grad():
        near = colour(ray.at(crossed.distance), normal, ray.directions)
    return motion[:, None] * (near - image[crossed.far])


def _least(sdf: SDF, rays: Rays, distance: Tensor, aside: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The least value of f on rays, its gradient as a constant, and the unit normal just before it.

    A mean of two looks, before and behind, in which the slope along the ray vanishes: on edges, and everywhere on
    networks of flat pieces, neither look alone is level.
    """
    both = torch.stack([distance - aside, distance + aside])
    value, gradient = value_and_gradient(sdf, rays.at(both), second_order=False)
    falling, rising = (gradient * rays.directions.detach()).sum(-1)
    part = (rising / (rising - falling)).nan_to_num(0.5).clamp(0, 1)
    weight = torch.stack([part, 1 - part])
    level = (value - torch.stack([-falling, rising]) * aside) * weight
    return level.sum(0), (gradient * weight[..., None]).sum(0), normalize(gradient[0], dim=-1)
