"""What a lattice foretells of rays: roots where they are, nothing where there is none, and no start behind a hit."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn.functional import normalize

from distrace import primitives
from distrace.evaluation.bench import reference_distance
from distrace.fast.forecast import Forecast, Kind, Known, corrected, forecast
from distrace.fast.lattice import Lattice, LatticeConfig, build
from distrace.field import SDF
from distrace.rays import Bounds, Rays, meet_sphere

f64 = torch.float64
RADIUS = 0.6
SHAPES = {
    "sphere": primitives.sphere(RADIUS),
    "off the middle": primitives.sphere(0.4, torch.tensor([0.3, -0.2, 0.1], dtype=f64)),
    "torus": primitives.torus(0.6, 0.2),
    "capsule": primitives.capsule(
        torch.tensor([-0.5, 0, 0.2], dtype=f64), torch.tensor([0.5, 0.3, 0], dtype=f64), 0.15
    ),
}
every_shape = pytest.mark.parametrize("name", SHAPES)


def refuses(points: torch.Tensor) -> torch.Tensor:
    raise AssertionError("a forecast asks the field nothing")


def lattice_of(sdf: SDF) -> Lattice:
    """Its field is taken away."""
    return replace(build(sdf, LatticeConfig(), torch.empty(0, dtype=f64)), field=refuses, near=refuses)


LATTICES = {name: lattice_of(sdf) for name, sdf in SHAPES.items()}
BALL = LATTICES["sphere"]


def random_rays(seed: int, count: int = 1000, reach: float = 0.8) -> Rays:
    """From outside of the sphere, through points in a cube."""
    random = torch.Generator().manual_seed(seed)
    origins = 2 * normalize(torch.randn(count, 3, generator=random, dtype=f64), dim=-1)
    targets = reach * (2 * torch.rand(count, 3, generator=random, dtype=f64) - 1)
    return Rays(origins, normalize(targets - origins, dim=-1))


def ahead(lattice: Lattice, rays: Rays, bounds: Bounds | None = None, **options) -> Forecast:
    bounds = bounds or meet_sphere(rays)
    return forecast(lattice, rays, bounds.near, bounds.far, **options)


def past_the_ball(clearance: float) -> Rays:
    """Parallel to z."""
    return Rays(torch.tensor([[0, RADIUS + clearance, 2]], dtype=f64), torch.tensor([[0, 0, -1]], dtype=f64))


@given(seed=st.integers(0, 1000))
def test_the_root_of_a_sphere_is_foretold_within_the_slack(seed: int) -> None:
    rays = random_rays(seed)
    true = meet_sphere(rays, RADIUS)
    points = rays.at(true.near.nan_to_num(posinf=0.0))
    slope = (points * rays.directions).sum(-1) / RADIUS
    facing = true.meets & (slope < -0.4)
    foretold = ahead(BALL, rays)
    assert (foretold.kind[facing] == Kind.ROOT).all()
    off = (foretold.distance - true.near)[facing].abs()
    assert (off * -slope[facing] < BALL(points[facing])[1]).all()
    assert off.max() < 0.006
    assert (foretold.slope - slope)[facing].abs().max() < 0.1


@given(seed=st.integers(0, 1000), offset=st.floats(-0.5, 0.5))
def test_the_root_of_a_plane_is_foretold_exactly(seed: int, offset: float) -> None:
    """Where it is not by the sphere's rim, outside of which nothing was evaluated."""
    rays, normal = random_rays(seed), random_rays(seed + 1, 1).directions[0]
    slope = rays.directions @ normal
    distance = (offset - rays.origins @ normal) / slope
    clear = (
        (slope < -0.2) & (rays.at(distance).norm(dim=-1) < 0.7) & (rays.at(meet_sphere(rays).near) @ normal > offset)
    )
    foretold = ahead(lattice_of(primitives.plane(normal, offset)), rays)
    assert (foretold.kind[clear] == Kind.ROOT).all()
    torch.testing.assert_close(foretold.distance[clear], distance[clear], rtol=0, atol=1e-6)
    torch.testing.assert_close(foretold.slope[clear], slope[clear], rtol=0, atol=1e-6)


@every_shape
def test_a_ray_that_passes_clearly_meets_nothing(name: str) -> None:
    """By half a cell."""
    sdf, lattice, rays = SHAPES[name], LATTICES[name], random_rays(0)
    bounds = meet_sphere(rays)
    along = torch.linspace(0, 1, 200, dtype=f64)[:, None]
    least = sdf(rays.at(bounds.near + along * (bounds.far - bounds.near))).amin(0)
    clear = bounds.meets & (least > lattice.cell / 2)
    foretold = ahead(lattice, rays)[clear.nonzero()[:, 0]]
    assert len(foretold.kind)
    assert (foretold.kind == Kind.NOTHING).all()
    assert (foretold.begins == torch.inf).all()
    assert (foretold.distance == torch.inf).all()


