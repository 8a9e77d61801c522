"""The fast tracer: what closed forms and the cautious reference show, at a look or two for each pixel."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from distrace import primitives
from distrace.camera import Camera
from distrace.decoder import Decoder, NetworkSpecs, ShapeField
from distrace.evaluation.bench import reference_distance
from distrace.fast import tracer as fast
from distrace.fast.lattice import Lattice, LatticeConfig
from distrace.fast.picture import FastConfig
from distrace.fast.tracer import fast_trace
from distrace.field import SDF, Counted
from distrace.rays import meet_sphere
from distrace.render import render
from distrace.trace import Outcome, Trace

f64 = torch.float64
TOLERANCE = FastConfig().tolerance
BALL = primitives.sphere(0.7)
BOX = primitives.box(torch.tensor([0.5, 0.3, 0.4], dtype=f64))
UNION = primitives.union(
    primitives.sphere(0.35, torch.tensor([0.3, 0.2, 0.1], dtype=f64)),
    primitives.box(torch.tensor([0.6, 0.15, 0.3], dtype=f64)),
    primitives.torus(0.7, 0.08),
)
START, END = torch.tensor([[-0.5, -0.4, 0.3], [0.5, 0.4, -0.3]], dtype=f64)
SHAPES = {
    "box": BOX,
    "torus": primitives.torus(0.6, 0.2),
    "union": UNION,
    "plate": primitives.box(torch.tensor([0.5, 0.004, 0.4], dtype=f64)),
    "rod": primitives.capsule(START, END, 0.03),
}

CONFIGS = {"strides": FastConfig(strides=(2, 1)), "lattice": FastConfig(lattice=LatticeConfig(4, 2))}


def view(size: int = 40, azimuth: float = 30, elevation: float = 20, distance: float = 4.97, **changes) -> Camera:
    return Camera.orbit(azimuth, elevation, distance, **{"height": size, "width": size, "dtype": f64, **changes})


def batch_of(cameras: list[Camera]) -> Camera:
    intrinsics, poses = (torch.stack([getattr(c, name) for c in cameras]) for name in ("intrinsics", "T_world_camera"))
    return Camera.from_matrices(intrinsics, poses, cameras[0].height, cameras[0].width)


def traced(sdf: SDF, camera: Camera, **options) -> Trace:
    return fast_trace(sdf, camera, **options)[0]


def reference(sdf: SDF, camera: Camera) -> Tensor:
    rays = camera.rays()
    return reference_distance(sdf, rays, meet_sphere(rays))


def assert_same_image(first: Trace, second: Trace, tolerance: float, other_pixels: int = 0) -> None:
    """Up to some pixels by an outline."""
    assert second.hit.any()
    assert (first.hit != second.hit).sum() <= other_pixels
    both = first.hit & second.hit
    torch.testing.assert_close(first.distance[both], second.distance[both], rtol=0, atol=tolerance)


def perceptron(radius: float = 0.5) -> Decoder:
    """A random decoder that is roughly the distance to a ball (Atzmon and Lipman, CVPR 2020), a third of it off."""
    torch.manual_seed(1)
    decoder = Decoder(NetworkSpecs(dims=(64,) * 4, code_length=4, latent_in=(2,), norm_layers=())).to(f64).eval()
    with torch.no_grad():
        for layer in range(decoder.depth - 1):
            linear = getattr(decoder, f"lin{layer}")
            linear.weight.normal_(std=(3 / linear.out_features) ** 0.5)
            linear.bias.zero_()
            linear.bias[::3] = -9.0
        last = getattr(decoder, f"lin{decoder.depth - 1}")
        last.weight.fill_((1.5 * math.pi / last.in_features) ** 0.5)
        last.bias.fill_(-radius)
    return decoder


@pytest.fixture(scope="module")
def first() -> tuple[Trace, Lattice]:
    """The union and its lattice."""
    return fast_trace(UNION, view())


@pytest.fixture(scope="module")
def decoded() -> tuple[ShapeField, Trace, Lattice]:
    field = perceptron().field(torch.zeros(4, dtype=f64))
    return field, *fast_trace(field, view())


STEEP: dict[str, SDF] = {
    "× 3": lambda points: 3 * SHAPES["plate"](points),
    "× 100": lambda points: 100 * SHAPES["torus"](points),
    "saturated": lambda points: torch.tanh(6 * primitives.box(torch.tensor([0.5, 0.02, 0.4], dtype=f64))(points)),
    "stretched": lambda points: primitives.torus(0.5, 0.12)(points * torch.tensor([1, 4, 1], dtype=f64)),
}


@pytest.mark.parametrize("name", STEEP)
def test_what_is_thin_in_a_steep_field_is_seen(name: str) -> None:
    camera = view(48)
    buffers, rays = render(STEEP[name], camera), camera.rays()
    samples = torch.linspace(0, 1, 4000, dtype=f64)[:, None, None]
    inside = meet_sphere(rays)
    along = torch.where(inside.meets, inside.near + samples * (inside.far - inside.near), 0.0)
    true = (torch.stack([STEEP[name](rays.at(t)) for t in along]).amin(0) < 0) & inside.meets
    assert true.sum() > 80
    assert (buffers.mask != true).sum() <= 2, "pixels at the outline"


def test_a_field_that_is_infinite_far_away_is_seen_where_it_is_not() -> None:
    infinite = lambda points: torch.where(points.norm(dim=-1) > 0.9, torch.inf, BALL(points))  # noqa: E731
    assert (render(infinite, view(32)).mask == render(BALL, view(32)).mask).all()
    assert not render(lambda points: torch.full_like(points[..., 0], torch.inf), view(32)).mask.any()


def test_the_clearance_of_a_ray_past_two_balls_is_that_of_the_nearer() -> None:
    balls = [primitives.sphere(0.12, torch.tensor([-0.7, 0, 0])), primitives.sphere(0.2, torch.tensor([0.6, 0.3, 0.2]))]
    camera = Camera.orbit(30, 20, 3.0, focal_px=45.0, height=40, width=40)
    both = render(primitives.union(*balls), camera)
    least = torch.stack([render(ball, camera).clearance for ball in balls]).amin(0)
    missed = both.clearance.isfinite() & ~both.mask
    assert (both.clearance - least)[missed].abs().max() < 1e-4


@pytest.mark.parametrize(("radius", "size"), [(0.2, 96), (0.7, 64), (0.95, 48)])
def test_a_ball_is_seen_at_its_closed_form(radius: float, size: int) -> None:
    camera = view(size)
    true, trace = meet_sphere(camera.rays(), radius), traced(primitives.sphere(radius), camera)
    assert (trace.hit == true.meets).all()
    error = (trace.distance - true.near)[trace.hit].abs()
    assert error.max() < TOLERANCE
    assert error.mean() < 2e-6
    assert (trace.outcome == torch.where(true.meets, int(Outcome.HIT), int(Outcome.ESCAPED))).all()


@pytest.mark.parametrize("name", SHAPES)
def test_a_shape_is_seen_as_the_reference_sees_it(name: str) -> None:
    """One in a hundred pixels, by the outline of an edge, may be missed, 2 may be hit, and 2 show what is behind."""
    camera = view(64, 75, 40)
    true, trace = reference(SHAPES[name], camera), traced(SHAPES[name], camera)
    visible = torch.isfinite(true)
    assert (trace.hit & ~visible).sum() <= 2
    assert (visible & ~trace.hit).sum() <= 0.01 * visible.sum() + 1
    error = (trace.distance - true)[trace.hit & visible].abs().sort().values
    assert (error > 2 * TOLERANCE).sum() <= 2
    assert error[:-2].mean() < 2e-5


def test_in_float32_it_sees_the_same() -> None:
    camera = view(dtype=torch.float32)
    trace, true = traced(BALL, camera), meet_sphere(view().rays(), 0.7)
    assert trace.distance.dtype == torch.float32
    assert (trace.hit != true.meets).sum() <= 2
    both = trace.hit & true.meets
    assert (trace.distance.double() - true.near)[both].abs().max() < TOLERANCE


def test_the_field_is_asked_as_often_as_is_counted() -> None:
    counted = Counted(SHAPES["torus"])
    trace = traced(counted, view())
    assert counted.evaluations == trace.total_evaluations
    assert 0 < trace.setup_evaluations < counted.evaluations


def test_a_ball_takes_two_looks_for_each_visible_pixel() -> None:
    trace = traced(BALL, view(256))
    assert trace.evaluations.sum() < 2.2 * trace.hit.sum()


def test_a_tighter_tolerance_is_kept() -> None:
    camera = view(9)
    trace = traced(BALL, camera, config=FastConfig(tolerance=1e-7))
    torch.testing.assert_close(trace.distance, meet_sphere(camera.rays(), 0.7).near, rtol=0, atol=1e-7)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_strides_and_lattices_change_the_cost_and_not_the_image(config: FastConfig) -> None:
    camera = view(25)
    trace = traced(BALL, camera, config=config)
    torch.testing.assert_close(trace.distance, meet_sphere(camera.rays(), 0.7).near, rtol=0, atol=TOLERANCE)


def test_cameras_in_a_batch_see_what_each_sees_alone() -> None:
    cameras = [view(20, azimuth) for azimuth in (0, 50)]
    together = traced(UNION, batch_of(cameras))
    assert together.distance.shape == (2, 20, 20)
    for k, camera in enumerate(cameras):
        alone = traced(UNION, camera)
        assert_same_image(together[k,], alone, 1e-9)
        assert (together.evaluations[k] == alone.evaluations).all()


def test_tiles_show_what_the_whole_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    """A pixel by a tile's border has other neighbours: another way there, and the same place."""
    cameras = batch_of([view(azimuth=azimuth, height=40, width=30) for azimuth in (0, 50)])
    whole = traced(BOX, cameras)
    monkeypatch.setattr(fast, "TILE", 24)
    counted = Counted(BOX)
    tiles = traced(counted, cameras)
    assert counted.evaluations == tiles.total_evaluations
    assert tiles.setup_evaluations == whole.setup_evaluations
    assert {image.shape for image in tiles.images().values()} == {torch.Size([2, 40, 30])}
    assert_same_image(tiles, whole, 2 * TOLERANCE, other_pixels=4)
    assert (tiles.distance.isfinite() == tiles.hit).all()
    again = traced(BOX, cameras, last=tiles)
    assert_same_image(again, tiles, 2 * TOLERANCE, other_pixels=4)
    assert again.evaluations.sum() < 0.9 * tiles.evaluations.sum()


