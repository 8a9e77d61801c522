"""Where gradients come back: quantities of a traced ray as differentiable functions of the field and the ray.

Each takes the field and the rays with whatever requires grad in them, and the result of a trace that had none.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.field import SDF, value_and_gradient
from distrace.rays import Rays

LEAST_SLOPE = 1e-6  # a ray along the surface has no derivative of its distance


def attach(sdf: SDF, rays: Rays, distance: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The distances of hits, unchanged in value, with their exact derivative dt = −df / (∇f · v).

    The implicit function theorem on f(o + t v; θ) = 0 (Niemeyer et al., *DVR*, CVPR 2020; Yariv et al., *IDR*, NeurIPS
    2020): one evaluation of the gradient per hit serves shape, pose and focal length alike. Where a ray touches the surface
    tangentially (|∇f · v| < 1e-6) there is no derivative, and none is given.
    """
    distance = distance.detach()
    value, gradient = value_and_gradient(sdf, rays.at(distance), second_order=False)
    slope = (gradient * rays.directions.detach()).sum(-1)
    flat = slope.abs() < LEAST_SLOPE
    return distance - torch.where(flat, 0.0, (value - value.detach()) / torch.where(flat, 1.0, slope))


def normals(sdf: SDF, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit normals ∇f / |∇f|; at attached points they also know how the point moves with the shape."""
    _, gradient = value_and_gradient(sdf, points)
    return torch.nn.functional.normalize(gradient, dim=-1)


def clearance(
    sdf: SDF, rays: Rays, closest: Float[Tensor, "*batch"], *, reach: float = 0.1, refine: int = 3
) -> Float[Tensor, "*batch"]:
    """The least value of f on rays that miss, differentiable in the field and the ray; `closest` is the trace's sample.

    The march samples a ray no closer than its steps, so its least sample is not the minimum, and the gradient at it
    would lie. Each round looks `reach` to both sides and moves to the parabola's vertex, then looks a fifth as far. At the
    minimum df/dt = 0, so its derivative is the field's own at a fixed point (the envelope theorem).
    """
    return sdf(rays.at(minimum(sdf, rays.detach(), closest.detach(), reach=reach, refine=refine)))


@torch.no_grad()
def minimum(
    sdf: SDF, rays: Rays, closest: Float[Tensor, "*batch"], *, reach: float = 0.1, refine: int = 3
) -> Float[Tensor, "*batch"]:
    """The distance of the local minimum of f beside `closest`: 1 + 3 · refine evaluations."""
    t, value = closest, sdf(rays.at(closest))
    for _ in range(refine):
        before, after = (t - reach).clamp_min(0), t + reach
        left, right = sdf(rays.at(before)), sdf(rays.at(after))
        curvature = (left - 2 * value + right).clamp_min(1e-9)
        vertex = t + (0.5 * reach * (left - right) / curvature).clamp(-reach, reach)
        candidates = torch.stack([t, before, after, vertex])
        values = torch.stack([value, left, right, sdf(rays.at(vertex))])
        best = values.argmin(0, keepdim=True)
        t, value = candidates.gather(0, best)[0], values.gather(0, best)[0]
        reach = reach / 5
    return t
