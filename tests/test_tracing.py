"""The default tracer: against closed forms, against a cautious march, and where what is thin or far away gets lost."""

from collections import Counter

import numpy as np
import pytest
import torch
from bumpy import bumpy_balls
from torch import Tensor

from distrace.benchmarks.measuring import poster_view, reference_distance
from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.errors import DoubtfulResult
from distrace.fields import primitives
from distrace.fields.base import SDF, Counted
from distrace.fields.batch import CountedBatch
from distrace.fields.precision import fastest_field
from distrace.rays import Rays, meet_sphere
from distrace.render import Buffers, render
from distrace.tracing.evaluator import ROUGH_ERROR, Evaluator
from distrace.tracing.images import BRANCH, Pixels, reach
from distrace.tracing.march import march_cones
from distrace.tracing.sphere_tracing import Outcome
from distrace.tracing.tracer import TracerConfig, trace_rays
from experiments.costs.counting import Operations, recorded

f64 = torch.float64
P = primitives
SOFA = P.union(P.box(torch.tensor([0.6, 0.15, 0.3])), P.box(torch.tensor([0.15, 0.5, 0.3])))


def view(
    size: int = 48, azimuth: float | Tensor = 30.0, elevation: float = 20.0, distance: float = 4.97, **more
) -> Camera:
    return Camera.orbit(azimuth, elevation, distance, height=size, width=size, **more)


def sphere_distance(rays: Rays) -> Tensor:
    bounds = meet_sphere(rays, 0.5)
    return torch.where(bounds.meets, bounds.near, torch.inf)


def box_distance(rays: Rays) -> Tensor:
    half = torch.tensor([0.5, 0.3, 0.2], dtype=f64)
    sides = torch.stack([(side - rays.origins) / rays.directions for side in (-half, half)])
    enters, leaves = sides.amin(0).amax(-1), sides.amax(0).amin(-1)
    return torch.where(enters < leaves, enters, torch.inf)


def torus_distance(rays: Rays) -> Tensor:
    """The least real root of (|p|² + R² − r²)² = 4 R² (p_x² + p_z²), a polynomial of degree four."""
    major, minor = 0.5, 0.2
    found = []
    for o, v in zip(rays.origins.reshape(-1, 3).numpy(), rays.directions.reshape(-1, 3).numpy()):
        near = -o @ v - 1
        o = o + near * v
        whole = np.poly1d([1, 2 * o @ v, o @ o + major**2 - minor**2])
        flat = np.poly1d([v @ v - v[1] ** 2, 2 * (o @ v - o[1] * v[1]), o @ o - o[1] ** 2])
        roots = (whole * whole - 4 * major**2 * flat).roots
        real = [root.real + near for root in roots if abs(root.imag) < 1e-7]
        found.append(min(real, default=np.inf))
    return torch.tensor(found, dtype=f64).reshape(rays.shape)


CLOSED = {
    "sphere": (P.sphere(0.5), sphere_distance),
    "box": (P.box(torch.tensor([0.5, 0.3, 0.2], dtype=f64)), box_distance),
    "torus": (P.torus(0.5, 0.2), torus_distance),
}


@pytest.mark.parametrize("name", CLOSED)
@pytest.mark.parametrize("azimuth", [30.0, 117.0])
def test_a_solid_is_hit_where_its_closed_form_says(name: str, azimuth: float) -> None:
    sdf, distance = CLOSED[name]
    camera = view(azimuth=azimuth, dtype=f64)
    true = distance(camera.rays())
    buffers = render(sdf, camera)
    seen = true.isfinite()
    assert seen.sum() > 100
    assert (buffers.mask != seen).sum() <= 2, "but for rays that touch the rim"
    both = buffers.mask & seen
    assert (buffers.distance - true)[both].abs().max() < 1e-3
    assert (buffers.distance - true)[both].abs().median() < 5e-5


def pixel_of(camera: Camera) -> float:
    """The width of a pixel in the middle of the sphere."""
    return float(camera.T_world_camera[:3, 3].norm() / camera.intrinsics[0, 0])