def test_a_lattice_from_the_view_before_saves_its_setup_and_changes_nothing(first: tuple[Trace, Lattice]) -> None:
    trace, lattice = first
    counted = Counted(UNION)
    again, same = fast_trace(counted, view(), lattice=lattice)
    assert again.setup_evaluations == 0
    assert trace.total_evaluations - again.total_evaluations == trace.setup_evaluations == lattice.evaluations
    assert counted.evaluations == again.total_evaluations
    assert same is lattice
    torch.testing.assert_close(again.distance, trace.distance, rtol=0, atol=0)


def test_buffers_hand_the_lattice_to_the_next_view() -> None:
    before = render(BALL, view(16))
    after = render(BALL, view(16), lattice=before.lattice)
    assert before.trace.setup_evaluations > after.trace.setup_evaluations == 0
    torch.testing.assert_close(after.depth, before.depth, rtol=0, atol=0)


@pytest.mark.parametrize(("azimuth", "share"), [(30, 0.8), (33, 0.9)])
def test_with_the_last_trace_a_view_nearby_costs_less_and_shows_the_same(
    azimuth: float, share: float, first: tuple[Trace, Lattice]
) -> None:
    last, lattice = first
    camera = view(azimuth=azimuth)
    alone, after = traced(UNION, camera, lattice=lattice), traced(UNION, camera, lattice=lattice, last=last)
    assert after.evaluations.sum() < share * alone.evaluations.sum()
    assert_same_image(after, alone, 2 * TOLERANCE, other_pixels=2)


