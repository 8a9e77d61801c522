"""The march: against the slow oracle, against closed forms, and in the places where marches go wrong."""

from dataclasses import replace

import pytest
import reference
import torch
from hypothesis import given
from hypothesis import strategies as st

from distrace.camera import Camera
from distrace.fields import primitives
from distrace.rays import Rays, meet_sphere
from distrace.render import render
from distrace.tracing import coarse_to_fine as pyramid
from distrace.tracing.sphere_tracing import (
    AGGRESSIVE,
    COARSE_TO_FINE,
    DYNAMIC,
    MARCHES,
    Outcome,
    Trace,
    TraceConfig,
    sphere_trace,
)

f64 = torch.float64
CENTRE, RADIUS, EXTENTS = (0.1, 0.25, -0.05), 0.4, (0.55, 0.15, 0.3)
scene = primitives.union(
    primitives.sphere(RADIUS, torch.tensor(CENTRE, dtype=f64)), primitives.box(torch.tensor(EXTENTS, dtype=f64))
)
slow_scene = reference.union(reference.sphere(CENTRE, RADIUS), reference.box(EXTENTS))
EXACT = replace(DYNAMIC, steps=1000, tolerance=1e-9)  # a scale above 1 may step across an edge that it grazes
every_strategy = pytest.mark.parametrize("config", MARCHES.values(), ids=MARCHES)


def view(size: int = 24, dtype: torch.dtype = f64, **changes) -> Camera:
    return Camera.orbit(
        **{"azimuth": 30, "elevation": 20, "distance": 4.97, **changes}, height=size, width=size, dtype=dtype
    )


def trace(sdf, rays: Rays, config: TraceConfig = AGGRESSIVE, start: torch.Tensor | None = None) -> Trace:
    return sphere_trace(sdf, rays, meet_sphere(rays), config, start)


def ray(origin: list[float], direction: list[float]) -> Rays:
    direction_ = torch.tensor([direction], dtype=f64)
    return Rays(torch.tensor([origin], dtype=f64), direction_ / direction_.norm())


class Watched:
    """A field that remembers where it was evaluated."""

    def __init__(self, sdf) -> None:
        self.sdf, self.evaluated = sdf, []

    def __call__(self, points: torch.Tensor) -> torch.Tensor:
        self.evaluated.append(points)
        return self.sdf(points)

    @property
    def count(self) -> int:
        return sum(len(points) for points in self.evaluated)


@every_strategy
@pytest.mark.parametrize(("steps", "slope"), [(4, 1.0), (50, 1.0), (50, 3.0)])
def test_every_ray_ends_as_it_does_alone_in_plain_python(config: TraceConfig, steps: int, slope: float) -> None:
    camera, config = view(), replace(config, steps=steps)
    rays, field = camera.rays(), lambda points: slope * scene(points)
    start = pyramid.starts(field, camera, 1.0, config)[0] if config.coarse_levels else None
    traced = trace(field, rays, config, start)
    rule = dict(
        steps=steps, step_scale=config.step_scale, step_limit=config.step_limit, tolerance=float(config.tolerance)
    )
    begins = [None] * (24 * 24) if start is None else start.flatten().tolist()
    flat = rays.flat()
    alone = [
        reference.march(reference.steeper(slow_scene, slope), tuple(origin), tuple(direction), **rule, start=begin)
        for origin, direction, begin in zip(flat.origins.tolist(), flat.directions.tolist(), begins)
    ]
    assert [Outcome(k).name for k in traced.outcome.flatten().tolist()] == [end.outcome for end in alone]
    distance = torch.tensor([end.distance for end in alone], dtype=f64)
    torch.testing.assert_close(traced.distance.flatten(), distance, rtol=0, atol=1e-8)
    counts = torch.tensor([end.evaluations for end in alone])
    if not config.compaction:  # every ray that meets the sphere is queried until the slowest has ended
        counts = torch.where(counts > 0, counts.max(), 0)
    assert traced.evaluations.flatten().tolist() == counts.tolist()
    assert {"HIT", "ESCAPED"} <= {end.outcome for end in alone} if steps == 50 else traced.hit.sum() < 100