def plate(width: float) -> SDF:
    return P.box(torch.tensor([0.7, 0.5, width / 2]))


def rod(width: float) -> SDF:
    return P.capsule(torch.tensor([-0.6, -0.4, 0.3]), torch.tensor([0.5, 0.6, -0.2]), width / 2)


def gap(width: float) -> SDF:
    """Two walls with air between them."""
    x = torch.tensor([0.3 + width / 2, 0.0, 0.0])
    wall = P.box(torch.tensor([0.3, 0.6, 0.1]))
    return P.union(lambda points: wall(points - x), lambda points: wall(points + x))


THIN = {"plate": (plate, 92.0), "rod": (rod, 30.0), "gap": (gap, 5.0)}  # the plate nearly edge-on


@pytest.mark.parametrize("name", THIN)
@pytest.mark.parametrize("pixels", [1, 2, 3])
def test_what_is_as_thin_as_a_pixel_is_not_lost(name: str, pixels: int) -> None:
    make, azimuth = THIN[name]
    camera = view(64, azimuth=azimuth)
    sdf = make(pixels * pixel_of(camera))
    rays = camera.rays()
    true = reference_distance(sdf, rays, meet_sphere(rays)).isfinite()
    with torch.no_grad():
        found = render(sdf, camera).mask
    assert true.sum() > 30
    assert (true & ~found).sum() <= 0.01 * true.sum()
    assert (found & ~true).sum() <= 0.01 * true.sum()


def test_a_table_on_legs_thinner_than_a_pixel_is_seen_through_a_squashed_field() -> None:
    """tanh(15 f) is as steep as 15 at the surface and flat everywhere else."""
    legs = [
        P.capsule(torch.tensor([x, 0.3, z]), torch.tensor([x, -0.5, z]), 0.012)
        for x in (-0.5, 0.5)
        for z in (-0.3, 0.3)
    ]
    top = P.box(torch.tensor([0.6, 0.02, 0.4]))
    table = P.union(lambda points: top(points - torch.tensor([0.0, 0.3, 0.0])), *legs)
    camera = view(64)
    rays = camera.rays()
    true = reference_distance(table, rays, meet_sphere(rays)).isfinite()
    with torch.no_grad():
        found = render(lambda points: torch.tanh(15 * table(points)), camera).mask
    assert true.sum() > 200
    assert not (true & ~found).any()
    assert (found & ~true).sum() <= 0.02 * true.sum()


ROD = P.capsule(torch.tensor([0.0, -0.8, 0.0]), torch.tensor([0.0, 0.8, 0.0]), 0.01)
SATURATED = {
    "truncated": lambda p: ROD(p).clamp(-0.02, 0.02),
    "truncated and scaled": lambda p: 1e-5 * ROD(p).clamp(-0.05, 0.05),
    "tanh": lambda p: torch.tanh(15 * ROD(p)),
    "a steep tanh": lambda p: torch.tanh(50 * ROD(p)),
}


@pytest.mark.parametrize("name", SATURATED)
def test_a_thin_rod_is_seen_where_its_field_saturates_at_all_cells_centres(name: str) -> None:
    """The rod lies where four cells meet: no sample of the cells is near it."""
    camera = view(128)
    with torch.no_grad():
        true = render(ROD, camera).mask
        assert true.sum() > 20
        assert (render(SATURATED[name], camera).mask != true).sum() <= 1


@pytest.mark.parametrize("focal", [1e6, 1e9])
def test_a_lens_so_long_that_pixels_are_below_what_numbers_can_tell_sees_the_surface(focal: float) -> None:
    counted = Counted(P.sphere(0.5))
    with torch.no_grad():
        assert render(counted, view(16, focal_mm=focal, sensor_mm=32)).mask.all()
    assert counted.evaluations < 50_000