def test_a_last_trace_of_another_size_changes_nothing(first: tuple[Trace, Lattice]) -> None:
    last, lattice = first
    alone, after = (traced(UNION, view(20), lattice=lattice, last=before) for before in (None, last))
    torch.testing.assert_close(after.distance, alone.distance, rtol=0, atol=0)


def test_a_last_trace_of_a_view_from_the_side_does_no_harm(first: tuple[Trace, Lattice]) -> None:
    last, lattice = first
    camera = view(azimuth=120)
    after, true = traced(UNION, camera, lattice=lattice, last=last), reference(UNION, camera)
    assert (after.hit != torch.isfinite(true)).sum() <= 0.02 * after.hit.sum()
    error = (after.distance - true)[after.hit & torch.isfinite(true)].abs()
    assert (error > 2 * TOLERANCE).sum() <= 2


def test_a_scene_of_another_radius_is_the_same_scaled(first: tuple[Trace, Lattice]) -> None:
    def large(points: Tensor) -> Tensor:
        return 2 * UNION(points / 2)

    unit, scaled = first[0], traced(large, view(distance=9.94), radius=2.0)
    assert scaled.total_evaluations == unit.total_evaluations
    for name in ("distance", "closest"):
        torch.testing.assert_close(getattr(scaled, name), 2 * getattr(unit, name), rtol=0, atol=1e-9)
    torch.testing.assert_close(scaled.slope, unit.slope, rtol=0, atol=1e-9, equal_nan=True)


