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
GRAPH_POINTS = 1 << 17  # points whose graph is kept at a time: at 8 × 512 about 2 GiB
CORNER_REACH = 2.0  # × the last round's step: the corner lies within, to both sides
DOWNHILL_ROUNDS = 40  # across the unit sphere at a `reach` of 0.05; a crooked corner takes 20 between the others


def attach(
    sdf: SDF, rays: Rays, distance: Float[Tensor, "*batch"], *, least_slope: float = LEAST_SLOPE
) -> Float[Tensor, "*batch"]:
    """Returns the distances of hits, unchanged in value, with their exact derivative dt = −df / (∇f · v).

    By the implicit function theorem on f(o + t v; θ) = 0 (Niemeyer et al., *DVR*, CVPR 2020; Yariv et al., *IDR*,
    NeurIPS 2020). One gradient of the field per hit serves shape, pose and focal length alike. A ray that touches the
    surface tangentially (|∇f · v| < `least_slope`) gets no derivative. Only first derivatives are right.

    >>> radius = torch.tensor(0.5, requires_grad=True)
    >>> ray = Rays(torch.tensor([0.0, 0.0, 2.0]), torch.tensor([0.0, 0.0, -1.0]))
    >>> distance = attach(lambda points: points.norm(dim=-1) - radius, ray, torch.tensor(1.5))
    >>> distance.backward()
    >>> radius.grad
    tensor(-1.)
    """
    distance = distance.detach()
    fixed = rays.detach()
    points = fixed.at(distance)
    changes = _differentiable(sdf, points)
    if not (changes or _moves(rays)):
        return distance
    value, gradient = _linearised(sdf, points, changes)
    change = value - value.detach()
    slope = (gradient * fixed.directions).sum(-1)
    if _moves(rays):
        change = change + (gradient * (rays.at(distance) - points)).sum(-1)
    flat = slope.abs() < least_slope
    return distance - torch.where(flat, 0.0, change / torch.where(flat, 1.0, slope))


def _moves(rays: Rays) -> bool:
    return torch.is_grad_enabled() and (rays.origins.requires_grad or rays.directions.requires_grad)


def _linearised(sdf: SDF, points: Float[Tensor, "*batch 3"], changes: bool) -> tuple[Tensor, Float[Tensor, "*batch 3"]]:
    """Returns value and gradient, the latter a constant; the value is differentiable in the field if that `changes`.

    For many points the backward pass recomputes the value's graph: a bound on memory, at one more evaluation.
    """
    parts = _parts(sdf, points.reshape(-1, 3))
    with torch.set_grad_enabled(changes and len(parts) <= 1):
        pairs = [value_and_gradient(field, part, second_order=False) for field, part in parts]
    values, gradients = (torch.cat(part) for part in zip(*pairs))
    if changes and len(parts) > 1:
        values = torch.cat([checkpoint(field, part, use_reentrant=False) for field, part in parts])
    return values.reshape(points.shape[:-1]), gradients.reshape(points.shape)


def _parts(sdf: SDF, points: Float[Tensor, "n 3"]) -> list[tuple[SDF, Float[Tensor, "m 3"]]]:
    """Returns points in parts whose graph fits in memory, each with the field of these points."""
    rows = torch.arange(len(points), device=points.device)
    return [(at_rows(sdf, part), points[part]) for part in rows.split(GRAPH_POINTS)]