def test_a_tiny_solid_off_the_centre_is_seen_by_a_long_lens() -> None:
    centre = torch.tensor([0.31, -0.22, 0.17], dtype=f64)
    eye = torch.tensor([3.0, 2.0, 3.5], dtype=f64)
    camera = Camera.look_at(eye, centre, height=24, width=24, focal_px=24_000.0)
    buffers = render(P.sphere(2e-3, centre), camera)
    rays = camera.rays()
    true = meet_sphere(Rays(rays.origins - centre, rays.directions), 2e-3)
    assert true.meets.sum() > 50
    assert (buffers.mask != true.meets).sum() <= 1
    both = buffers.mask & true.meets
    assert (buffers.distance - true.near)[both].abs().max() < 2.5e-4


@pytest.mark.parametrize("dtype", [torch.float32, f64])
def test_a_camera_three_hundred_thousand_radii_away_sees_the_ball(dtype: torch.dtype) -> None:
    camera = view(32, distance=3e5, focal_px=16 * 3e5, dtype=dtype)
    buffers = render(P.sphere(0.5), camera)
    share = float(buffers.mask.float().mean())
    assert share == pytest.approx(torch.pi / 16, rel=0.15)
    assert not (buffers.trace.outcome == Outcome.EXHAUSTED).any()


@pytest.mark.filterwarnings("ignore::distrace.errors.DoubtfulResult")
def test_a_camera_in_the_solid_is_told_so() -> None:
    camera = Camera.look_at(torch.tensor([0.1, 0.0, 0.0]), torch.tensor([0.5, 0.0, 0.0]), height=8, width=8)
    trace = render(P.sphere(0.5), camera).trace
    assert (trace.outcome == Outcome.INSIDE).all()
    assert (trace.distance == torch.inf).all()


def test_a_camera_in_the_sphere_and_beside_the_solid_sees_it() -> None:
    camera = Camera.orbit(40, 10, 0.8, height=16, width=16, focal_px=20.0, dtype=f64)
    buffers = render(P.sphere(0.3), camera)
    true = meet_sphere(camera.rays(), 0.3)
    assert (buffers.mask == true.meets).all()
    torch.testing.assert_close(buffers.distance[buffers.mask], true.near[true.meets], rtol=0, atol=2.5e-4)


def test_a_surface_beyond_the_sphere_is_not_seen() -> None:
    """The ball reaches out of the sphere: rays that enter the sphere in it are INSIDE, others see what is within."""
    ball = P.sphere(0.5, torch.tensor([0.0, 0.0, 0.7], dtype=f64))
    camera = view(32, azimuth=60.0, dtype=f64)
    buffers = render(ball, camera)
    rays = camera.rays()
    true = reference_distance(ball, rays, meet_sphere(rays))
    assert (buffers.trace.outcome == Outcome.INSIDE).sum() > 10
    assert (buffers.mask == true.isfinite()).all()
    assert buffers.points.norm(dim=1).max() <= 1 + 1e-6


@pytest.mark.parametrize("size", [16, 300])  # without blocks of pixels, and with them
def test_a_field_of_nan_is_doubted_and_every_ray_exhausted(size: int) -> None:
    camera = view(size)
    with pytest.warns(DoubtfulResult, match="EXHAUSTED"):
        trace = render(lambda points: torch.full_like(points[..., 0], torch.nan), camera).trace
    outcome = trace.outcome[meet_sphere(camera.rays()).meets]
    assert len(outcome) > 50
    assert (outcome == Outcome.EXHAUSTED).all()
    assert (trace.distance == torch.inf).all()
    assert not trace.closest.isnan().any()


@pytest.mark.parametrize("size", [32, 200])
def test_nan_in_a_corner_outside_of_the_sphere_takes_nothing_away(size: int) -> None:
    ball = P.sphere(0.5)

    def holed(points: Tensor) -> Tensor:
        return ball(points).masked_fill((points > 0.9).all(-1), torch.nan)

    with torch.no_grad():
        expected, found = render(ball, view(size)), render(holed, view(size))
    assert expected.mask.any()
    assert (found.mask == expected.mask).all()


def test_a_lipschitz_constant_is_not_ignored_beside_an_occupancy() -> None:
    first = render(SOFA, view(16), config=TracerConfig(lipschitz=2.1))
    render(SOFA, view(16), config=TracerConfig(lipschitz=2.1), occupancy=first.occupancy)
    with pytest.raises(ValueError, match=r"lipschitz=5\.0 was given with an occupancy for 2"):
        render(SOFA, view(16), config=TracerConfig(lipschitz=5.0), occupancy=first.occupancy)


