"""Where gradients come back: each derivative three ways – implicit, by finite differences, and of the closed form."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import normalize

from distrace import surface
from distrace.camera import Camera
from distrace.fields import primitives
from distrace.rays import Rays, meet_sphere
from distrace.tracing.sphere_tracing import AGGRESSIVE, TraceConfig, sphere_trace

f64 = torch.float64
EXACT = TraceConfig(steps=500, step_scale=1.0, tolerance=1e-9, coarse_levels=0)
ORBIT = Camera.orbit(30, 20, 4.97, height=16, width=16, focal_px=60, dtype=f64)

START = {
    "radius": [0.5],
    "centre": [0.1, -0.05, 0.2],
    "rotation": [0.0, 0.0, 0.0],
    "translation": [0.0, 0.0, 0.0],
    "focal length": [60.0],
    "principal point": [8.0, 8.0],
}
every_parameter = pytest.mark.parametrize("name", START)
Parameters = dict[str, Tensor]


def parameters(**given: Tensor) -> Parameters:
    return {**{name: torch.tensor(value, dtype=f64) for name, value in START.items()}, **given}


def ball(p: Parameters) -> primitives.SDF:
    return primitives.sphere(p["radius"], p["centre"])


def camera(p: Parameters) -> Camera:
    """The orbit's camera, turned and moved a little, with these intrinsics."""
    x, y, z = p["rotation"]
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    pose = torch.cat([torch.linalg.matrix_exp(skew), p["translation"][:, None]], dim=1)
    last = torch.tensor([[0.0, 0, 0, 1]], dtype=f64)
    focal = torch.diag(p["focal length"].expand(2))
    intrinsics = torch.cat([torch.cat([focal, p["principal point"][:, None]], dim=1), last[:, 1:]])
    return Camera(intrinsics, torch.cat([pose, last]) @ ORBIT.T_world_camera, 16, 16)


def distances(p: Parameters) -> tuple[Rays, Tensor, Tensor]:
    """Rays that hit well inside the outline, their traced distances, and which rays of the image they are."""
    rays = camera(p).rays()
    facing = meet_sphere(Rays(rays.origins.detach() - p["centre"].detach(), rays.directions.detach()), 0.4).meets
    with torch.no_grad():
        traced = sphere_trace(ball(p), rays, meet_sphere(rays.detach()), EXACT)
    assert traced.hit[facing].all()
    assert facing.sum() > 20
    return rays[facing], traced.distance[facing], facing


def closed_form(p: Parameters) -> Tensor:
    """The nearer root of |o + t v − c|² = r², by autograd's hands."""
    rays, _, _ = distances(p)
    towards = rays.origins - p["centre"]
    b, c = (towards * rays.directions).sum(-1), towards.square().sum(-1) - p["radius"] ** 2
    return -b - (b**2 - c).sqrt()


def differences(function: Callable[[Tensor], Tensor], at: Tensor, step: float = 1e-4) -> Tensor:
    """Central finite differences of a scalar function."""
    steps = step * torch.eye(len(at), dtype=f64)
    return torch.stack([(function(at + s) - function(at - s)) / (2 * step) for s in steps])


def weights(like: Tensor) -> Tensor:
    return torch.randn(like.shape, generator=torch.Generator().manual_seed(0), dtype=f64)


