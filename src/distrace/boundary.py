"""Images in colour whose gradient includes outlines: a loss on them moves the edge of a shape, without any mask.

A pixel changes because the surface that it sees changes, and because an outline moves across it. The first is the
derivative of each hit. The second is an integral along all outlines, of the step in colour times the outline's motion
(Li et al., *Differentiable Monte Carlo Ray Tracing through Edge Sampling*, SIGGRAPH Asia 2018). Wang et al. (*A Simple
Approach to Differentiable Rendering of SDFs*, SIGGRAPH Asia 2024) widen it to a band. This module sums over the points
where outlines cross the lines between the centres of neighbouring pixels, which needs no width.
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
from distrace.vectors import length

Colour = Callable[[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Float[Tensor, "n 3"]], Float[Tensor, "n channels"]]
"""Maps points, unit normals and ray directions to colours."""

DEPTH_STEP = 0.5  # pixels before the tangent plane of a neighbour's hit: above, an outline may lie between
SIDE_OFFSET = 0.1  # pixels along the ray, to both sides of the least value, where the field is evaluated
NEWTON_STEPS = 2  # to where an outline crosses
NORMAL_SAMPLES = 64  # hits, at which exact normals are checked for a derivative
CONSTANT_NORMAL = 1e-4  # per radius: normals that turn less than this are constant
GRAZING = 0.1  # pixels by which a ray that grazes the surface may count as a miss


def shade(
    buffers: Buffers, colour: Colour, background: Float[Tensor, "channels"]
) -> Float[Tensor, "*batch height width channels"]:
    """Returns an image of the hits on a background, in the colours that `colour` returns.

    Values are those at the centres of pixels. The gradient is that of the image seen through a tent two pixels wide,
    and reaches the field, the camera, the colour and the background. It costs evaluations for the pixels beside
    outlines alone, and none where grad mode is off or nothing requires grad.

    `colour` gets exact normals. Where those are piecewise constant, as a ReLU network's are, their derivative is that
    of the footprint normals, at 32 evaluations a hit; a `colour` that does not use normals does not pay for it. Raises
    `ValueError` for rays that are no image.

    >>> from distrace.camera import Camera
    >>> from distrace.fields import primitives
    >>> from distrace.render import render
    >>> buffers = render(primitives.sphere(0.5), Camera.orbit(0, 0, 4, height=16, width=16))
    >>> shade(buffers, lambda points, normals, directions: normals[:, 2:], torch.zeros(1)).shape
    torch.Size([16, 16, 1])
    """
    hit = buffers.mask
    if hit.dim() < 2:
        raise ValueError(f"buffers of shape {list(hit.shape)} were given; outlines are found in images [height, width]")
    colours = colour(buffers.points, _normals(buffers, colour), buffers.rays.directions[hit])
    image = background.expand(*hit.shape, -1).masked_scatter(hit[..., None], colours)
    if not buffers.points.requires_grad:
        return image
    moving = image.reshape(-1, image.shape[-1])
    for axis in (-1, -2):
        crossed = _crossed(buffers, _jumps(buffers, axis))
        change = _change(buffers, crossed, colour, image.detach().reshape(moving.shape))
        for pixels, share in ((crossed.near, 1 - crossed.crossing), (crossed.far, crossed.crossing)):
            moving = moving.index_add(0, pixels, share[:, None] * change)
    return moving.reshape(image.shape)


def _normals(buffers: Buffers, colour: Colour) -> Float[Tensor, "hits 3"]:
    """Returns exact normals of hits, with the footprint normals' derivative if `colour` uses it and they have none."""
    exact = buffers.normal[buffers.mask]
    points = buffers.points
    if not (len(points) and points.requires_grad):
        return exact
    directions = buffers.rays.directions[buffers.mask]
    if not (_uses_normals(colour, points, exact, directions) and _constant_normals(buffers)):
        return exact
    smooth = buffers.footprint_normal[buffers.mask]
    return exact.detach() + (smooth - smooth.detach())