def test_a_field_of_the_wrong_sign_is_doubted() -> None:
    with pytest.warns(DoubtfulResult, match="inverted"):
        trace = render(lambda points: 0.5 - points.norm(dim=-1), view(16)).trace
    assert not trace.hit.any()


def test_a_clean_picture_is_not_doubted(recwarn: pytest.WarningsRecorder) -> None:
    for size in (33, 64, 128):
        render(P.sphere(0.5), view(size))
        render(SOFA, view(size))
    assert not [warning for warning in recwarn if warning.category is DoubtfulResult]


def test_a_scene_three_times_as_large_gives_the_same_picture() -> None:
    camera, far = view(dtype=f64), view(distance=3 * 4.97, dtype=f64)
    solid = P.box(torch.tensor([0.5, 0.3, 0.2], dtype=f64))
    one = render(solid, camera)
    three = render(lambda points: 3 * solid(points / 3), far, radius=3.0)
    assert one.mask.any()
    assert (one.trace.outcome == three.trace.outcome).all()
    torch.testing.assert_close(three.distance, 3 * one.distance, rtol=0, atol=1e-9)
    assert one.trace.total_evaluations == pytest.approx(three.trace.total_evaluations, rel=0.05)


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_field_of_scaled_values_gives_the_same_mask(factor: float) -> None:
    camera = view(dtype=f64)
    for sdf in (P.torus(0.5, 0.2), P.box(torch.tensor([0.5, 0.3, 0.2], dtype=f64))):
        plain, scaled = render(sdf, camera), render(lambda points, sdf=sdf: factor * sdf(points), camera)
        assert plain.mask.any()
        assert (plain.mask == scaled.mask).all()
        both = plain.mask
        torch.testing.assert_close(scaled.distance[both], plain.distance[both], rtol=0, atol=2.5e-4)


def three_shapes() -> tuple[Tensor, list[Camera], Camera]:
    """Codes, and a camera of each, alone and in a batch."""
    model = load_model("sofas")
    cameras = [view(24, azimuth=azimuth) for azimuth in (0.0, 50.0, 200.0)]
    batch = Camera.from_matrices(
        torch.stack([camera.intrinsics for camera in cameras]),
        torch.stack([camera.T_world_camera for camera in cameras]),
        24,
        24,
    )
    return model.codes[[0, 7, 30]], cameras, batch


def test_a_batch_of_shapes_and_cameras_is_what_single_calls_give_with_their_gradients() -> None:
    model = load_model("sofas")
    codes, cameras, batch = three_shapes()
    codes = codes.clone().requires_grad_()

    def loss(buffers: Buffers) -> Tensor:
        return buffers.depth[buffers.mask].sum()

    together = render(model.field(codes), batch)
    assert together.mask.shape == (3, 24, 24)
    singly = [render(model.field(codes[k]), camera) for k, camera in enumerate(cameras)]
    for k, alone in enumerate(singly):
        assert alone.mask.sum() > 20
        assert (together.trace.outcome[k] == alone.trace.outcome).all()
        torch.testing.assert_close(together.distance[k], alone.distance, rtol=0, atol=1e-4)
    (found,) = torch.autograd.grad(loss(together), codes)
    (expected,) = torch.autograd.grad(torch.stack([loss(alone) for alone in singly]).sum(), codes)
    assert (expected.abs().amax(1) > 0).all()
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3 * float(expected.abs().max()))


@pytest.mark.parametrize(("model", "code"), [("sofas", 7), ("chairs", 3), ("tables", 130)])
def test_every_hit_on_a_decoder_lies_on_its_surface(model: str, code: int) -> None:
    """Where rough values led a ray into the solid there were hits in the air, of values up to 0.1."""
    sdf = load_model(model).field(code)
    with torch.no_grad():
        for azimuth in (0.0, 50.0, 140.0, 200.0):
            buffers = render(sdf, view(24, azimuth=azimuth))
            assert buffers.mask.sum() > 20
            assert sdf(buffers.points).abs().max() < 1e-3