def test_coarse_to_fine_sees_what_the_plain_march_sees() -> None:
    """Up to a few rays at edges, past which their coarse ray has stepped; but never the coarse ray's own distance."""
    camera, fine = view(64), replace(COARSE_TO_FINE, tolerance=1e-9, steps=400)
    plain, coarse = render(scene, camera, config=EXACT), render(scene, camera, config=fine)
    assert (plain.mask != coarse.mask).sum() <= 0.02 * plain.mask.sum()
    both = plain.mask & coarse.mask
    torch.testing.assert_close(coarse.trace.distance[both], plain.trace.distance[both], rtol=0, atol=1e-6)
    sphere = primitives.sphere(0.5)
    assert (render(sphere, camera, config=EXACT).mask == render(sphere, camera, config=fine).mask).all()


@every_strategy
def test_a_hit_lies_on_its_ray_where_the_field_was_asked(config: TraceConfig) -> None:
    camera = view(32)
    watched = Watched(scene)
    traced = render(watched, camera, config=config).trace
    rays = camera.rays()[traced.hit]
    ends = rays.at(traced.distance[traced.hit])
    assert scene(ends).abs().max() < 5e-5
    samples = torch.cat(watched.evaluated)
    samples = samples[scene(samples).abs() < 5e-5]  # samples at which a ray may end
    from_ray = torch.linalg.cross(
        samples[None] - rays.origins[:, None], rays.directions[:, None].expand(-1, len(samples), 3)
    ).norm(dim=-1)
    on_ray = from_ray < 1e-9
    nearest = torch.where(on_ray, torch.cdist(ends, samples), torch.inf).amin(dim=1)
    assert nearest.max() < 20 * 5e-5


@given(azimuth=st.floats(0, 360), elevation=st.floats(-80, 80), radius=st.floats(0.1, 0.9))
def test_a_sphere_is_met_at_its_closed_form(azimuth: float, elevation: float, radius: float) -> None:
    rays = view(azimuth=azimuth, elevation=elevation).rays()
    true = meet_sphere(rays, radius)
    traced = trace(primitives.sphere(radius), rays, EXACT)
    assert (traced.hit == true.meets).all()
    torch.testing.assert_close(traced.distance[traced.hit], true.near[true.meets], rtol=0, atol=1e-6)


@given(azimuth=st.floats(0, 360), elevation=st.floats(-80, 80), offset=st.floats(-0.5, 0.5))
def test_a_plane_is_met_at_its_closed_form(azimuth: float, elevation: float, offset: float) -> None:
    camera = view(azimuth=azimuth, elevation=elevation)
    rays, normal = camera.rays(), -camera.T_world_camera[:3, 2] + 0.5
    normal = normal / normal.norm()
    bounds = meet_sphere(rays)
    distance = (offset - rays.origins @ normal) / (rays.directions @ normal)
    inside = (distance > bounds.near + 1e-6) & (distance < bounds.far - 1e-6)
    traced = trace(primitives.plane(normal, offset), rays, EXACT)
    assert traced.hit[inside].all()
    torch.testing.assert_close(traced.distance[inside], distance[inside], rtol=0, atol=1e-6)


@given(azimuth=st.floats(0, 360), elevation=st.floats(-80, 80))
def test_a_box_is_met_at_its_closed_form(azimuth: float, elevation: float) -> None:
    rays = view(azimuth=azimuth, elevation=elevation).rays()
    extents = torch.tensor(EXTENTS, dtype=f64)
    sides = torch.stack([(side - rays.origins) / rays.directions for side in (-extents, extents)])
    enters, leaves = sides.amin(0).amax(-1), sides.amax(0).amin(-1)
    traced = trace(primitives.box(extents), rays, EXACT)
    assert (traced.hit == (enters < leaves)).all()
    torch.testing.assert_close(traced.distance[traced.hit], enters[traced.hit], rtol=0, atol=1e-6)


@given(st.permutations(range(256)), st.integers(1, 256), st.sampled_from(sorted(MARCHES)))
def test_a_rays_result_does_not_depend_on_the_rays_beside_it(order: list[int], count: int, strategy: str) -> None:
    config = MARCHES[strategy]
    rays, chosen = view(16).rays().flat(), torch.tensor(order[:count])
    together, apart = trace(scene, rays, config), trace(scene, rays[chosen], config)
    assert (together.outcome[chosen] == apart.outcome).all()
    for name in ("distance", "closest", "stopped"):
        torch.testing.assert_close(getattr(together, name)[chosen], getattr(apart, name), rtol=0, atol=1e-12)
    if config.compaction:
        assert (together.evaluations[chosen] == apart.evaluations).all()


