"""Where gradients come back: quantities of a traced ray as differentiable functions of the field and the ray.

Each takes the field and the rays with whatever requires grad in them, and the result of a trace that had none.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize
from torch.utils.checkpoint import checkpoint

from distrace.fields.base import SDF, at_rows, value_and_gradient
from distrace.rays import Bounds, Rays

LEAST_SLOPE = 1e-6  # a ray along the surface has no derivative of its distance
PART = 1 << 17  # points whose graph is kept: at 8 × 512 about 2 GiB
BESIDE = 2.0  # × what the last round looked to both sides: the corner is between
WALK = 40  # rounds downhill: across the unit sphere at a `reach` of 0.05; a crooked corner takes 20 between the others


def attach(
    sdf: SDF, rays: Rays, distance: Float[Tensor, "*batch"], *, least_slope: float = LEAST_SLOPE
) -> Float[Tensor, "*batch"]:
    """The distances of hits, unchanged in value, with their exact derivative dt = −df / (∇f · v).

    The implicit function theorem on f(o + t v; θ) = 0 (Niemeyer et al., *DVR*, CVPR 2020; Yariv et al., *IDR*, NeurIPS
    2020): one evaluation of the gradient per hit serves shape, pose and focal length alike. Where a ray touches the
    surface tangentially (|∇f · v| < `least_slope`) there is no derivative, and none is given.
    It is the first alone: what autograd says of a second is wrong.
    """
    distance, fixed = distance.detach(), rays.detach()
    points = fixed.at(distance)
    changes = _differentiable(sdf, points)
    if not (changes or _moves(rays)):
        return distance
    value, gradient = _linearised(sdf, points, changes)
    change, slope = value - value.detach(), (gradient * fixed.directions).sum(-1)
    if _moves(rays):
        change = change + (gradient * (rays.at(distance) - points)).sum(-1)
    flat = slope.abs() < least_slope
    return distance - torch.where(flat, 0.0, change / torch.where(flat, 1.0, slope))


def _moves(rays: Rays) -> bool:
    return torch.is_grad_enabled() and (rays.origins.requires_grad or rays.directions.requires_grad)


def _linearised(sdf: SDF, points: Float[Tensor, "*batch 3"], changes: bool) -> tuple[Tensor, Float[Tensor, "*batch 3"]]:
    """Value and gradient, the latter a constant; the value is differentiable in the field if that `changes`.

    Of many points the value's graph is made again when it is needed: a bound on memory, at one more evaluation.
    """
    parts = _parts(sdf, points.reshape(-1, 3))
    with torch.set_grad_enabled(changes and len(parts) <= 1):
        pairs = [value_and_gradient(field, part, second_order=False) for field, part in parts]
    values, gradients = (torch.cat(part) for part in zip(*pairs))
    if changes and len(parts) > 1:
        values = torch.cat([checkpoint(field, part, use_reentrant=False) for field, part in parts])
    return values.reshape(points.shape[:-1]), gradients.reshape(points.shape)


def _parts(sdf: SDF, points: Float[Tensor, "n 3"]) -> list[tuple[SDF, Float[Tensor, "m 3"]]]:
    """Points in parts whose graph fits in memory, each with the field of these points."""
    rows = torch.arange(len(points), device=points.device)
    return [(at_rows(sdf, some), points[some]) for some in rows.split(PART)]


def normals(sdf: SDF, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Unit normals ∇f / |∇f|; at attached points they also know how the point moves with the shape."""
    with torch.set_grad_enabled(_differentiable(sdf, points)):
        _, gradient = value_and_gradient(sdf, points)
    return normalize(gradient, dim=-1)