def test_a_last_trace_is_of_use_in_a_scene_of_another_radius() -> None:
    def large(points: Tensor) -> Tensor:
        return 2 * BOX(points / 2)

    camera = view(distance=9.94)
    alone, lattice = fast_trace(large, camera, 2.0)
    again = traced(large, camera, radius=2.0, lattice=lattice, last=alone)
    assert again.evaluations.sum() < 0.75 * alone.evaluations.sum()
    assert_same_image(again, alone, 4 * TOLERANCE)


def test_a_lattice_of_another_radius_is_refused(first: tuple[Trace, Lattice]) -> None:
    with pytest.raises(ValueError, match=r"radius of 1\.0 .* radius of 2\.0"):
        fast_trace(UNION, view(), 2.0, lattice=first[1])


def test_a_field_too_steep_shows_what_the_distance_shows() -> None:
    counted = Counted(lambda points: 2.5 * BALL(points))
    camera = view()
    trace, lattice = fast_trace(counted, camera)
    assert lattice.steepness == pytest.approx(2.5, rel=0.1)
    assert counted.evaluations == trace.total_evaluations
    torch.testing.assert_close(trace.distance, meet_sphere(camera.rays(), 0.7).near, rtol=0, atol=TOLERANCE)
    again = traced(counted, camera, lattice=lattice)
    torch.testing.assert_close(again.distance, trace.distance, rtol=0, atol=0)


@pytest.mark.parametrize("factor", [0.5, 2.5])
def test_the_slope_told_is_the_fields_along_the_ray(factor: float) -> None:
    camera = view()
    trace = traced(lambda points: factor * BALL(points), camera)
    known = trace.hit & ~trace.slope.isnan()
    assert known.sum() > 0.9 * trace.hit.sum()
    assert trace.slope[~trace.hit].isnan().all()
    rays = camera.rays()[known]
    true = factor * (rays.at(trace.distance[known]) * rays.directions).sum(-1) / 0.7
    assert ((trace.slope[known] - true) / true).abs().max() < 0.2


@pytest.mark.parametrize(("azimuth", "distance"), [(30, 0.9), (100, 0.75)])
def test_a_camera_in_the_bounds_but_not_in_the_solid_sees_it(azimuth: float, distance: float) -> None:
    camera = view(20, azimuth, distance=distance)
    assert UNION(camera.T_world_camera[:3, 3]) > 0.1
    true, trace = reference(UNION, camera), traced(UNION, camera)
    assert (trace.hit == torch.isfinite(true)).all()
    assert (trace.distance - true)[trace.hit].abs().max() < 2 * TOLERANCE


@pytest.mark.parametrize("radius", [0.5, 0.9, 2.0])
def test_a_camera_in_the_solid_is_told_so(radius: float) -> None:
    camera = Camera.look_at(torch.tensor([0.1, 0, 0]), torch.tensor([0.5, 0, 0]), height=16, width=16)
    trace = traced(primitives.sphere(radius), camera)
    assert (trace.outcome == Outcome.INSIDE).all()
    assert (trace.distance == torch.inf).all()
    assert (trace.evaluations == 1).all()


def test_a_camera_that_looks_away_asks_nothing_for_its_rays() -> None:
    away = Camera.look_at(torch.tensor([0, 0, 5.0]), torch.tensor([0, 0, 9.0]), height=8, width=8)
    trace = traced(BALL, away)
    assert (trace.outcome == Outcome.ESCAPED).all()
    assert (trace.distance == torch.inf).all()
    assert (trace.closest == torch.inf).all()
    assert trace.evaluations.sum() == 0


def test_a_field_without_a_surface_asks_nothing_for_its_rays() -> None:
    trace, lattice = fast_trace(primitives.sphere(0.5, torch.tensor([0, 9.0, 0], dtype=f64)), view())
    assert lattice.box() is None
    assert (trace.outcome == Outcome.ESCAPED).all()
    assert trace.evaluations.sum() == 0


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 5), (1, 9), (7, 2)])
def test_images_of_few_pixels_are_images(height: int, width: int) -> None:
    camera = view(height=height, width=width, focal_px=1.5 * max(height, width))
    true, trace = meet_sphere(camera.rays(), 0.7), traced(BALL, camera)
    assert true.meets.any()
    torch.testing.assert_close(trace.distance, true.near, rtol=0, atol=TOLERANCE)


def test_a_field_of_nan_exhausts_every_ray_and_ends() -> None:
    counted = Counted(lambda points: torch.full_like(points[..., 0], torch.nan))
    trace = traced(counted, view())
    meets = meet_sphere(view().rays()).meets
    assert (trace.outcome == torch.where(meets, int(Outcome.EXHAUSTED), int(Outcome.ESCAPED))).all()
    assert (trace.distance == torch.inf).all()
    assert (trace.evaluations == meets).all()
    assert counted.evaluations == trace.total_evaluations