@every_parameter
def test_the_derivative_of_depth_is_right_three_ways(name: str) -> None:
    facing = distances(parameters())[2]
    cosines = lambda p: camera(p).cosines()[facing]  # noqa: E731
    random = weights(facing[facing])

    def attached(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        rays, distance, _ = distances(p)
        return (surface.attach(ball(p), rays, distance) * cosines(p) * random).sum()

    def traced(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        return (distances(p)[1] * cosines(p) * random).sum()

    def exact(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        return (closed_form(p) * cosines(p) * random).sum()

    at = torch.tensor(START[name], dtype=f64, requires_grad=True)
    (implicit,) = torch.autograd.grad(attached(at), at)
    (closed,) = torch.autograd.grad(exact(at), at)
    numeric = differences(traced, at.detach())
    scale = closed.abs().max().item()
    assert scale > 1e-3
    torch.testing.assert_close(implicit, closed, rtol=0, atol=1e-6 * scale)
    torch.testing.assert_close(implicit, numeric, rtol=0, atol=1e-6 * scale)


@every_parameter
def test_normals_at_attached_points_know_how_the_point_moves(name: str) -> None:
    """A normal at a detached point knows nothing of the radius, of the camera's place and of its focal length."""

    def attached(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        rays, distance, _ = distances(p)
        points = rays.at(surface.attach(ball(p), rays, distance))
        return surface.normals(ball(p), points)

    def exact(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        rays, _, _ = distances(p)
        return (rays.at(closed_form(p)) - p["centre"]) / p["radius"]

    at = torch.tensor(START[name], dtype=f64, requires_grad=True)
    random = weights(exact(at))
    torch.testing.assert_close(attached(at), exact(at), rtol=0, atol=1e-6)
    (implicit,) = torch.autograd.grad((attached(at) * random).sum(), at)
    (closed,) = torch.autograd.grad((exact(at) * random).sum(), at)
    with torch.no_grad():
        numeric = differences(lambda value: (attached(value) * random).sum(), at)
    scale = closed.abs().max().item()
    assert scale > 1e-3
    torch.testing.assert_close(implicit, closed, rtol=0, atol=1e-6 * scale)
    torch.testing.assert_close(implicit, numeric, rtol=0, atol=1e-6 * scale)


@pytest.mark.parametrize(
    "make",
    [
        lambda size: primitives.box(size),
        lambda size: primitives.torus(size[0] + 0.2, size[1]),
        lambda size: primitives.smooth_union(primitives.sphere(size[2] + 0.2), primitives.box(size), 0.2),
        lambda size: lambda p: 0.7 * primitives.box(size)(p) + 0.1 * torch.sin(3 * p[..., 0]) * size[1],
    ],
    ids=["box", "torus", "smooth union", "no distance at all"],
)
def test_the_derivative_agrees_with_finite_differences_on_other_fields(make) -> None:
    """Only the field's zero counts: its slope need not be 1."""
    rays = Camera.orbit(35, 25, 4.97, height=12, width=12, focal_px=60, dtype=f64).rays().flat()
    size = torch.tensor([0.35, 0.25, 0.3], dtype=f64, requires_grad=True)

    def trace(value: Tensor) -> Tensor:
        return sphere_trace(make(value), rays, meet_sphere(rays), EXACT).distance

    base = trace(size)
    steps = 1e-5 * torch.eye(3, dtype=f64)
    slopes = torch.stack([(trace(size + s) - trace(size - s)) / 2e-5 for s in steps], dim=-1)
    smooth = (slopes.norm(dim=-1) < 5) & base.isfinite()  # beside edges, where another face comes into view
    assert smooth.sum() > 30
    attached = surface.attach(make(size), rays[smooth], base[smooth])
    implicit = torch.stack([torch.autograd.grad(d, size, retain_graph=True)[0] for d in attached])
    torch.testing.assert_close(implicit, slopes[smooth], rtol=0, atol=2e-5)


def test_attaching_keeps_the_value() -> None:
    p = parameters(radius=torch.tensor([0.5], dtype=f64, requires_grad=True))
    rays, distance, _ = distances(p)
    assert (surface.attach(ball(p), rays, distance) == distance).all()
    torch.testing.assert_close(distance, closed_form(p).detach(), rtol=0, atol=1e-6)


def test_where_nothing_requires_grad_nothing_claims_to() -> None:
    p = parameters()
    rays, distance, _ = distances(p)
    assert not surface.attach(ball(p), rays, distance).requires_grad
    assert not surface.normals(ball(p), rays.at(distance)).requires_grad
    assert not surface.clearance(ball(p), rays, distance).requires_grad


def test_a_tangent_ray_has_no_derivative_rather_than_an_infinite_one() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    tangent = Rays(
        torch.tensor([[0.5, 0, -3], [0, 0, -3]], dtype=f64), torch.tensor([[0, 0, 1.0], [0, 0, 1]], dtype=f64)
    )
    attached = surface.attach(primitives.sphere(radius), tangent, torch.tensor([3, 2.5], dtype=f64))
    by_radius = [torch.autograd.grad(d, radius, retain_graph=True)[0].item() for d in attached]
    assert by_radius == [0, pytest.approx(-1)]


@given(
    seed=st.integers(0, 10**6),
    reach=st.sampled_from([0.05, 0.1]),
    off=st.floats(-0.9, 0.9),
)
def test_the_minimum_is_found_from_wherever_on_the_ray_one_starts(seed: int, reach: float, off: float) -> None:
    random = torch.Generator().manual_seed(seed)
    passes = 0.8 * torch.randn(50, 3, generator=random, dtype=f64)
    directions = normalize(torch.randn(50, 3, generator=random, dtype=f64), dim=-1)
    passes = passes - (passes * directions).sum(-1, keepdim=True) * directions
    rays = Rays(passes - 2 * directions, directions)  # the middle of a sphere is passed at a distance of 2
    sdf = primitives.sphere(0.3)
    start = torch.full((50,), 2 + off, dtype=f64)
    found, value = surface.minimum_and_value(sdf, rays, start, reach=reach)
    torch.testing.assert_close(found, torch.full((50,), 2.0, dtype=f64), rtol=0, atol=1e-4)
    torch.testing.assert_close(value, sdf(rays.at(found)))


def test_the_minimum_lies_within_the_bounds() -> None:
    """Downhill all the way: a plane's least value is where the ray leaves, or enters."""
    rays = Camera.orbit(0, 0, 4.97, height=9, width=9, dtype=f64).rays()
    bounds = meet_sphere(rays)
    rays, inside = rays[bounds.meets], bounds.meets
    bounds = meet_sphere(rays)
    middle = (bounds.near + bounds.far) / 2
    forward = torch.tensor([0.0, 0, -1], dtype=f64)
    for normal, least in ((-forward, bounds.far), (forward, bounds.near)):
        found = surface.minimum(primitives.plane(normal, -2.0), rays, middle, bounds)
        torch.testing.assert_close(found, least)
    assert inside.any()


def test_the_minimum_of_a_crease_is_found() -> None:
    """A ray between two balls, nearer to the one and then to the other."""
    sdf = primitives.union(
        primitives.sphere(0.2, torch.tensor([0.5, 0, 0], dtype=f64)), primitives.sphere(0.2, torch.zeros(3, dtype=f64))
    )
    rays = Rays(torch.tensor([[-0.5, 0.4, 0.3]], dtype=f64), torch.tensor([[1.0, 0, 0]], dtype=f64))
    found = surface.minimum(sdf, rays, torch.tensor([0.45], dtype=f64))
    assert found.item() == pytest.approx(0.5, abs=1e-4)
    crease = primitives.intersection(
        *(primitives.plane(torch.tensor([x, 1, 0], dtype=f64)) for x in (1.0, -2.0))
    )  # along the ray a V of unequal slopes, its corner at x = 0
    found = surface.minimum(crease, rays, torch.tensor([0.52], dtype=f64))
    values = [crease(rays.at(torch.tensor([t], dtype=f64))).item() for t in torch.linspace(0, 1, 10001).tolist()]
    assert crease(rays.at(found)).item() == pytest.approx(min(values), abs=5e-3)


@pytest.mark.parametrize("steepness", [1.0, 3.0, 10.0, 40.0])
def test_the_derivative_in_a_crooked_valley_is_that_of_the_corner(steepness: float) -> None:
    """f falls slowly along the ray up to its corner, and rises steeply; the corner moves with the ray."""
    falling = torch.tensor([-1.0, 0.5, 0.0], dtype=f64) / 100
    rising = torch.tensor([1.0, -2.0, 0.0], dtype=f64) * steepness / 100
    shift = torch.tensor(0.0, dtype=f64, requires_grad=True)
    starts = torch.linspace(-0.35, 0.35, 71, dtype=f64)
    zero = torch.zeros(71, dtype=f64)
    origins = torch.stack([zero - 1, zero + shift, zero], dim=1)
    rays = Rays(origins, torch.tensor([1.0, 0.0, 0.0], dtype=f64).expand(71, 3))
    found = surface.clearance(lambda p: torch.maximum(p @ falling, p @ rising), rays, 1 + starts)
    gradients = torch.stack([torch.autograd.grad(each, shift, retain_graph=True)[0] for each in found])
    share = steepness / (1 + steepness)
    true = share * falling[1] + (1 - share) * rising[1]
    torch.testing.assert_close(gradients, true.expand(71), rtol=1e-6, atol=0)


@every_parameter
def test_clearance_is_the_true_least_value_and_so_is_its_derivative(name: str) -> None:
    """The envelope theorem: along the ray the derivative is zero, so a fixed point will do – but only the right one."""
    facing = meet_sphere(camera(parameters()).rays(), 0.98).meets
    facing &= ~meet_sphere(camera(parameters()).rays(), 0.8).meets

    def least(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        rays = camera(p).rays()[facing]
        traced = sphere_trace(ball(p), rays, meet_sphere(rays.detach()), AGGRESSIVE)
        assert not traced.hit.any()
        return surface.clearance(ball(p), rays, traced.closest)

    def exact(value: Tensor) -> Tensor:
        p = parameters(**{name: value})
        rays = camera(p).rays()[facing]
        return torch.linalg.cross(rays.origins - p["centre"], rays.directions).norm(dim=-1) - p["radius"]

    at = torch.tensor(START[name], dtype=f64, requires_grad=True)
    assert facing.sum() > 10
    torch.testing.assert_close(least(at), exact(at), rtol=0, atol=1e-9)
    random = weights(exact(at))
    (implicit,) = torch.autograd.grad((least(at) * random).sum(), at)
    (closed,) = torch.autograd.grad((exact(at) * random).sum(), at)
    with torch.no_grad():
        numeric = differences(lambda value: (least(value) * random).sum(), at)
    torch.testing.assert_close(implicit, closed, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(implicit, numeric, rtol=1e-4, atol=1e-6)
