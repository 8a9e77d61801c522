"""Rays, and where they meet the sphere that bounds a field, or a box."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from distrace.rays import Bounds, Rays, meet_box, meet_sphere


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


LOW, HIGH = torch.tensor([-0.5, -0.2, 0.1], dtype=torch.float64), torch.tensor([0.4, 0.3, 0.9], dtype=torch.float64)


def slow_box(origin: list[float], direction: list[float]) -> tuple[float, float]:
    """Side by side, in plain Python; an empty stretch where the ray misses."""
    near, far = 0.0, math.inf
    for o, v, low, high in zip(origin, direction, LOW.tolist(), HIGH.tolist()):
        if v == 0:
            near, far = (near, far) if low <= o <= high else (math.inf, -math.inf)
        else:
            ends = sorted([(low - o) / v, (high - o) / v])
            near, far = max(near, ends[0]), min(far, ends[1])
    return (near, far) if near < far else (math.inf, -math.inf)


def assert_as_slow(rays: Rays) -> Bounds:
    bounds = meet_box(rays, LOW, HIGH)
    expected = [slow_box(o, v) for o, v in zip(rays.origins.tolist(), rays.directions.tolist())]
    true = torch.tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(torch.stack([bounds.near, bounds.far], dim=-1), true)
    return bounds


@given(seed=st.integers(0, 10**6), spread=st.floats(0.1, 2))
def test_a_ray_meets_a_box_as_it_meets_its_sides_one_by_one(seed: int, spread: float) -> None:
    bounds = assert_as_slow(random_rays(seed, spread=spread))
    assert (bounds.near >= 0).all()
    assert not bounds.meets.all()


@given(seed=st.integers(0, 10**6), parallel=st.integers(1, 2), negative=st.booleans())
def test_rays_along_the_sides_of_a_box_meet_it_too(seed: int, parallel: int, negative: bool) -> None:
    """Directions with zeros of either sign, origins inside and outside."""
    rays = random_rays(seed, spread=0.5)
    directions = rays.directions.clone()
    directions[:, :parallel] = -0.0 if negative else 0.0
    bounds = assert_as_slow(Rays(rays.origins, normalize(directions, dim=-1)))
    assert bounds.meets.any()
    assert not bounds.meets.all()


@given(seed=st.integers(0, 10**6))
def test_from_within_a_box_a_ray_begins_at_once_and_leaves_through_a_side(seed: int) -> None:
    inside = LOW + (HIGH - LOW) * torch.rand(100, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    rays = Rays(inside, random_rays(seed, 100).directions)
    bounds = meet_box(rays, LOW, HIGH)
    assert (bounds.near == 0).all()
    assert bounds.meets.all()
    end = rays.at(bounds.far)
    assert torch.minimum((end - LOW).abs(), (end - HIGH).abs()).amin(-1).max() < 1e-9
    assert ((end > LOW - 1e-9) & (end < HIGH + 1e-9)).all()


def test_a_box_behind_a_ray_is_not_met() -> None:
    bounds = meet_box(ray([0, 0, 2], [0, 0, 1]), LOW, HIGH)
    assert (bounds.near.item(), bounds.far.item()) == (math.inf, -math.inf)


def test_a_ray_in_the_plane_of_a_side_gives_numbers() -> None:
    bounds = meet_box(ray([-0.5, 0, 2], [0, 0, -1]), LOW, HIGH)
    assert (bounds.near.item(), bounds.far.item()) == pytest.approx((1.1, 1.9))
