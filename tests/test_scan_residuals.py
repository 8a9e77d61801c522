"""Residuals of a placed shape: their derivatives, and what each kind of observation contributes."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from distrace.fields.decoder import Decoder, NetworkSpecs
from distrace.fitting.scan_residuals import PlacedCode, PlacementPrior, ScanProblem, ScanSample, extended
from distrace.fitting.solver import Residuals
from distrace.pose import Similarity
from distrace.prior import prior_of
from distrace.rays import Rays

PLACE = Similarity(torch.eye(3), torch.tensor([0.3, -1.0, 4.0]), torch.tensor(2.0)).moved(
    torch.tensor([0.2, 0.5, -0.1, 0.0, 0.0, 0.0, 0.1])
)


def problem(points: Tensor, rays: Rays, until: Tensor, free: int, **options: bool) -> tuple[ScanProblem, PlacedCode]:
    torch.manual_seed(0)
    decoder = Decoder(NetworkSpecs(dims=(32, 32, 32), code_length=4, latent_in=(2,), norm_layers=())).double()
    prior = prior_of(torch.randn(9, 4).double())
    place = Similarity(PLACE.rotation.double(), PLACE.translation.double(), PLACE.scale.double())
    state = PlacedCode(0, prior.mean, torch.tensor([0.3, -0.2, 0.5]).double(), place)
    up = torch.tensor([0.0, 1.0, 0.0]).double()
    sample = ScanSample(points.double(), Rays(rays.origins.double(), rays.directions.double()), until.double(), free)
    return ScanProblem(
        decoder,
        prior,
        sample,
        0.1,
        [PlacementPrior(1.8, torch.tensor([0.1, -0.9, 4.2]).double(), up, 0.2, 0.3)],
        0.1,
        8,
        **options,
    ), state


def nothing() -> tuple[Rays, Tensor]:
    return Rays(torch.empty(0, 3), torch.empty(0, 3)), torch.empty(0)


def points_about(place: Similarity, radius: float) -> Tensor:
    inside = torch.randn(40, 3, generator=torch.Generator().manual_seed(1))
    return place.to_world(radius * inside / inside.norm(dim=-1, keepdim=True))


@pytest.mark.parametrize("radius", [0.7, 1.4], ids=["inside", "beyond"])
def test_the_jacobian_is_exact_inside_and_beyond_the_sphere(radius: float) -> None:
    rays, until = nothing()
    fit, state = problem(points_about(PLACE, radius), rays, until, 0)
    (found,) = fit.residuals([state])
    step = 1e-6
    for unknown in range(len(state.w) + 7):
        ahead, behind = (
            fit.residuals(fit.retract([state], [sign * step * torch.eye(len(state.w) + 7).double()[unknown]]))[0]
            for sign in (1, -1)
        )
        difference = (ahead.values - behind.values) / (2 * step)
        torch.testing.assert_close(found.jacobian[:, unknown], difference, atol=2e-4, rtol=1e-4)


def test_a_known_placement_stays() -> None:
    rays, until = nothing()
    fit, state = problem(points_about(PLACE, 0.7), rays, until, 0, moves=False)
    (found,) = fit.residuals([state])
    assert found.jacobian.shape[1] == len(state.w), "only the code is unknown"
    (moved,) = fit.retract([state], [torch.ones(len(state.w)).double()])
    assert moved.place is state.place
    torch.testing.assert_close(moved.w, state.w + 1)


def across(count: int) -> Rays:
    """Rays through the placed sphere along −z, some of which pass beside it."""
    x = torch.linspace(-2.5, 2.5, count)
    origins = PLACE.translation + torch.stack([x, torch.zeros(count), torch.full((count,), 10.0)], dim=1)
    return Rays(origins, torch.tensor([0.0, 0.0, -1.0]).expand(count, 3))


def of_rays(found: Residuals) -> Tensor:
    return found.values[: -(3 + 1 + 3 + 3)]


def test_free_rays_count_where_they_enter_the_shape_and_hits_where_they_miss_it() -> None:
    count = 60
    fit, state = problem(torch.empty(0, 3), across(count), torch.full((count,), torch.inf), count)
    with torch.no_grad():  # a field of both signs
        samples = fit.decoder.field(state.code(fit.prior))(0.5 * torch.randn(500, 3).double())
        fit.decoder.lin3.bias -= samples.atanh().median()
    (free,) = fit.residuals([state])
    assert (of_rays(free) < 0).all()
    fit.sample = ScanSample(fit.sample.points, fit.sample.rays, fit.sample.until, 0)
    (hits,) = fit.residuals([state])
    assert (of_rays(hits) > 0).all()
    in_object = state.place.rays_in_object(fit.sample.rays)
    meets = (torch.linalg.cross(in_object.origins, in_object.directions).norm(dim=-1) < 1).sum()
    assert 0 < len(of_rays(hits)) < meets
    both = len(of_rays(free)) + len(of_rays(hits))
    assert meets <= both < 2 * meets, "each ray that meets the sphere is one or the other, or both within the margin"


def test_nothing_counts_behind_the_end_of_a_free_ray() -> None:
    fit, state = problem(torch.empty(0, 3), across(60), torch.full((60,), 7.5), 60)
    (found,) = fit.residuals([state])
    assert len(of_rays(found)) == 0, "the sphere begins 7.8 units from the origins"


def test_beyond_the_sphere_the_distance_to_it_is_added() -> None:
    fit, state = problem(torch.empty(0, 3), *nothing(), 0)
    direction = torch.nn.functional.normalize(torch.tensor([[1.0, 2.0, -2.0]]).double(), dim=-1)
    values, _, _ = extended(fit.decoder, torch.cat([direction, 3 * direction]), state.code(fit.prior))
    torch.testing.assert_close(values[1], values[0] + 2)


def test_signed_distances_are_met_and_far_ones_only_tell_the_side() -> None:
    fit, state = problem(points_about(PLACE, 0.7), *nothing(), 0, moves=False)
    with torch.no_grad():
        values = fit.decoder.field(state.code(fit.prior))(state.place.to_object(fit.sample.points))
    fit.sample = replace(fit.sample, distances=torch.full((40,), 0.05).double())
    (near,) = fit.residuals([state])
    torch.testing.assert_close(near.values[:40] * fit.deviation, state.place.scale * values - 0.05)
    fit.decoder.lin3.bias.data += 3.0  # all is far outside
    fit.sample = replace(fit.sample, distances=torch.full((40,), 5.0).double())
    (right,) = fit.residuals([state])
    assert (right.values[:40] == 0).all()
    assert (right.jacobian[:40] == 0).all()
    fit.sample = replace(fit.sample, distances=torch.full((40,), -5.0).double())
    (wrong,) = fit.residuals([state])
    assert (wrong.values[:40] > 0).all()


def test_a_placement_deviations_by_its_size_or_by_its_centre() -> None:
    likely = PlacementPrior(2.0, PLACE.translation, None, size_deviation=0.1, centre_deviation=0.05)
    place = Similarity(PLACE.rotation, PLACE.translation, torch.tensor(2.0))
    assert likely.prior_deviation(place) == pytest.approx(0, abs=1e-5)
    assert likely.prior_deviation(replace_scale(place, 2.0 * torch.e**0.2)) == pytest.approx(2, rel=1e-3)
    moved = Similarity(place.rotation, place.translation + torch.tensor([0.3, -0.3, 0.3]), place.scale)
    assert likely.prior_deviation(moved) == pytest.approx(3, rel=1e-3), "0.15 sizes along each axis"


def replace_scale(place: Similarity, scale: float) -> Similarity:
    return Similarity(place.rotation, place.translation, torch.tensor(scale))