def footprint_normals(
    sdf: SDF, points: Float[Tensor, "*batch 3"], width: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Unit normals averaged over a ball of diameter `width` around each point, with a derivative that a loss can use.

    They are normalised Σ u f(p + u · width / 2), summed over 32 directions u: central differences as wide as a pixel's
    footprint (Li et al., *Neuralangelo*, CVPR 2023), in more directions than the axes. The exact normal of a ReLU
    network is constant in each linear piece, so its derivative is zero; differences between pieces change with the
    field, the points and the width. The derivative is a first one. Costs 32 evaluations a point.

    Raises `ValueError` for a width that is not positive.
    """
    if not (width > 0).all():
        wrong = float(width.detach()[~(width > 0)][0])
        raise ValueError(f"a width of {wrong} was given for the footprint of a point; widths must be positive")
    around = directions_of_taps(points)
    taps = points[..., None, :] + width[..., None, None] / 2 * around
    with torch.set_grad_enabled(_differentiable(sdf, taps)):
        rows = torch.arange(points.numel() // 3, device=points.device).repeat_interleave(len(around))
        parts = _parts(at_rows(sdf, rows), taps.reshape(-1, 3))
        again = torch.is_grad_enabled() and len(parts) > 1  # makes the graph again in the backward pass: less memory
        values = [checkpoint(field, part, use_reentrant=False) if again else field(part) for field, part in parts]
        return normalize((torch.cat(values).reshape(taps.shape[:-1])[..., None] * around).sum(-2), dim=-1)


def directions_of_taps(like: Tensor) -> Float[Tensor, "32 3"]:
    """The vertices of an icosahedron and of its dual dodecahedron, on the unit sphere: Σ u uᵀ is a multiple of 1."""
    golden, sides = (1 + 5**0.5) / 2, (-1.0, 1.0)
    corners = [[x, y, z] for x in sides for y in sides for z in sides]
    for long, short in ((golden, 1.0), (golden, 1 / golden)):
        pairs = [(short * a, long * b) for a in sides for b in sides]
        corners += [turned for a, b in pairs for turned in ([0.0, a, b], [a, b, 0.0], [b, 0.0, a])]
    return normalize(like.new_tensor(corners), dim=-1)


def clearance(
    sdf: SDF,
    rays: Rays,
    closest: Float[Tensor, "*batch"],
    bounds: Bounds | None = None,
    *,
    reach: float = 0.1,
    refine: int | None = None,
) -> Float[Tensor, "*batch"]:
    """The least value of f on rays that miss, differentiable in the field and the ray; `closest` is the trace's sample.

    The march samples a ray no closer than its steps, so its least sample is not the minimum, and the gradient at it
    would lie. At an end of the bounds the derivative is that of the value at a fixed distance.
    """
    lowest = minimum(sdf, rays.detach(), closest.detach(), bounds, reach=reach, refine=refine)
    return least(sdf, rays, lowest, reach=reach, refine=refine)


def least(
    sdf: SDF, rays: Rays, lowest: Float[Tensor, "*batch"], *, reach: float = 0.1, refine: int | None = None
) -> Float[Tensor, "*batch"]:
    """The value at a minimum along the ray, with its exact derivative.

    Where f is smooth that is the field's own at the fixed point, for df/dt = 0 (the envelope theorem). Where f has a
    corner there, as a ReLU network has at every minimum, it is the mean of both sides whose slope along the ray
    vanishes: one look to each side serves both.
    """
    with torch.no_grad():
        value = sdf(rays.at(lowest))
    if not (_moves(rays) or _differentiable(sdf, rays.detach().at(lowest))):
        return value
    beside = BESIDE * reach / 5 ** (_rounds(lowest, refine) - 1)
    steps = beside * torch.tensor([-1.0, 1.0]).to(lowest).reshape(2, *[1] * lowest.dim())
    both = Rays(rays.origins.expand(2, *rays.origins.shape), rays.directions.expand(2, *rays.directions.shape))
    values = sdf(both.at(lowest + steps))
    with torch.no_grad():
        falling, rising = sdf(both.at(lowest + 2 * steps)) - values  # over the next step outwards
    corner = (falling > 0) & (rising > 0)
    share = torch.where(corner, rising / torch.where(corner, falling + rising, 1.0), 0.5)
    change = values - values.detach()
    return value + share * change[0] + (1 - share) * change[1]


def _rounds(like: Tensor, refine: int | None) -> int:
    """Down to where rounding hides which side is lower."""
    return (10 if like.dtype == torch.float64 else 4) if refine is None else refine


def minimum(
    sdf: SDF,
    rays: Rays,
    closest: Float[Tensor, "*batch"],
    bounds: Bounds | None = None,
    *,
    reach: float = 0.1,
    refine: int | None = None,
) -> Float[Tensor, "*batch"]:
    """The distance of the local minimum of f beside `closest`, within the bounds."""
    return minimum_and_value(sdf, rays, closest, bounds, reach=reach, refine=refine)[0]


@torch.no_grad()
def minimum_and_value(
    sdf: SDF,
    rays: Rays,
    closest: Float[Tensor, "*batch"],
    bounds: Bounds | None = None,
    *,
    reach: float = 0.1,
    refine: int | None = None,
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """The distance of that minimum, and f there: 1 + 3 · refine evaluations and more.

    Each round looks to both sides, at first as far as `reach`, and moves to the parabola's vertex. Where that lies
    within, it looks a fifth as far from then on; where it does not (a coarse start may have passed the minimum, and a
    corner is no parabola) it goes on downhill.
    """
    flat, t = rays.flat(), closest.reshape(-1).clone()
    near = torch.zeros_like(t) if bounds is None else bounds.near.reshape(-1)
    far = torch.full_like(t, torch.inf) if bounds is None else bounds.far.reshape(-1)
    value, width, rounds = sdf(flat.at(t)), torch.full_like(t, reach), _rounds(t, refine)
    for _ in range(rounds + WALK):
        going = (width > 1.5 * reach / 5**rounds).nonzero()[:, 0]
        if not len(going):
            break
        ray, middle, w, lowest, highest = flat[going], t[going], width[going], near[going], far[going]
        before, after = (middle - w).maximum(lowest), (middle + w).minimum(highest)
        field = at_rows(sdf, going)
        left, right = field(ray.at(torch.stack([before, after])))
        curvature = (left - 2 * value[going] + right).clamp_min(torch.finfo(t.dtype).tiny)
        offset = 0.5 * w * (left - right) / curvature
        vertex = (middle + offset.clamp(-w, w)).clamp(lowest, highest)
        candidates = torch.stack([middle, before, after, vertex])
        values = torch.stack([value[going], left, right, field(ray.at(vertex))])
        best = values.argmin(0, keepdim=True)
        t[going], value[going] = candidates.gather(0, best)[0], values.gather(0, best)[0]
        width[going] = torch.where(offset.abs() > w, w, w / 5)
    return t.reshape(closest.shape), value.reshape(closest.shape)


def _differentiable(sdf: SDF, points: Tensor) -> bool:
    """Whether a gradient can reach anything: the points, or what the field was made from, which one value tells."""
    first = points.detach().reshape(-1, 3)[:1]
    field = at_rows(sdf, torch.arange(len(first), device=points.device))
    return torch.is_grad_enabled() and (points.requires_grad or field(first).requires_grad)