@given(st.sampled_from(sorted(SHAPES)), st.integers(0, 1000), st.floats(0.1, 0.9))
def test_the_surface_does_not_begin_behind_the_first_hit(name: str, seed: int, reach: float) -> None:
    """But for the shortest step: an eighth of a cell."""
    lattice, rays = LATTICES[name], random_rays(seed, 200, reach)
    true = reference_distance(SHAPES[name], rays, meet_sphere(rays))
    hit = torch.isfinite(true)
    foretold = ahead(lattice, rays)
    assert (foretold.kind[hit] != Kind.NOTHING).all()
    assert (foretold.begins[hit] <= true[hit] + lattice.cell / 8).all()


@given(radius=st.floats(0.1, 0.8), shift=st.floats(-0.15, 0.15), seed=st.integers(0, 1000))
def test_the_surface_of_any_ball_does_not_begin_behind_the_first_hit(radius: float, shift: float, seed: int) -> None:
    centre, rays = torch.tensor([shift, -shift / 2, shift / 3], dtype=f64), random_rays(seed, 300)
    lattice = lattice_of(primitives.sphere(radius, centre))
    true = meet_sphere(Rays(rays.origins - centre, rays.directions), radius)
    foretold = ahead(lattice, rays)
    assert (foretold.kind[true.meets] != Kind.NOTHING).all()
    assert (foretold.begins <= true.near + lattice.cell / 8)[true.meets].all()


@every_shape
def test_a_root_or_a_near_place_is_not_before_where_the_surface_begins(name: str) -> None:
    foretold = ahead(LATTICES[name], random_rays(1))
    met = foretold.kind != Kind.NOTHING
    assert met.any()
    assert (foretold.distance[met] > foretold.begins[met] - LATTICES[name].cell / 4 - 1e-9).all()
    assert torch.isfinite(foretold.begins[met]).all()


def test_a_ray_that_nearly_touches_is_told_to_be_near() -> None:
    rays = past_the_ball(1e-4)
    foretold = ahead(BALL, rays)
    assert foretold.kind.item() == Kind.NEAR
    assert foretold.distance.item() == pytest.approx(2, abs=BALL.cell)
    assert foretold.begins.item() < 2
    assert foretold.slope.isnan().all()


def test_what_is_but_near_is_passed_where_that_is_asked_for() -> None:
    assert ahead(BALL, past_the_ball(1e-4), pass_near=True).kind.item() == Kind.NOTHING


@every_shape
def test_passing_what_is_near_changes_no_root_and_leaves_nothing_near(name: str) -> None:
    rays = random_rays(2)
    foretold, passing = ahead(LATTICES[name], rays), ahead(LATTICES[name], rays, pass_near=True)
    assert (foretold.kind == Kind.NEAR).any()
    assert not (passing.kind == Kind.NEAR).any()
    root = foretold.kind == Kind.ROOT
    assert (passing.kind[root] == Kind.ROOT).all()
    torch.testing.assert_close(passing.distance[root], foretold.distance[root], rtol=0, atol=1e-12)


def test_behind_what_was_near_the_next_surface_is_foretold() -> None:
    """A ball that a ray nearly touches hides a wall: from `stopped` on, or at once where near places are passed."""
    wall = primitives.box(torch.tensor([0.3, 0.3, 0.1], dtype=f64))
    placed = torch.tensor([0, 0, -0.5], dtype=f64)
    ball = primitives.sphere(0.2, torch.tensor([0, 0.2 + 1e-4, 0.3], dtype=f64))
    lattice = lattice_of(primitives.union(ball, lambda points: wall(points - placed)))
    rays = Rays(torch.tensor([[0, 0, 2]], dtype=f64), torch.tensor([[0, 0, -1]], dtype=f64))
    first = onward = ahead(lattice, rays)
    assert first.kind.item() == Kind.NEAR
    assert first.distance.item() == pytest.approx(1.7, abs=lattice.cell)
    for _ in range(3):
        if onward.kind.item() == Kind.NEAR:
            onward = forecast(lattice, rays, onward.stopped, meet_sphere(rays).far)
    for foretold in (onward, ahead(lattice, rays, pass_near=True)):
        assert foretold.kind.item() == Kind.ROOT
        assert foretold.distance.item() == pytest.approx(2.4, abs=0.02)
        assert 1.7 < foretold.begins.item() < 2.4


def test_nothing_is_foretold_before_the_first_or_behind_the_last_of_a_rays_bounds() -> None:
    rays = random_rays(3)
    true = meet_sphere(rays, RADIUS)
    before = Bounds(meet_sphere(rays).near, true.near - 0.1)
    behind = Bounds(true.far + 0.1, meet_sphere(rays).far)
    empty = Bounds(meet_sphere(rays).far, meet_sphere(rays).near)
    for bounds in (before, behind, empty):
        foretold = ahead(BALL, rays[true.meets], Bounds(bounds.near[true.meets], bounds.far[true.meets]))
        assert (foretold.kind == Kind.NOTHING).all()


