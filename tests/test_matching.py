"""Patches compared between views: of a painted ball, whose surface and colours are known."""

from dataclasses import replace

import pytest
import torch
from photographed import EXACT, striped_ball
from test_fit_photos import ring
from torch.nn import functional as F

from distrace.data.photograph import Photograph
from distrace.fields.primitives import sphere
from distrace.fitting.ray_sampling import band
from distrace.rays import Rays, meet_sphere
from distrace.reconstruction.matching import PATCH_WIDTH, PatchMatching, correlation
from distrace.tracing.sphere_tracing import sphere_trace


@pytest.fixture(scope="module")
def views() -> list[Photograph]:
    return striped_ball(ring(16, 120))


def rays_of(views: list[Photograph], every: int = 97) -> tuple[torch.Tensor, torch.Tensor, Rays]:
    """Views, pixels and rays of some of the ball's pixels."""
    view = []
    places = []
    origins = []
    directions = []
    for number, each in enumerate(views):
        some = each.camera.pixels()[each.known_mask & ~band(each.known_mask, PATCH_WIDTH)][::every]
        rays = each.camera.rays(some)
        view.append(torch.full((len(some),), number))
        places.append(some)
        origins.append(rays.origins)
        directions.append(rays.directions)
    return torch.cat(view), torch.cat(places), Rays(torch.cat(origins), torch.cat(directions))


def patch_loss(matching: PatchMatching, views: list[Photograph], radius: float) -> float:
    view, places, rays = rays_of(views)
    trace = sphere_trace(sphere(radius), rays, meet_sphere(rays), EXACT)
    points = rays[trace.hit].at(trace.distance[trace.hit])
    return float(matching.loss(sphere(radius), view[trace.hit], places[trace.hit], points, F.normalize(points, dim=-1)))


def test_the_true_surface_agrees_best(views: list[Photograph]) -> None:
    matching = PatchMatching.of(views, torch.device("cpu"))
    true = patch_loss(matching, views, 0.5)
    assert true < 0.01
    for radius in (0.49, 0.495, 0.505, 0.51):
        assert patch_loss(matching, views, radius) > 1.2 * true


def test_images_may_differ_in_size_and_light(views: list[Photograph]) -> None:
    small = views[3].resized(0.5)
    some = [*views[:3], replace(small, image=0.3 * small.image + 0.1), *views[4:]]
    assert patch_loss(PatchMatching.of(some, torch.device("cpu")), some, 0.5) < 0.03


def test_the_derivative_by_the_points_is_that_of_finite_differences() -> None:
    views = striped_ball(ring(16, 40))
    matching = PatchMatching.of(views, torch.device("cpu"))
    doubled = PatchMatching(*(x.double() if x.is_floating_point() else x for x in vars(matching).values()))
    view, places, rays = rays_of(views, 61)
    rays = Rays(rays.origins.double(), F.normalize(rays.directions.double(), dim=-1))
    trace = sphere_trace(sphere(0.49), rays, meet_sphere(rays), EXACT)
    view = view[trace.hit]
    places = places[trace.hit].double()
    rays = rays[trace.hit]
    normals = F.normalize(rays.at(trace.distance[trace.hit]), dim=-1)

    def loss(distance: torch.Tensor, turned: torch.Tensor) -> torch.Tensor:
        return doubled.loss(
            lambda points: 0 * points[..., 0], view, places, rays.at(distance), F.normalize(normals + turned, dim=-1)
        )

    given = (trace.distance[trace.hit].requires_grad_(), torch.zeros_like(normals).requires_grad_())
    exact = torch.autograd.grad(loss(*given), given)
    random = torch.Generator().manual_seed(0)
    for number in range(2):
        step = 1e-7 * torch.randn(given[number].shape, generator=random, dtype=torch.float64)
        there = [[x + sign * step if n == number else x for n, x in enumerate(given)] for sign in (1, -1)]
        with torch.no_grad():
            found = (loss(*there[0]) - loss(*there[1])) / 2
        assert float(found) == pytest.approx(float((exact[number] * step).sum()), rel=1e-3)


def test_what_faces_away_is_not_compared(views: list[Photograph]) -> None:
    matching = PatchMatching.of(views, torch.device("cpu"))
    view, places, rays = rays_of(views)
    points = rays.at(torch.full_like(rays.origins[:, 0], 2.0))
    assert float(matching.loss(sphere(0.5), view, places, points, rays.directions)) == 0.0


def test_correlation_knows_neither_brightness_nor_contrast() -> None:
    patch = torch.rand(4, 25, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(correlation(patch, 0.3 * patch + 0.5), torch.ones(4), atol=1e-4)
    assert torch.allclose(correlation(patch, 1 - patch), -torch.ones(4), atol=1e-4)
    assert correlation(patch, torch.full_like(patch, 0.5)).abs().max() < 1e-6