def test_where_half_of_a_field_is_nan_the_other_half_is_seen() -> None:
    def half(points: Tensor) -> Tensor:
        value = points.norm(dim=-1) - 0.5
        return value.masked_fill((points[..., 0] > 0) & (value < 0.2), torch.nan)

    camera = view()
    trace, true = traced(half, camera), meet_sphere(camera.rays(), 0.5)
    lost = true.meets & ~trace.hit
    assert (trace.outcome[lost] == Outcome.EXHAUSTED).all()
    assert min(trace.hit.sum(), lost.sum()) > 10
    torch.testing.assert_close(trace.distance[trace.hit], true.near[trace.hit], rtol=0, atol=TOLERANCE)
    assert not trace.closest.isnan().any()


def test_nan_that_the_lattice_does_not_see_exhausts_the_rays_that_meet_it() -> None:
    camera = view(41, focal_px=150)
    spot = 0.5 * normalize(camera.T_world_camera[:3, 3], dim=0)

    def spotted(points: Tensor) -> Tensor:
        return (points.norm(dim=-1) - 0.5).masked_fill((points - spot).norm(dim=-1) < 0.03, torch.nan)

    trace, lattice = fast_trace(spotted, camera)
    assert lattice.values.isfinite().all()
    true = meet_sphere(camera.rays(), 0.5)
    from_spot = (camera.rays().at(true.near.nan_to_num(posinf=9.0)) - spot).norm(dim=-1)
    assert (from_spot < 0.02).any()
    assert (trace.outcome[from_spot < 0.02] == Outcome.EXHAUSTED).all()
    clear = from_spot > 0.1
    torch.testing.assert_close(trace.distance[clear], true.near[clear], rtol=0, atol=TOLERANCE)
    for image in (trace.distance, trace.closest):
        assert not image.isnan().any()


def test_the_field_is_asked_without_gradients_alone() -> None:
    radius = torch.tensor(0.7, dtype=f64, requires_grad=True)

    def watched(points: Tensor) -> Tensor:
        assert not torch.is_grad_enabled()
        assert not points.requires_grad
        return points.norm(dim=-1) - radius

    start = view(32)
    pose = start.T_world_camera.clone().requires_grad_()
    camera = replace(start, intrinsics=start.intrinsics.clone().requires_grad_(), T_world_camera=pose)
    trace, lattice = fast_trace(watched, camera, 1.0)
    assert trace.hit.any()
    assert not any(image.requires_grad for image in trace.images().values())
    assert not lattice.values.requires_grad


class Narrowing(Counted):
    """A field that is another object where it is narrowed; both count."""

    def __init__(self, sdf: SDF) -> None:
        super().__init__(sdf)
        self.near = Counted(sdf)

    def narrowed(self, points: Tensor) -> tuple[Tensor, SDF]:
        return self(points), self.near


def test_rays_ask_the_narrowed_field_alone() -> None:
    field = Narrowing(BALL)
    trace, lattice = fast_trace(field, view(16))
    assert field.evaluations == trace.setup_evaluations
    assert field.near.evaluations == trace.evaluations.sum() > 0
    another = Counted(BALL)
    fast_trace(another, view(16), lattice=lattice)
    assert another.evaluations == trace.evaluations.sum()


def test_a_decoder_shows_what_it_shows_as_a_plain_function(decoded: tuple[ShapeField, Trace, Lattice]) -> None:
    """The one is narrowed by the surface, the other has no way to be."""
    field, narrow, lattice = decoded
    plain, plain_lattice = fast_trace(lambda points: field(points), view())
    assert narrow.hit.sum() > 100
    assert narrow.total_evaluations == plain.total_evaluations
    assert_same_image(narrow, plain, 1e-9)
    assert plain_lattice.near == plain_lattice.field
    near = getattr(lattice.near, "sdf", lattice.near)
    assert sum(len(bias) for _, bias in near.layers) < 0.8 * sum(len(bias) for _, bias in field.layers)


def test_a_decoder_shows_what_the_reference_shows_of_it(decoded: tuple[ShapeField, Trace, Lattice]) -> None:
    field, trace, _ = decoded
    true = reference(field, view())
    assert (trace.hit != torch.isfinite(true)).sum() <= 2
    error = (trace.distance - true)[trace.hit & torch.isfinite(true)].abs()
    assert (error > 2 * TOLERANCE).sum() <= 1