def test_each_strategy_of_the_table_asks_less_than_the_one_before() -> None:
    camera = view(64, torch.float32)
    counts = []
    for config in MARCHES.values():
        watched = Watched(primitives.sphere(0.5))
        traced = render(watched, camera, config=config).trace
        assert traced.total_evaluations == watched.count  # every evaluation is counted
        counts.append(watched.count)
    assert list(MARCHES) == ["parallel", "dynamic", "aggressive", "coarse_to_fine"]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 50 * meet_sphere(camera.rays()).meets.sum()
    assert counts[1] < counts[0] / 2


@every_strategy
def test_a_view_that_meets_nothing_asks_nothing(config: TraceConfig) -> None:
    away = Camera.look_at(torch.tensor([0.0, 0, 5]), torch.tensor([0.0, 0, 9]), height=8, width=8)
    watched = Watched(primitives.sphere(0.5))
    traced = render(watched, away, config=config).trace
    assert (traced.outcome == Outcome.ESCAPED).all()
    assert (traced.distance == torch.inf).all()
    assert watched.count == traced.total_evaluations == 0


@every_strategy
def test_a_camera_in_the_solid_is_told_so(config: TraceConfig) -> None:
    camera = Camera.look_at(torch.tensor([0.1, 0, 0]), torch.tensor([0.5, 0, 0]), height=8, width=8)
    traced = render(primitives.sphere(0.5), camera, config=config).trace
    assert (traced.outcome == Outcome.INSIDE).all()
    assert (traced.distance == torch.inf).all()
    if config.compaction:
        assert (traced.evaluations == 1).all()


@every_strategy
def test_a_camera_in_the_bounds_but_not_in_the_solid_sees_it(config: TraceConfig) -> None:
    camera = Camera.orbit(0, 0, 0.8, height=8, width=8, focal_px=40, dtype=f64)
    traced = render(primitives.sphere(0.3), camera, config=config).trace
    assert traced.hit.all()
    torch.testing.assert_close(traced.distance, meet_sphere(camera.rays(), 0.3).near, rtol=0, atol=1e-4)


def test_a_camera_on_the_surface_hits_it_at_once_and_never_behind_itself() -> None:
    for depth_of_eye in (1e-5, -1e-5):
        traced = trace(primitives.sphere(0.5), ray([0, 0, 0.5 + depth_of_eye], [0, 0.1, -1]))
        assert traced.hit.all()
        assert 0 <= traced.distance.item() <= 5e-5
        assert traced.evaluations.item() == 1


def test_a_tangent_ray_ends_by_the_surface_or_without_a_hit() -> None:
    """Along it f = √(r² + s²) − r, which stays below ε for √(2 r ε) around the point of touch."""
    for config in MARCHES.values():
        traced = trace(primitives.sphere(0.5), ray([0, 0.5, 3], [0, 0, -1]), config)
        assert traced.outcome.item() in (Outcome.HIT, Outcome.EXHAUSTED)
        if traced.hit.item():
            assert abs(traced.distance.item() - 3) < (2 * 0.5 * 5e-5) ** 0.5 + 20 * 5e-5
        assert traced.closest.item() == pytest.approx(3, abs=0.1)


def test_running_out_of_steps_is_not_a_hit() -> None:
    rays = ray([0, 0, 3], [0, 0, -1])
    short = trace(primitives.sphere(0.5), rays, replace(DYNAMIC, steps=4))
    assert (short.outcome.item(), short.evaluations.item(), short.distance.item()) == (Outcome.EXHAUSTED, 4, torch.inf)
    assert short.stopped.item() == pytest.approx(2.4)
    assert trace(primitives.sphere(0.5), rays, replace(DYNAMIC, steps=7)).hit.all()


def test_a_ray_goes_on_from_where_it_is_started() -> None:
    rays = ray([0, 0, 3], [0, 0, -1])
    traced = trace(primitives.sphere(0.5), rays, start=torch.tensor([2.49], dtype=f64))
    assert traced.hit.all()
    assert traced.evaluations.item() < trace(primitives.sphere(0.5), rays).evaluations.item()
    overshot = trace(primitives.sphere(0.5), rays, start=torch.tensor([2.7], dtype=f64))
    assert overshot.distance.item() == pytest.approx(2.5, abs=1e-5)


@pytest.mark.parametrize("off", [4e-5, -4e-5])
def test_a_ray_that_starts_within_the_tolerance_is_moved_on_by_the_value(off: float) -> None:
    """It has no secant; on a ray that looks straight at the surface the value is what is left."""
    traced = trace(primitives.sphere(0.5), ray([0, 0, 3], [0, 0, -1]), start=torch.tensor([2.5 + off], dtype=f64))
    assert traced.evaluations.item() == 1
    assert traced.distance.item() == pytest.approx(2.5, abs=1e-12)