def normals(sdf: SDF, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Returns unit normals ∇f / |∇f|; at attached points they include how the point moves with the shape.

    Raises `ValueError` for a field without a gradient, and under `torch.inference_mode`.

    >>> normals(lambda points: points.norm(dim=-1) - 0.5, torch.tensor([0.0, 3.0, 0.0]))
    tensor([0., 1., 0.])
    """
    with torch.set_grad_enabled(_differentiable(sdf, points)):
        _, gradient = value_and_gradient(sdf, points)
    return normalize(gradient, dim=-1)


def footprint_normals(
    sdf: SDF, points: Float[Tensor, "*batch 3"], width: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Returns unit normals averaged over a ball of diameter `width` around each point, for losses.

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
        recompute = torch.is_grad_enabled() and len(parts) > 1  # the graph, in the backward pass: less memory
        values = [checkpoint(field, part, use_reentrant=False) if recompute else field(part) for field, part in parts]
        return normalize((torch.cat(values).reshape(taps.shape[:-1])[..., None] * around).sum(-2), dim=-1)


def directions_of_taps(like: Tensor) -> Float[Tensor, "32 3"]:
    """Returns the vertices of an icosahedron and of its dual dodecahedron, unit vectors with Σ u uᵀ a multiple of I."""
    golden = (1 + 5**0.5) / 2
    sides = (-1.0, 1.0)
    corners = [[x, y, z] for x in sides for y in sides for z in sides]
    for long, short in ((golden, 1.0), (golden, 1 / golden)):
        pairs = [(short * a, long * b) for a in sides for b in sides]
        corners += [cyclic for a, b in pairs for cyclic in ([0.0, a, b], [a, b, 0.0], [b, 0.0, a])]
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
    """Returns the least value of f on rays that miss, differentiable in the field and the ray.

    `closest` is the distance of the trace's least sample. That is not yet the minimum, for a march takes steps, and its
    gradient is not the minimum's. At an end of the bounds the derivative is that of the value at a fixed distance.
    """
    lowest = minimum(sdf, rays.detach(), closest.detach(), bounds, reach=reach, refine=refine)
    return least(sdf, rays, lowest, reach=reach, refine=refine)


def least(
    sdf: SDF, rays: Rays, lowest: Float[Tensor, "*batch"], *, reach: float = 0.1, refine: int | None = None
) -> Float[Tensor, "*batch"]:
    """Returns the value at a minimum along the ray, with its exact derivative.

    Where f is smooth the derivative is the field's own at the fixed point, as df/dt = 0 (the envelope theorem). At a
    corner, as ReLU networks have at every minimum, it is the weighted mean of both sides whose slope along the ray
    vanishes. One evaluation to each side serves both cases.
    """
    with torch.no_grad():
        value = sdf(rays.at(lowest))
    if not (_moves(rays) or _differentiable(sdf, rays.detach().at(lowest))):
        return value
    offset = CORNER_REACH * reach / 5 ** (_rounds(lowest, refine) - 1)
    steps = offset * torch.tensor([-1.0, 1.0]).to(lowest).reshape(2, *[1] * lowest.dim())
    both = Rays(rays.origins.expand(2, *rays.origins.shape), rays.directions.expand(2, *rays.directions.shape))
    values = sdf(both.at(lowest + steps))
    with torch.no_grad():
        falling, rising = sdf(both.at(lowest + 2 * steps)) - values  # over the next step outwards
    corner = (falling > 0) & (rising > 0)
    share = torch.where(corner, rising / torch.where(corner, falling + rising, 1.0), 0.5)
    change = values - values.detach()
    return value + share * change[0] + (1 - share) * change[1]


def _rounds(like: Tensor, refine: int | None) -> int:
    """Returns the rounds down to where rounding hides which side is lower."""
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
    """Returns the distance of the local minimum of f beside `closest`, within the bounds."""
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
    """Returns the distance of that minimum and f at it, by 1 + 3 · refine evaluations or more.

    Each round evaluates f to both sides, at first at `reach`, and moves to the parabola's vertex. If the vertex lies
    between, the next round's step is a fifth; otherwise (the start may be off, and a corner is no parabola) the search
    goes on downhill.
    """
    flat = rays.flat()
    t = closest.reshape(-1).clone()
    near = torch.zeros_like(t) if bounds is None else bounds.near.reshape(-1)
    far = torch.full_like(t, torch.inf) if bounds is None else bounds.far.reshape(-1)
    value = sdf(flat.at(t))
    width = torch.full_like(t, reach)
    rounds = _rounds(t, refine)
    for _ in range(rounds + DOWNHILL_ROUNDS):
        active = (width > 1.5 * reach / 5**rounds).nonzero()[:, 0]
        if not len(active):
            break
        ray = flat[active]
        middle = t[active]
        step = width[active]
        lowest = near[active]
        highest = far[active]
        before = (middle - step).maximum(lowest)
        after = (middle + step).minimum(highest)
        field = at_rows(sdf, active)
        value_before, value_after = field(ray.at(torch.stack([before, after])))
        curvature = (value_before - 2 * value[active] + value_after).clamp_min(torch.finfo(t.dtype).tiny)
        offset = 0.5 * step * (value_before - value_after) / curvature
        vertex = (middle + offset.clamp(-step, step)).clamp(lowest, highest)
        candidates = torch.stack([middle, before, after, vertex])
        values = torch.stack([value[active], value_before, value_after, field(ray.at(vertex))])
        best = values.argmin(0, keepdim=True)
        t[active] = candidates.gather(0, best)[0]
        value[active] = values.gather(0, best)[0]
        width[active] = torch.where(offset.abs() > step, step, step / 5)
    return t.reshape(closest.shape), value.reshape(closest.shape)


def _differentiable(sdf: SDF, points: Tensor) -> bool:
    """Returns whether a gradient can reach the points, or the field's parameters, which one evaluation shows."""
    first = points.detach().reshape(-1, 3)[:1]
    field = at_rows(sdf, torch.arange(len(first), device=points.device))
    return torch.is_grad_enabled() and (points.requires_grad or field(first).requires_grad)