def _uses_normals(colour: Colour, points: Tensor, normals: Tensor, directions: Tensor) -> bool:
    """Returns whether colours depend on normals, by those of the first hit."""
    normal = normals[:1].detach().requires_grad_()
    colours = colour(points[:1].detach(), normal, directions[:1].detach())
    return colours.requires_grad and _gradient(colours, normal) is not None


def _gradient(values: Tensor, by: Tensor) -> Tensor | None:
    """Returns the gradient of the sum of values; None where they do not depend on `by`."""
    return torch.autograd.grad(values.sum(), by, allow_unused=True)[0]


def _constant_normals(buffers: Buffers) -> bool:
    """Returns whether exact normals do not turn as the points move, at most of a few hits."""
    stride = -(-len(buffers.points) // NORMAL_SAMPLES)
    points = buffers.points[::stride].detach().requires_grad_()
    field = at_rows(buffers.field_at(buffers.mask), torch.arange(len(buffers.points), device=points.device)[::stride])
    normals = surface.normals(field, points)
    tangent = torch.cross(normals.detach(), normals.detach().roll(1, -1) + 0.1, dim=-1)
    turning = _gradient(normals * tangent, points)
    return turning is None or bool((length(turning) < CONSTANT_NORMAL / buffers.radius).float().mean() > 0.5)


@dataclass(frozen=True)
class _Pairs:
    """Neighbouring pixels with an outline between: one sees the surface that it bounds, the other sees past it."""

    near: Int[Tensor, "n"]
    far: Int[Tensor, "n"]
    across: Int[Tensor, "n"]  # the near one's neighbour along the other axis of the image
    crossing: Float[Tensor, "n"]  # the outline's position between the near pixel, 0, and the far one, 1
    distance: Float[Tensor, "n"]  # at which the ray through the outline touches the surface

    def __getitem__(self, index: Tensor) -> "_Pairs":
        return _Pairs(*(part[index] for part in (self.near, self.far, self.across, self.crossing, self.distance)))

    def at(self, crossing: Float[Tensor, "n"], distance: Float[Tensor, "n"]) -> "_Pairs":
        return _Pairs(self.near, self.far, self.across, crossing, distance)

    def rays(self, rays: Rays) -> Rays:
        """Returns the rays through the outline."""
        near = rays[self.near]
        far = rays[self.far]
        part = self.crossing[:, None]
        directions = normalize(torch.lerp(near.directions, far.directions, part), dim=-1)
        return Rays(torch.lerp(near.origins, far.origins, part), directions)

    def pixel_steps(self, rays: Rays) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Returns how far the points at the distance move per pixel: from near to far, and along the other axis."""
        points = rays[self.near].at(self.distance)
        return rays[self.far].at(self.distance) - points, rays[self.across].at(self.distance) - points


@torch.no_grad()
def _jumps(buffers: Buffers, axis: int) -> _Pairs:
    """Returns neighbours along an axis of which the far one sees nothing, or a surface well behind the near one's."""
    shape = buffers.mask.shape
    t = buffers.trace.distance.reshape(-1)
    index = torch.arange(len(t), device=t.device).reshape(shape)
    first, second = (index.narrow(axis, i, shape[axis] - 1).reshape(-1) for i in (0, 1))
    near, far = torch.where(t[first] < t[second], torch.stack([first, second]), torch.stack([second, first]))
    near_hit = t[near].isfinite()
    near = near[near_hit]
    far = far[near_hit]
    rays = buffers.rays.detach().flat()
    normals = buffers.normal.detach().reshape(-1, 3)
    other_axis = -3 - axis  # of the last two
    pairs = _Pairs(near, far, _neighbour(near, shape, other_axis), torch.ones_like(t[near]), t[near])
    before = rays[near].at(t[near]) - rays[far].at(t[far])
    jumps = (before * normals[far]).sum(-1) > DEPTH_STEP * length(pairs.pixel_steps(rays)[0])
    return pairs[jumps | t[far].isinf()]


def _neighbour(pixels: Int[Tensor, "n"], shape: torch.Size, axis: int) -> Int[Tensor, "n"]:
    """Returns the next pixel along an axis; at the end of the image the one before."""
    stride, size = (1, shape[-1]) if axis == -1 else (shape[-1], shape[-2])
    return pixels + torch.where(pixels // stride % size + 1 < size, stride, -stride if size > 1 else 0)


@torch.no_grad()
def _crossed(buffers: Buffers, pairs: _Pairs) -> _Pairs:
    """Returns the pairs with an outline between, and its position, by Newton's method from the far pixel.

    The far pixel's ray passes the surface that the near one hits: on it f has a positive least value.
    """
    rays = buffers.rays.detach().flat()
    t = buffers.trace.distance.reshape(-1)
    pixel = length(pairs.pixel_steps(rays)[0])
    reach = (0.1 * buffers.radius * pixel).sqrt()  # how far behind the near pixel's hit round shapes are touched
    for _ in range(NEWTON_STEPS):
        if not len(pairs.near):
            break
        ray = pairs.rays(rays)
        bounds = Bounds(torch.zeros_like(pixel), (t[pairs.near] + t[pairs.far]) / 2)
        distance = surface.minimum(buffers.sdf, ray, pairs.distance, bounds, reach=reach.median().item())
        pairs = pairs.at(pairs.crossing, distance)
        value, gradient, _ = _least(buffers.sdf, ray, distance, SIDE_OFFSET * pixel)
        slope = (gradient * pairs.pixel_steps(rays)[0]).sum(-1)
        crossing = pairs.crossing - value / slope
        crosses = (slope > 0) & (crossing < 1 + GRAZING)
        pairs = pairs.at(crossing.clamp(0, 1), distance)[crosses]
        pixel = pixel[crosses]
        reach = pixel
    return pairs


def _change(buffers: Buffers, crossed: _Pairs, colour: Colour, image: Float[Tensor, "pixels channels"]) -> Tensor:
    """Returns zero, with the gradient of the step in colour times the outline's motion from near to far, in pixels.

    On a ray that touches the surface the least value of f is zero, so d crossing = −df / (∇f · d point / d crossing).
    Rows and columns share an outline by the fourth powers of its normal: neither counts where it hardly crosses them.
    """
    rays = buffers.rays.flat()
    ray = crossed.rays(rays)
    steps = crossed.pixel_steps(rays.detach())
    value, gradient, normal = _least(buffers.sdf, ray, crossed.distance, SIDE_OFFSET * length(steps[0]))
    along, across = ((gradient * step).sum(-1) for step in steps)
    motion = -(value - value.detach()) * along**3 / (along**4 + across**4).clamp_min(1e-30)
    with torch.no_grad():
        near = colour(ray.at(crossed.distance), normal, ray.directions)
    return motion[:, None] * (near - image[crossed.far])


def _least(sdf: SDF, rays: Rays, distance: Tensor, offset: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the least value of f on rays, its gradient as a constant, and the unit normal just before it.

    It is the weighted mean of evaluations before and behind in which the slope along the ray vanishes: on edges, and
    everywhere on a piecewise linear network, the slope vanishes at neither.
    """
    both = torch.stack([distance - offset, distance + offset])
    value, gradient = value_and_gradient(sdf, rays.at(both), second_order=False)
    falling, rising = (gradient * rays.directions.detach()).sum(-1)
    part = (rising / (rising - falling)).nan_to_num(0.5).clamp(0, 1)
    weight = torch.stack([part, 1 - part])
    level = (value - torch.stack([-falling, rising]) * offset) * weight
    return level.sum(0), (gradient * weight[..., None]).sum(0), normalize(gradient[0], dim=-1)