def test_a_ray_is_not_followed_back_out_of_its_bounds() -> None:
    """The surface lies 0.05 before the bounds; a step back from 0.05 behind them would meet it."""
    watched = Watched(primitives.plane(torch.tensor([0, 0, 1], dtype=f64), 1.05))
    traced = trace(watched, ray([0, 0, 3], [0, 0, -1]), start=torch.tensor([2.05], dtype=f64))
    assert traced.outcome.item() == Outcome.INSIDE
    assert torch.cat(watched.evaluated)[:, 2].tolist() == pytest.approx([0.95, 1.0])


def test_closest_is_the_sample_of_least_value() -> None:
    rays, watched = ray([0, 0.7, 3], [0, 0, -1]), Watched(primitives.sphere(0.5))
    traced = trace(watched, rays)
    samples = torch.cat(watched.evaluated)
    least = samples[watched.sdf(samples).abs().argmin()]
    torch.testing.assert_close(rays.at(traced.closest)[0], least)
    across = trace(primitives.sphere(0.45), ray([0, 0, 3], [0, 0, -1]), replace(AGGRESSIVE, step_scale=2.5, steps=4))
    assert across.outcome.item() == Outcome.EXHAUSTED  # at −0.075, after +0.05
    assert across.closest.item() == pytest.approx(2.5)


def test_a_tolerance_per_ray_is_kept_per_ray() -> None:
    camera = view(8, focal_px=40)
    tolerance = torch.full((8, 8), 1e-7, dtype=f64)
    tolerance[:, 4:] = 1e-2
    traced = trace(primitives.sphere(0.5), camera.rays(), replace(DYNAMIC, tolerance=tolerance, steps=200))
    hits = traced.evaluations.masked_fill(~traced.hit, 0)
    assert hits[:, :4].sum() > 1.3 * hits[:, 4:].sum() > 0
    rough = trace(primitives.sphere(0.5), camera.rays(), replace(DYNAMIC, tolerance=1e-2, steps=200))
    torch.testing.assert_close(traced.distance[:, 4:], rough.distance[:, 4:])


@every_strategy
@pytest.mark.parametrize("number_at_nan", [False, True], ids=["", "and a number where it is evaluated at NaN"])
def test_a_ray_whose_field_gives_nan_ends_there_and_is_no_hit(config: TraceConfig, number_at_nan: bool) -> None:
    def broken(points: torch.Tensor) -> torch.Tensor:
        value = points.norm(dim=-1) - 0.5
        value = value.nan_to_num(0.0) if number_at_nan else value
        return value.masked_fill((points[..., 0] > 0) & (value < 0.2), torch.nan)

    watched, rays = Watched(broken), view().rays()
    traced, whole = trace(watched, rays, config), trace(primitives.sphere(0.5), rays, config)
    spoilt = traced.outcome != whole.outcome
    assert spoilt.sum() > 30
    assert (traced.outcome[spoilt] == Outcome.EXHAUSTED).all()
    assert (traced.distance[spoilt] == torch.inf).all()
    torch.testing.assert_close(traced.distance[~spoilt], whole.distance[~spoilt])
    for state in (traced.closest, traced.stopped):
        assert not state.isnan().any()
    assert torch.cat(watched.evaluated).isfinite().all()
    if config.compaction:
        assert (traced.evaluations[spoilt] < whole.evaluations[spoilt]).all()


@every_strategy
def test_a_field_of_nothing_but_nan_ends_after_one_query_of_each_ray(config: TraceConfig) -> None:
    camera = view()
    watched = Watched(lambda points: torch.full_like(points[..., 0], torch.nan))
    traced = render(watched, camera, config=config).trace
    meets = meet_sphere(camera.rays()).meets
    assert (traced.outcome == torch.where(meets, int(Outcome.EXHAUSTED), int(Outcome.ESCAPED))).all()
    assert (traced.evaluations == meets).all()


def test_by_default_a_sphere_is_right_to_a_hundredth_of_the_tolerance() -> None:
    """In float32, and at worst to twice it: where a coarse start lies within ε of the surface there is no secant."""
    camera = view(128, torch.float32)
    traced = render(primitives.sphere(0.5), camera).trace
    true = meet_sphere(view(128).rays(), 0.5)
    error = (traced.distance.double() - true.near)[traced.hit & true.meets].abs()
    assert error.mean() < 1e-6
    assert error.max() < 1e-4
    assert (traced.hit != true.meets).sum() <= 0.01 * true.meets.sum()


