"""Rays, and where they meet the sphere that bounds a field."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from distrace.rays import Bounds, Rays, meet_sphere


def random_rays(seed: int, count: int = 200, spread: float = 2.0) -> Rays:
    random = torch.Generator().manual_seed(seed)
    origins = spread * torch.randn(count, 3, generator=random, dtype=torch.float64)
    return Rays(origins, normalize(torch.randn(count, 3, generator=random, dtype=torch.float64), dim=-1))


def ray(origin: list[float], direction: list[float]) -> Rays:
    return Rays(torch.tensor([origin], dtype=torch.float64), torch.tensor([direction], dtype=torch.float64))


@given(seed=st.integers(0, 10**6), radius=st.floats(0.5, 3.0))
def test_a_ray_enters_and_leaves_on_the_sphere(seed: int, radius: float) -> None:
    rays = random_rays(seed)
    bounds = meet_sphere(rays, radius)
    met = rays[bounds.meets]
    near, far = bounds.near[bounds.meets], bounds.far[bounds.meets]
    assert len(near)
    torch.testing.assert_close(met.at(far).norm(dim=-1), torch.full_like(far, radius))
    starts_inside = met.origins.norm(dim=-1) < radius
    assert (near[starts_inside] == 0).all()
    torch.testing.assert_close(met.at(near)[~starts_inside].norm(dim=-1), torch.full_like(near[~starts_inside], radius))
    assert (met.at((near + far) / 2).norm(dim=-1) < radius).all()


@given(seed=st.integers(0, 10**6))
def test_a_ray_that_misses_is_outside_everywhere(seed: int) -> None:
    rays = random_rays(seed)
    bounds = meet_sphere(rays)
    missing = rays[~bounds.meets]
    along = torch.linspace(0, 10, 50, dtype=torch.float64)[:, None].expand(-1, len(missing.origins))
    assert (missing.at(along).norm(dim=-1) >= 1).all()
    assert (bounds.near[~bounds.meets] == torch.inf).all()
    assert (bounds.far[~bounds.meets] == -torch.inf).all()


def test_a_ray_down_the_axis_meets_where_it_should() -> None:
    bounds = meet_sphere(ray([0, 0, -3], [0, 0, 1]))
    assert (bounds.near.item(), bounds.far.item()) == (2, 4)


@pytest.mark.parametrize("origin", [[0, 0, 3], [1, 0, -3], [0, 2, -3]], ids=["behind", "tangent", "beside"])
def test_rays_that_do_not_enter(origin: list[float]) -> None:
    assert not meet_sphere(ray(origin, [0, 0, 1])).meets.any()


def test_from_far_away_float32_loses_no_more_than_the_distance_does() -> None:
    """The discriminant b² − c of the textbook is off by 0.1 here."""
    exact = random_rays(0, count=1000, spread=0.3)
    exact = Rays(exact.origins - 1000 * exact.directions, exact.directions)
    rough = Rays(exact.origins.float(), normalize(exact.directions.float(), dim=-1))
    true = meet_sphere(Rays(rough.origins.double(), rough.directions.double()))
    rough_bounds = meet_sphere(rough)
    well_inside = true.far - true.near > 0.5
    assert rough_bounds.meets[well_inside].all()
    assert (rough_bounds.near.double() - true.near)[well_inside].abs().max() < 1e-3


def test_rays_are_indexed_flattened_and_detached_as_their_tensors_are() -> None:
    origins = torch.randn(2, 5, 3, requires_grad=True)
    rays = Rays(origins, normalize(torch.randn(2, 5, 3), dim=-1))
    assert rays.shape == (2, 5)
    assert rays.flat().shape == (10,)
    chosen = rays[torch.tensor([[True, False] * 2 + [True]] * 2)]
    assert chosen.shape == (6,)
    torch.testing.assert_close(chosen.directions[0], rays.directions[0, 0])
    torch.testing.assert_close(rays.at(torch.full((2, 5), 2.0)), rays.origins + 2 * rays.directions)
    assert rays.at(torch.zeros(2, 5)).requires_grad
    assert not rays.detach().at(torch.zeros(2, 5)).requires_grad


def test_bounds_without_length_meet_nothing() -> None:
    assert Bounds(torch.tensor([1.0, 1.0, 2.0]), torch.tensor([2.0, 1.0, 1.0])).meets.tolist() == [True, False, False]