def test_a_rough_value_that_was_wrong_puts_no_hit_in_the_air() -> None:
    """Exact looks find some of these rays inside before the place up to which rough ones called them clear."""
    sdf = bumpy_balls(0.4).field(torch.tensor([0.4, -0.3, 0.2, -0.4]))
    with torch.no_grad():
        for k in range(10):
            buffers = render(sdf, view(56, 36.0 * k, 10 + 15.0 * (k % 3), 2.8, focal_px=70.0))
            assert buffers.mask.sum() > 500
            assert sdf(buffers.points).abs().max() < 2e-3


@pytest.mark.parametrize("shapes", [1, 2])
def test_another_number_of_cameras_than_of_shapes_is_refused(shapes: int) -> None:
    codes, _, batch = three_shapes()
    with pytest.raises(ValueError, match=f"field of {shapes} shapes and 3 cameras"):
        render(load_model("sofas").field(codes[:shapes]), batch)


def test_single_rays_see_what_the_image_sees() -> None:
    camera = view(24, dtype=f64)
    image = render(SOFA, camera)
    trace, _ = trace_rays(SOFA, camera.rays().flat())
    assert image.mask.sum() > 30
    assert (trace.outcome.reshape(24, 24) == image.trace.outcome).all()
    both = image.mask.reshape(-1)
    torch.testing.assert_close(trace.distance[both], image.distance.reshape(-1)[both], rtol=0, atol=2.5e-4)


def test_a_smaller_tolerance_is_kept() -> None:
    camera = view(dtype=f64)
    true = torus_distance(camera.rays())
    buffers = render(P.torus(0.5, 0.2), camera, config=TracerConfig(tolerance=1e-8))
    assert (buffers.distance - true)[buffers.mask & true.isfinite()].abs().max() < 1e-6