@pytest.mark.parametrize("slope", [2.5, 4.0, 10.0])
def test_a_field_too_steep_for_its_steps_is_hit_all_the_same(slope: float) -> None:
    """Where step_scale · |f'| > 2 each step lands farther from the surface than the last, but for the bracket."""
    rays = view().rays()
    traced = trace(lambda points: slope * (points.norm(dim=-1) - 0.5), rays, replace(AGGRESSIVE, steps=100))
    facing = meet_sphere(rays, 0.4).meets
    assert traced.hit[facing].all()
    error = (traced.distance - meet_sphere(rays, 0.5).near)[facing].abs()
    assert error.max() < 1e-5


def test_without_polish_a_hit_is_a_sample() -> None:
    rays, watched = ray([0.2, 0.1, 3], [0, 0, -1]), Watched(primitives.sphere(0.5))
    traced = trace(watched, rays, replace(AGGRESSIVE, polish=False))
    assert (watched.evaluated[-1] == rays.at(traced.distance)).all()
    true = meet_sphere(rays, 0.5).near
    assert 0 < (traced.distance - true).abs() < 1e-4
    assert (trace(watched, rays).distance - true).abs() < 1e-7


def nearly_touching(clearance: float) -> tuple[primitives.SDF, Rays]:
    """A ray that passes a small ball on its way to a wall at a distance of 3."""
    ball = primitives.sphere(0.1, torch.tensor([0, 0.1 + clearance, 0.5], dtype=f64))
    wall = primitives.plane(torch.tensor([0, 0, 1], dtype=f64))
    return primitives.union(ball, wall), ray([0, 0, 3], [0, 0, -1])


def test_with_a_least_step_a_ray_that_nearly_touches_goes_on_to_what_is_behind() -> None:
    """Where f falls to 1e-5 its steps would be as short, and run out."""
    sdf, rays = nearly_touching(1e-5)
    cautious = replace(AGGRESSIVE, steps=100, tolerance=2e-6)
    assert trace(sdf, rays, cautious).outcome.item() == Outcome.EXHAUSTED
    passing = trace(sdf, rays, replace(cautious, least_step=6e-4))
    assert passing.outcome.item() == Outcome.HIT
    assert passing.distance.item() == pytest.approx(3, abs=1e-6)


def test_a_least_step_is_kept_outside_and_not_in_the_solid() -> None:
    watched = Watched(primitives.plane(torch.tensor([0, 0, 1], dtype=f64)))
    config = replace(DYNAMIC, tolerance=1e-9, least_step=1e-3)
    trace(watched, ray([0, 0, 3], [0, 0, -1]), config, torch.tensor([2.9994], dtype=f64))
    assert (3 - torch.cat(watched.evaluated)[:, 2]).tolist() == pytest.approx([2.9994, 3.0004, 3.0], abs=1e-9)


def test_a_trace_is_indexed_as_its_images_are() -> None:
    whole = replace(trace(scene, view().rays()), setup_evaluations=7)
    for index in ((slice(3, 9), slice(None, None, 2)), whole.hit, (5, 7), (..., slice(4, 6))):
        part = whole[index]
        assert part.setup_evaluations == 7
        for name, image in whole.images().items():
            torch.testing.assert_close(getattr(part, name), image[index], equal_nan=True)
    assert set(whole.images()) == {"distance", "outcome", "closest", "stopped", "evaluations"}
    assert whole[(slice(4), slice(6))].reshaped(torch.Size([24])).distance.shape == (24,)


def test_a_trace_carries_no_gradient() -> None:
    radius = torch.tensor(0.5, requires_grad=True)
    camera = Camera.orbit(30, 20, 4.97, height=8, width=8)
    rays = Rays(camera.rays().origins.clone().requires_grad_(), camera.rays().directions)
    traced = trace(primitives.sphere(radius), rays)
    assert traced.hit.any()
    assert not traced.distance.requires_grad
    assert not traced.closest.requires_grad


@pytest.mark.parametrize("wrong", [dict(steps=0), dict(step_scale=0.0), dict(step_limit=-0.1), dict(coarse_levels=-1)])
def test_a_configuration_that_cannot_march_is_refused(wrong: dict) -> None:
    name, value = next(iter(wrong.items()))
    with pytest.raises(ValueError, match=f"{name}={value}.*cannot march"):
        TraceConfig(**wrong)