def test_a_ray_that_starts_in_the_solid_is_there_already() -> None:
    rays = Rays(torch.zeros(1, 3, dtype=f64), torch.tensor([[0, 0, 1]], dtype=f64))
    foretold = ahead(BALL, rays)
    assert foretold.kind.item() == Kind.ROOT
    assert foretold.begins.item() == 0


def test_closest_is_beside_the_point_that_a_ray_passes_by() -> None:
    rays = random_rays(4)
    foot = -(rays.origins * rays.directions).sum(-1)
    passes = (rays.at(foot).norm(dim=-1) > RADIUS + 0.05) & meet_sphere(rays).meets
    closest = ahead(BALL, rays).closest[passes]
    assert len(closest)
    value = SHAPES["sphere"](rays[passes].at(closest))
    torch.testing.assert_close(value, rays.at(foot)[passes].norm(dim=-1) - RADIUS, rtol=0, atol=0.02)


def known_at(points: torch.Tensor, lattice: Lattice, sdf: SDF) -> Known:
    """One sample beside each point, which tells by how much the lattice was off there."""
    errors = sdf(points) - lattice(points)[0]
    return Known(points[:, None], errors[:, None], torch.ones(len(points), 1, dtype=f64))


@every_shape
def test_known_samples_bring_values_closer_to_the_truth(name: str) -> None:
    sdf, lattice, rays = SHAPES[name], LATTICES[name], random_rays(5)
    true = reference_distance(sdf, rays, meet_sphere(rays))
    points = rays.at(true)[torch.isfinite(true)]
    aside = 0.1 * lattice.cell * random_rays(6, len(points)).directions
    value, slack = corrected(lattice, points, known_at(points + aside, lattice, sdf))
    plain_value, plain_slack = lattice(points)
    assert value.abs().mean() < 0.3 * plain_value.abs().mean()
    assert slack.mean() < 0.5 * plain_slack.mean()
    assert (slack <= plain_slack).all()
    assert (value.abs() <= slack).double().mean() > 0.99


def test_at_a_known_sample_the_value_is_the_sample() -> None:
    points = RADIUS * random_rays(7).directions
    value, slack = corrected(BALL, points, known_at(points, BALL, SHAPES["sphere"]))
    torch.testing.assert_close(value, torch.zeros_like(value), rtol=0, atol=1e-12)
    assert slack.max() < 2e-5


def test_samples_that_are_unknown_or_far_away_change_nothing() -> None:
    points = RADIUS * random_rays(8).directions
    known = known_at(points, BALL, SHAPES["sphere"])
    unknown = Known(known.points, known.errors * torch.nan, known.weights)
    far = Known(known.points * 1.1, known.errors, known.weights)
    for useless in (unknown, far, None):
        torch.testing.assert_close(corrected(BALL, points, useless), BALL(points), rtol=0, atol=0)


def test_samples_that_contradict_each_other_leave_doubt() -> None:
    points = RADIUS * random_rays(9).directions
    same = Known(points[:, None].expand(-1, 2, 3), torch.tensor([[1e-3, -1e-3]], dtype=f64).expand(len(points), 2),
                 torch.ones(len(points), 2, dtype=f64))  # fmt: skip
    value, slack = corrected(BALL, points, same)
    torch.testing.assert_close(value, BALL(points)[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(slack, BALL(points)[1].clamp_max(1e-3 + 1e-5), rtol=0, atol=1e-12)


def test_a_root_is_foretold_more_closely_with_known_samples_beside() -> None:
    rays = random_rays(10)
    true = meet_sphere(rays, RADIUS)
    facing = true.meets & ((rays.at(true.near.nan_to_num(posinf=0.0)) * rays.directions).sum(-1) < -0.5 * RADIUS)
    rays, distance = rays[facing], true.near[facing]
    known = known_at(rays.at(distance) + 0.005, BALL, SHAPES["sphere"])
    plain, knowing = ahead(BALL, rays), ahead(BALL, rays, known=known)
    assert (knowing.kind == Kind.ROOT).all()
    assert (knowing.distance - distance).abs().mean() < 0.2 * (plain.distance - distance).abs().mean()


def test_forecasts_are_taken_over_ray_by_ray() -> None:
    rays = random_rays(11, 20)
    whole, chosen = ahead(BALL, rays), torch.tensor([3, 11, 4])
    taken = ahead(LATTICES["torus"], rays)
    taken.put(chosen, whole[chosen])
    for name in ("kind", "distance", "begins", "stopped", "slope"):
        torch.testing.assert_close(getattr(taken, name)[chosen], getattr(whole, name)[chosen], equal_nan=True)


@given(st.integers(1, 50), st.sampled_from(sorted(SHAPES)))
def test_what_is_foretold_does_not_depend_on_the_rays_beside(count: int, name: str) -> None:
    rays = random_rays(12, 50)
    together, apart = ahead(LATTICES[name], rays), ahead(LATTICES[name], rays[torch.arange(count)])
    assert (together.kind[:count] == apart.kind).all()
    torch.testing.assert_close(together.distance[:count], apart.distance, rtol=0, atol=1e-12)