def counts_of(sdf: SDF, camera: Camera) -> Counter[str]:
    """Operations of a first rendering and of the next; calls of the field and evaluations of the first."""
    counts: Counter[str] = Counter()
    with recorded() as calls, torch.no_grad(), Operations() as operations:
        first = render(sdf, camera)
    counts["calls"], counts["points"] = len(calls), sum(call.args[1].numel() // 3 for call in calls)
    trace, counts["operations"] = first.trace, operations.count
    with torch.no_grad(), Operations() as operations:
        render(sdf, camera, occupancy=first.occupancy)
    counts["next"] = operations.count
    counts["evaluations"] = trace.total_evaluations
    counts["setup"] = trace.setup_evaluations
    return counts


@pytest.fixture(scope="module")
def counts() -> dict[int, Counter[str]]:
    sofa = load_model("sofas").field(0)
    return {size: counts_of(sofa, poster_view(size)) for size in (64, 512)}


@pytest.mark.slow
def test_all_evaluations_of_the_posters_view_are_reported(counts) -> None:
    assert counts[512]["points"] == counts[512]["evaluations"] > 100_000


@pytest.mark.slow
def test_the_posters_view_takes_few_calls_of_the_field(counts) -> None:
    assert counts[512]["calls"] <= 60


@pytest.mark.slow
def test_the_posters_view_takes_few_operations(counts) -> None:
    rough = fastest_field(load_model("sofas").field(0)) is not None  # else it takes more queries
    assert counts[512]["operations"] <= (1500 if rough else 1700)
    assert counts[512]["next"] <= (1200 if rough else 1400)


@pytest.mark.slow
def test_operations_grow_no_faster_than_the_logarithm_of_the_images_side(counts) -> None:
    assert counts[512]["operations"] / counts[64]["operations"] < np.log(512) / np.log(64)


@pytest.mark.parametrize("radius", [0.5, 1.0])
def test_a_surface_on_the_sphere_is_hit(radius: float) -> None:
    with torch.no_grad():
        camera = Camera.orbit(30, 20, 5 * radius, height=32, width=32)
        buffers = render(primitives.sphere(radius), camera, radius=radius)
    met = meet_sphere(buffers.rays, radius).meets
    assert (buffers.mask == met).float().mean() > 0.99


def beside_the_middle(distance: Tensor) -> Rays:
    """Rays along −z that pass the origin at these distances."""
    zero = torch.zeros_like(distance)
    origins = torch.stack([distance, zero, zero + 3], dim=1)
    return Rays(origins, torch.tensor([0.0, 0.0, -1.0], dtype=distance.dtype).expand_as(origins))


def test_a_surface_just_out_of_the_sphere_is_hit_where_rays_enter() -> None:
    """f rises along rays that graze such a surface: its line has no root ahead."""
    trace, _ = trace_rays(P.sphere(1.00003), beside_the_middle(torch.linspace(0.9, 1, 2001)))
    assert trace.hit.any()
    assert trace.distance[trace.hit].min() > 2
    assert trace.distance[trace.hit].max() < 3.01


@pytest.mark.parametrize("shape", [P.sphere(0.5), P.box(torch.tensor([0.5, 0.3, 0.2], dtype=f64))])
def test_what_a_ray_passes_by_less_than_the_tolerance_is_not_hit(shape: SDF) -> None:
    beside = torch.logspace(-6, -4, 100, dtype=f64)  # of a tolerance of 2.5e-4
    trace, _ = trace_rays(shape, beside_the_middle(0.5 + beside))
    assert not trace.hit.any()
    trace, _ = trace_rays(shape, beside_the_middle(0.5 - beside))
    assert trace.hit[beside > 5e-5].all()


def test_no_rays_at_all_hit_nothing() -> None:
    trace, _ = trace_rays(SOFA, beside_the_middle(torch.zeros(0)))
    assert trace.distance.shape == trace.hit.shape == (0,)


def test_a_view_in_double_precision_takes_the_occupancy_of_one_in_single() -> None:
    single, double = (view(24, dtype=dtype) for dtype in (torch.float32, f64))
    occupancy = render(P.sphere(0.5), single).occupancy
    clearance = render(P.sphere(0.5), double, occupancy=occupancy).clearance
    torch.testing.assert_close(clearance, render(P.sphere(0.5), double).clearance, rtol=0, atol=1e-3)


def test_an_infinite_value_far_from_the_surface_changes_nothing() -> None:
    ball, camera = primitives.sphere(0.5), view(32)
    with torch.no_grad():
        found = render(lambda points: torch.where((points > 0.9).all(-1), torch.inf, ball(points)), camera)
        assert (found.mask == render(ball, camera).mask).all()


def test_every_evaluation_is_counted_where_the_image_is_padded() -> None:
    counted = Counted(primitives.sphere(0.9))
    with torch.no_grad():
        trace = render(counted, Camera.orbit(30, 20, 3, height=50, width=50, focal_px=160)).trace
    assert trace.total_evaluations == counted.evaluations


def test_evaluations_count_where_they_were_asked_for_though_another_measured_the_occupancy() -> None:
    sofa = load_model("sofas").field(0)
    first, second = Counted(sofa), Counted(sofa)
    with torch.no_grad():
        occupancy = render(first, view(32)).occupancy
        before = first.evaluations
        trace = render(second, view(32), occupancy=occupancy).trace
    assert first.evaluations == before
    assert second.evaluations == trace.total_evaluations > 1000


def test_evaluations_of_several_shapes_are_counted_for_each() -> None:
    codes, _, batch = three_shapes()
    counted = CountedBatch(load_model("sofas").field(codes))
    with torch.no_grad():
        trace = render(counted, batch).trace
    assert sum(counted.evaluations) == trace.total_evaluations
    assert min(counted.evaluations) > 1000


@pytest.mark.parametrize("again", [False, True])
def test_a_batch_of_one_shape_gives_its_image(again: bool) -> None:
    model = load_model("sofas")
    batch = view(32, azimuth=torch.tensor([30.0]))
    with torch.no_grad():
        one = render(model.field(0), view(32))
        several = render(model.field(model.codes[:1]), batch)
        if again:
            several = render(model.field(model.codes[:1]), batch, occupancy=several.occupancy)
    assert one.mask.sum() > 100
    assert (several.mask[0] == one.mask).all()
    torch.testing.assert_close(several.depth[0][one.mask], one.depth[one.mask], rtol=0, atol=1e-3)


def test_several_shapes_without_a_camera_are_refused() -> None:
    codes, _, _ = three_shapes()
    with pytest.raises(ValueError, match="a field of 3 shapes was given with rays"):
        trace_rays(load_model("sofas").field(codes), view(8).rays().flat())


def test_a_ray_comes_closest_where_it_is_in_the_sphere() -> None:
    """Far looks of a ray that grazes a floor lie beyond the ray's end, where this field falls."""
    count = 500
    origins = torch.stack([torch.full((count,), -3.0), torch.zeros(count), torch.logspace(-4, -2, count)], dim=1)
    rays = Rays(origins, torch.tensor([1.0, 0.0, 0.0]).expand(count, 3))
    trace, _ = trace_rays(lambda p: p[..., 2] - 0.5 * (p[..., 0] - 1).clamp_min(0), rays)
    assert (trace.outcome == Outcome.ESCAPED).all()
    assert (trace.closest <= meet_sphere(rays).far + 1e-5).all()


@pytest.mark.parametrize("skew", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("aspect", [1.0, 0.5])
def test_the_cone_of_a_block_holds_the_rays_of_its_pixels(skew: float, aspect: float) -> None:
    f = 400.0
    intrinsics = torch.tensor([[f, skew * f, 40.5], [0.0, aspect * f, 40.5], [0.0, 0.0, 1.0]], dtype=f64)
    camera = Camera(intrinsics, view(81, dtype=f64).T_world_camera, 81, 81)
    pixels = Pixels.of_camera(camera, camera.rays(), 1.0, 0.06)
    assert pixels.level > 0
    points = pixels.lines.at(torch.ones(len(pixels.lines.table), dtype=f64)).reshape(81, 81, 3)
    side = BRANCH**pixels.level
    blocks = points.unfold(0, side, side).unfold(1, side, side).flatten(-2)
    farthest = (blocks - blocks[..., [side**2 // 2]]).norm(dim=2).max()
    cone = reach(side) * pixels.middle.max()
    assert 0.7 * cone < farthest <= 1.001 * cone
    assert skew or aspect < 1 or farthest > 0.95 * cone


def test_rough_values_may_be_off_by_all_of_their_error() -> None:
    """Rays along a plate, by values that are wrong by as much as they may be: too large lets steps pass it."""
    sdf = P.box(torch.tensor([0.6, 0.003, 0.4]))
    camera = view(96, elevation=10.0)
    lines = Pixels.of_camera(camera, camera.rays(), 1.0, 0.012)
    number = lines.blocks()
    evaluator = Evaluator(sdf, 1.0, lambda points: sdf(points) + ROUGH_ERROR)
    rays = lines.lines[number]
    near, far = rays.in_sphere()
    meets = near < far
    cone = (lines.width + 3 * lines.growth) * reach(BRANCH**lines.level)
    span = torch.stack([near, far, near])[:, meets]
    rays = lines.lines[number[meets]]
    end, _, _ = march_cones(evaluator.rough, rays, span, cone.expand(len(span[0])), evaluator.error)
    for share in torch.linspace(0, 1, 50):
        on_the_way = rays.at(span[0].lerp(end, float(share)))
        assert (sdf(on_the_way)[end > span[0]] > 0).all()
    assert (end - span[0]).max() > 0.3


@pytest.mark.parametrize("name", ["box", pytest.param("sofa", marks=pytest.mark.slow)])
def test_the_clearance_costs_no_more_than_the_render(name: str) -> None:
    counted = Counted(SOFA if name == "box" else load_model("sofas").field(0))
    with torch.no_grad():
        buffers = render(counted, view(128))
        rendered = counted.evaluations
        assert buffers.clearance.isfinite().any()
    assert rendered == buffers.trace.total_evaluations
    assert counted.evaluations - rendered <= rendered
