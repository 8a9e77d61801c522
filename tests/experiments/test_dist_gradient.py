"""DIST's own gradient: the march that it belongs to, and by how much it is wrong on a sphere."""

import pytest
import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.fields.primitives import sphere
from distrace.rays import Rays, meet_sphere
from distrace.tracing.sphere_tracing import AGGRESSIVE, sphere_trace
from experiments.costs.dist_gradient import attach_dist, march

f64 = torch.float64
FACING = Rays(torch.tensor([[0.0, 0, 5]], dtype=f64), torch.tensor([[0.0, 0, -1]], dtype=f64))
VIEW = Camera.orbit(30, 20, 4.97, height=24, width=24, dtype=f64)


def ratio(rays: Rays, queries: int) -> Tensor:
    """Of DIST's derivative of distance by the radius to the exact one, −1 / cos θ."""
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    marched = march(sphere(radius), rays, meet_sphere(rays))
    distance = attach_dist(sphere(radius), rays, marched, queries)
    hit = distance.isfinite()
    slopes = torch.stack([torch.autograd.grad(d, radius, retain_graph=True)[0] for d in distance[hit]])
    return slopes * (rays[hit].at(distance[hit].detach()) * rays[hit].directions).sum(-1) / 0.5


@pytest.mark.parametrize(("queries", "wrong"), [(1, 1.5), (3, 4.5), (5, 7.5)])
def test_at_a_facing_pixel_it_counts_the_motion_of_the_surface_once_per_query(queries: int, wrong: float) -> None:
    assert ratio(FACING, queries).item() == pytest.approx(wrong, rel=1e-3)


@pytest.mark.parametrize(("queries", "wrong"), [(1, 0.85), (3, 2.56), (5, 3.42)])
def test_at_a_grazing_pixel_it_is_wrong_by_less_and_by_another_factor(queries: int, wrong: float) -> None:
    """As measured with the original code, at cos θ = 0.57; values beyond the clamp have no gradient."""
    aside = 0.5 * (1 - (0.85 / 1.5) ** 2) ** 0.5
    grazing = Rays(FACING.origins + torch.tensor([aside, 0, 0], dtype=f64), FACING.directions)
    assert ratio(grazing, queries).item() == pytest.approx(wrong, rel=0.03)


def test_the_factor_is_nowhere_the_same_over_an_image() -> None:
    found = ratio(VIEW.rays().flat(), 3)
    assert len(found) > 50
    assert found.max() / found.min() > 2


def test_the_march_ends_where_sphere_tracing_ends() -> None:
    rays = VIEW.rays()
    marched = march(sphere(0.5), rays, meet_sphere(rays))
    traced = sphere_trace(sphere(0.5), rays, meet_sphere(rays), AGGRESSIVE)
    assert torch.equal(marched.distance.isfinite(), traced.hit)
    torch.testing.assert_close(marched.distance[traced.hit], traced.distance[traced.hit], rtol=0, atol=6e-4)


def test_the_last_queries_are_the_ones_before_the_end() -> None:
    marched = march(sphere(0.5), FACING, meet_sphere(FACING), queries=4)
    last = marched.last[:, 0]
    values = sphere(0.5)(FACING.origins[0] + last[:, None] * FACING.directions[0])
    torch.testing.assert_close(last[1:], last[:-1] + 1.5 * values[:-1])
    assert values[-1].abs() < AGGRESSIVE.tolerance
    assert (values[:-1].abs() > AGGRESSIVE.tolerance).all()
    torch.testing.assert_close(marched.distance[0], last[-1] + 1.5 * values[-1])


def test_a_ray_with_fewer_queries_has_the_gradient_of_those() -> None:
    beside = Rays(torch.tensor([[0.0, 0, 0.5 + 1e-6]], dtype=f64), FACING.directions)
    assert ratio(beside, 5).item() == pytest.approx(1.5)


def test_misses_stay_infinite_and_give_no_gradient() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    past = Rays(FACING.origins + torch.tensor([0.9, 0, 0], dtype=f64), FACING.directions)
    distance = attach_dist(sphere(radius), past, march(sphere(radius), past, meet_sphere(past)), 5)
    assert distance.item() == torch.inf
    assert torch.autograd.grad(distance.sum(), radius)[0] == 0


def test_the_camera_gets_a_gradient_that_is_wrong_by_the_same_factor() -> None:
    origins = FACING.origins.clone().requires_grad_()
    distance = attach_dist(
        sphere(0.5), Rays(origins, FACING.directions), march(sphere(0.5), FACING, meet_sphere(FACING)), 3
    )
    (slope,) = torch.autograd.grad(distance.sum(), origins)
    torch.testing.assert_close(slope, torch.tensor([[0, 0, 4.5]], dtype=f64))


def test_no_query_at_all_is_refused() -> None:
    with pytest.raises(ValueError, match="last 0 queries"):
        march(sphere(0.5), FACING, meet_sphere(FACING), queries=0)
