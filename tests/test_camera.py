"""The conventions of the camera: where it stands, where it looks, what a pixel sees."""

import math
from dataclasses import replace
from inspect import unwrap

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from distrace.camera import Camera
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.tracing.sphere_tracing import Trace
from distrace.viewpoint import check_size

f64 = torch.float64
orbits = st.builds(
    Camera.orbit,
    azimuth=st.floats(-360, 360),
    elevation=st.floats(-90, 90),
    distance=st.floats(0.5, 10),
    height=st.integers(1, 9),
    width=st.integers(1, 9),
    focal_mm=st.floats(20, 100),
    dtype=st.just(f64),
)


def poster(size: int = 512, dtype: torch.dtype = f64) -> Camera:
    return Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=size, width=size, dtype=dtype)


@given(azimuth=st.floats(-360, 360), elevation=st.floats(-90, 90), distance=st.floats(0.1, 10))
def test_an_orbit_stands_where_the_contract_says_and_looks_at_the_origin(
    azimuth: float, elevation: float, distance: float
) -> None:
    camera = Camera.orbit(azimuth, elevation, distance, dtype=f64)
    az, el = math.radians(azimuth), math.radians(elevation)
    eye = distance * torch.tensor([math.sin(az) * math.cos(el), math.sin(el), math.cos(az) * math.cos(el)], dtype=f64)
    torch.testing.assert_close(camera.T_world_camera[:3, 3], eye)
    forward = camera.rays(torch.tensor([[256.0, 256.0]], dtype=f64)).directions[0]
    torch.testing.assert_close(forward, -eye / distance)
    rotation = camera.T_world_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=f64))
    assert torch.linalg.det(rotation) > 0


@given(orbits)
def test_the_origin_is_seen_in_the_middle_at_the_eyes_distance(camera: Camera) -> None:
    pixel, depth = camera.project(torch.zeros(3, dtype=f64))
    torch.testing.assert_close(pixel, torch.tensor([camera.width / 2, camera.height / 2], dtype=f64))
    torch.testing.assert_close(depth, camera.T_world_camera[:3, 3].norm())


def test_y_is_up_in_the_image_and_x_is_to_the_right_as_seen_from_z() -> None:
    camera = Camera.orbit(0, 0, 4, height=100, width=100, dtype=f64)
    (x, y), _ = camera.project(torch.tensor([0, 0.5, 0], dtype=f64))
    assert x == pytest.approx(50)
    assert y < 50
    (x, y), _ = camera.project(torch.tensor([0.5, 0, 0], dtype=f64))
    assert x > 50
    assert y == pytest.approx(50)


@pytest.mark.parametrize("elevation", [90, -90, 89.9999])
def test_a_camera_may_look_straight_down_or_up(elevation: float) -> None:
    camera = Camera.orbit(10, elevation, 3, height=3, width=3)
    assert camera.rays().directions.isfinite().all()
    torch.testing.assert_close(camera.rays().directions[1, 1], -camera.T_world_camera[:3, 3] / 3)


def test_pixel_centres_are_at_a_half_and_images_are_rows_of_columns() -> None:
    camera = Camera.orbit(0, 0, 4, height=3, width=5)
    assert camera.pixels().shape == (3, 5, 2)
    assert camera.pixels()[0, 0].tolist() == [0.5, 0.5]
    assert camera.pixels()[1, 4].tolist() == [4.5, 1.5]
    assert camera.rays().shape == (3, 5)


@given(orbits, st.floats(0.01, 10))
def test_a_point_on_a_pixels_ray_is_projected_to_that_pixel_at_its_depth(camera: Camera, distance: float) -> None:
    rays = camera.rays()
    torch.testing.assert_close(rays.directions.norm(dim=-1), torch.ones(rays.shape, dtype=f64))
    distances = torch.full(rays.shape, distance, dtype=f64)
    pixels, depth = camera.project(rays.at(distances))
    torch.testing.assert_close(pixels, camera.pixels())
    torch.testing.assert_close(depth, camera.depth(distances))


def test_depth_is_shorter_than_distance_by_the_cosine_of_the_angle() -> None:
    camera = Camera.orbit(0, 0, 4, height=64, width=64, focal_px=32, dtype=f64)  # 90° from edge to edge
    corner = camera.cosines(torch.tensor([[32.0, 32.0], [64.0, 32.0], [64.0, 64.0]], dtype=f64))
    torch.testing.assert_close(corner, torch.tensor([1, 1 / math.sqrt(2), 1 / math.sqrt(3)], dtype=f64))
    torch.testing.assert_close(camera.depth(torch.full((64, 64), 2.0, dtype=f64)), 2 * camera.cosines())


def test_as_many_rays_of_the_posters_view_enter_the_sphere_as_published() -> None:
    """122,172 by counting pixels within f / √(d² − 1) of the middle.

    Eight of them graze the sphere closer than float32 tells: the published 122,166 counts two of those.
    """
    reach = 960**2 / (4.97**2 - 1)
    counted = sum((x + 0.5) ** 2 + (y + 0.5) ** 2 < reach for x in range(-256, 256) for y in range(-256, 256))
    for dtype in (torch.float32, f64):
        rays = poster(dtype=dtype).rays()
        assert meet_sphere(rays).meets.sum() == counted == 122_172
    assert meet_sphere(rays, 1 - 2e-6).meets.sum() == counted - 8 <= 122_166 <= counted


def test_the_tolerance_is_half_of_what_neighbouring_pixels_see() -> None:
    """ε = d S cos²θ / (2 f R), 5e-5 for the paper's f = 60 mm, S = 32 mm, R = 512, d = 10 cm."""
    tolerance = poster().tolerance(0.1)
    assert tolerance.max() == pytest.approx(0.1 * 32 / (2 * 60 * 512), rel=1e-5)
    assert tolerance.max() == pytest.approx(5e-5, rel=0.05)
    torch.testing.assert_close(tolerance, 0.1 / (2 * 960) * poster().cosines() ** 2)


@given(orbits, st.sampled_from([0.25, 0.5, 2.0, 3.0]))
def test_a_resized_camera_sees_the_same_and_covers_every_pixel(camera: Camera, factor: float) -> None:
    resized = camera.resized(factor)
    assert resized.height >= camera.height * factor > resized.height - 1
    assert resized.width >= camera.width * factor > resized.width - 1
    there = resized.rays(camera.pixels() * factor)
    torch.testing.assert_close(there.directions, camera.rays().directions)
    torch.testing.assert_close(there.origins, camera.rays().origins)


@given(orbits, st.integers(0, 8), st.integers(0, 8), st.integers(1, 12), st.integers(1, 12))
def test_a_cropped_camera_has_the_rays_of_its_part(
    camera: Camera, top: int, left: int, height: int, width: int
) -> None:
    top, left = top % camera.height, left % camera.width
    part = camera.cropped(top, left, height, width)
    rays = camera.rays()[top : top + height, left : left + width]
    assert (part.height, part.width) == rays.shape
    torch.testing.assert_close(part.rays().directions, rays.directions)
    torch.testing.assert_close(part.rays().origins, rays.origins)
    torch.testing.assert_close(part.cosines(), camera.cosines()[top : top + height, left : left + width])


def test_cropping_leaves_the_camera_as_it_was_and_keeps_its_gradients() -> None:
    camera = Camera(K.clone().requires_grad_(), T.clone().requires_grad_(), 64, 64)
    part = camera.cropped(3, 5, 8, 8)
    torch.testing.assert_close((camera.intrinsics, camera.T_world_camera), (K, T))
    by_both = torch.autograd.grad(
        part.intrinsics.sum() + part.T_world_camera.sum(), (camera.intrinsics, camera.T_world_camera)
    )
    torch.testing.assert_close(by_both, (torch.ones(3, 3), torch.ones(4, 4)))


def test_a_detached_camera_has_the_same_rays_without_gradients() -> None:
    camera = Camera(K.clone().requires_grad_(), T.clone().requires_grad_(), 4, 4)
    assert camera.rays().directions.requires_grad
    detached = camera.detach().rays()
    assert not detached.directions.requires_grad
    assert not detached.origins.requires_grad
    torch.testing.assert_close(detached.directions, camera.rays().directions.detach())


def test_cameras_in_a_batch_have_the_rays_of_each() -> None:
    alone = [Camera.orbit(a, 10, 3 + a / 90, height=4, width=6, focal_mm=30 + a, dtype=f64) for a in (0, 45, 200)]
    batch = Camera.from_matrices(
        torch.stack([c.intrinsics for c in alone]), torch.stack([c.T_world_camera for c in alone]), 4, 6
    )
    assert batch.rays().shape == batch.cosines().shape == batch.tolerance(0.1).shape == (3, 4, 6)
    for k, camera in enumerate(alone):
        torch.testing.assert_close(batch.rays().directions[k], camera.rays().directions)
        torch.testing.assert_close(batch.rays().origins[k], camera.rays().origins)
        torch.testing.assert_close(batch.cosines()[k], camera.cosines())
        torch.testing.assert_close(batch.tolerance(0.1)[k], camera.tolerance(0.1))
        for changed in (
            Camera.detach,
            lambda c: c.resized(0.5),
            lambda c: c.cropped(1, 2, 2, 3),
        ):
            torch.testing.assert_close(changed(batch).rays().directions[k], changed(camera).rays().directions)
            torch.testing.assert_close(changed(batch).rays().origins[k], changed(camera).rays().origins)


def test_a_focal_length_in_pixels_is_the_one_in_millimetres() -> None:
    in_mm = Camera.orbit(0, 0, 3, focal_mm=60, sensor_mm=32, height=10, width=64)
    in_px = Camera.orbit(0, 0, 3, focal_px=120, height=10, width=64)
    torch.testing.assert_close(in_mm.intrinsics, in_px.intrinsics)


@pytest.mark.parametrize(
    ("given", "repeated"),
    [
        (dict(distance=0), "its own place"),
        (dict(distance=math.nan), "all three must be finite"),
        (dict(distance=math.inf), "all three must be finite"),
        (dict(height=0), "0 × 512"),
        (dict(width=-3), "512 × -3"),
        (dict(focal_mm=-35), "-35"),
        (dict(focal_mm=math.inf), "inf"),
        (dict(sensor_mm=0), "sensor of 0"),
        (dict(focal_px=0), "length of 0"),
        (dict(focal_px=-120), "-120"),
    ],
    ids=str,
)
def test_an_orbit_that_no_camera_can_have_is_refused_in_words(given: dict, repeated: str) -> None:
    with pytest.raises(ValueError, match=repeated):
        Camera.orbit(**{"azimuth": 30, "elevation": 20, "distance": 4.97, **given})


K = torch.tensor([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]])
T = torch.tensor([[1.0, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, -3], [0, 0, 0, 1]])


@pytest.mark.parametrize(
    ("intrinsics", "pose", "repeated"),
    [
        (K[:2], T, r"\[2, 3\]"),
        (K, T[:3], r"\[3, 4\]"),
        (K, T.expand(5, 4, 4), r"\[5, 4, 4\]"),
        (K.expand(2, 3, 3), T.expand(5, 4, 4), r"\[2, 3, 3\]"),
        (K * torch.tensor([[-1.0], [1], [1]]), T, "-100"),
        (K.where(K != 32, torch.nan), T, "not finite"),
        (K.T, T, "intrinsics .* transposed"),
        (K, T.T, "T_world_camera .* transposed"),
        (K, T * torch.tensor([-1.0, 1, 1, 1]), "mirroring"),
        (K, T * torch.tensor([2.0, 2, 2, 1]), "rotation"),
    ],
)
def test_matrices_that_are_no_cameras_are_refused_in_words(
    intrinsics: torch.Tensor, pose: torch.Tensor, repeated: str
) -> None:
    Camera.from_matrices(K, T, 64, 64)
    with pytest.raises(ValueError, match=repeated):
        Camera.from_matrices(intrinsics, pose, 64, 64)


def test_an_image_without_pixels_is_refused() -> None:
    with pytest.raises(ValueError, match="0 × 64"):
        Camera.from_matrices(K, T, 0, 64)


def test_numbers_that_make_no_camera_are_told() -> None:
    for where in ((math.inf, 0, 3), (0, math.nan, 3), (0, 0, math.inf)):
        with pytest.raises(ValueError, match=r"an orbit at .* was given; all three must be finite"):
            Camera.orbit(*where)
    for factor in (0.0, -1.0, math.nan):
        with pytest.raises(ValueError, match="a sensor is resized by a positive one"):
            Camera.orbit(0, 0, 3).resized(factor)


def test_an_orbit_of_tensors_is_that_of_their_numbers() -> None:
    numbers = Camera.orbit(30, 20, 4.97, dtype=f64)
    for az, el, away in ((30, 20, torch.tensor(4.97, dtype=f64)), (torch.tensor(30, dtype=f64), 20.0, 4.97)):
        tensors = Camera.orbit(az, el, away)
        assert tensors.T_world_camera.dtype == f64
        torch.testing.assert_close(tensors.T_world_camera, numbers.T_world_camera)
        assert torch.equal(tensors.intrinsics, numbers.intrinsics)
    assert Camera.orbit(torch.tensor(30), 20, 4).T_world_camera.dtype == torch.float32
    assert Camera.orbit(torch.tensor(30.0), 20, 4, dtype=f64).T_world_camera.dtype == f64


@given(azimuth=st.floats(-360, 360), elevation=st.floats(-80, 80), distance=st.floats(1.5, 10))
def test_an_orbit_has_the_derivatives_of_finite_differences(azimuth: float, elevation: float, distance: float) -> None:
    where = [torch.tensor(number, dtype=f64, requires_grad=True) for number in (azimuth, elevation, distance)]
    assert torch.autograd.gradcheck(lambda *at: Camera.orbit(*at, height=4, width=4).T_world_camera, where)


def test_looking_at_a_point_has_the_derivatives_of_finite_differences() -> None:
    eye, target = (torch.tensor(at, dtype=f64, requires_grad=True) for at in ([1.0, 2, 3], [0.1, -0.2, 0.3]))
    assert torch.autograd.gradcheck(lambda *at: Camera.look_at(*at).T_world_camera, (eye, target))


def test_tensors_with_batch_axes_give_a_batch_of_cameras() -> None:
    azimuths, elevations = torch.tensor([0.0, 120, 240], dtype=f64), torch.tensor([[10.0], [90.0]], dtype=f64)
    batch = Camera.orbit(azimuths, elevations, 3.0, height=4, width=6)
    assert batch.T_world_camera.shape == (2, 3, 4, 4)
    assert batch.rays().shape == (2, 3, 4, 6)
    for row, elevation in enumerate(elevations[:, 0].tolist()):
        for column, azimuth in enumerate(azimuths.tolist()):
            alone = Camera.orbit(azimuth, elevation, 3.0, height=4, width=6, dtype=f64)
            torch.testing.assert_close(batch.T_world_camera[row, column], alone.T_world_camera)
            torch.testing.assert_close(batch.intrinsics[row, column], alone.intrinsics)


def test_several_eyes_may_look_at_one_target_and_points_may_be_numbers() -> None:
    eyes = torch.tensor([[0.0, 0, 3], [0, 3, 0], [2, 1, 2]])
    batch = Camera.look_at(eyes, (0.1, 0.0, 0.2))
    for number, eye in enumerate(eyes.tolist()):
        alone = Camera.look_at(tuple(eye), (0.1, 0.0, 0.2))
        torch.testing.assert_close(batch.T_world_camera[number], alone.T_world_camera)
    assert torch.equal(Camera.look_at((0, 0, 3), torch.zeros(3)).T_world_camera[:3, 3], torch.tensor([0.0, 0, 3]))


@pytest.mark.parametrize(
    ("where", "repeated"),
    [
        ((torch.tensor([0.0, math.nan]), 0, 3), r"an orbit at \[0.0, nan\]°, 0.0°, 3.0 .* finite"),
        ((0, torch.tensor(math.inf), 3), "an orbit at 0.0°, inf°, 3.0 .* finite"),
        ((0, 0, torch.tensor([3.0, 0.0])), "its own place"),
        ((torch.zeros(2), torch.zeros(3), 3), r"\[2\] and \[3\] and \[\] .* batch axes"),
    ],
    ids=str,
)
def test_tensors_that_no_camera_can_have_are_refused_in_words(where: tuple, repeated: str) -> None:
    with pytest.raises(ValueError, match=repeated):
        Camera.orbit(*where)


def test_points_of_other_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\[2\] and \[3\] were given; both are \[3\]"):
        Camera.look_at(torch.ones(2), torch.zeros(3))
    with pytest.raises(ValueError, match=r"\[2, 3\] and \[5, 3\] were given; they must"):
        Camera.look_at(torch.ones(2, 3), torch.zeros(5, 3))


def things() -> list[object]:
    """One of each class, made anew."""
    camera = Camera.orbit(30, 20, 3, height=2, width=3)
    bounds, one = meet_sphere(camera.rays()), torch.ones(2, 3)
    trace = Trace(one * math.inf, one.long(), one, one, one.long())
    return [camera, camera.rays(), bounds, trace]


@pytest.mark.parametrize("number", range(4))
def test_equal_values_are_equal_and_others_are_not(number: int) -> None:
    first, second = things()[number], things()[number]
    assert first == second
    assert hash(first) == hash(second)
    others = [thing for k, thing in enumerate(things()) if k != number]
    assert all(first != other for other in others)
    assert first != "camera"


def test_what_differs_in_one_value_or_in_precision_is_not_equal() -> None:
    camera = Camera.orbit(30, 20, 3, height=2, width=3)
    assert camera != Camera.orbit(30, 20, 3.0001, height=2, width=3)
    assert camera != Camera.orbit(30, 20, 3, height=3, width=3)
    assert camera != Camera.orbit(30, 20, 3, height=2, width=3, dtype=f64)
    assert camera == Camera(camera.intrinsics.clone().requires_grad_(), camera.T_world_camera, 2, 3)
    rays = camera.rays()
    assert rays != rays[0]
    assert Bounds(torch.zeros(2), torch.ones(2)) != Bounds(torch.zeros(2), torch.full((2,), math.nan))
    assert {rays: 1}[Rays(rays.origins.clone(), rays.directions.clone())] == 1
    trace = things()[3]
    assert isinstance(trace, Trace)
    assert trace != replace(trace, setup_evaluations=1)


@pytest.mark.parametrize("name", ["focal_mm", "focal_px"])
def test_the_focal_length_of_an_orbit_keeps_its_gradient(name: str) -> None:
    focal = torch.tensor(50.0, requires_grad=True)
    camera = Camera.orbit(30, 20, 4.97, height=8, width=8, **{name: focal})
    rays = camera.rays()
    (gradient,) = torch.autograd.grad(rays.directions[0, 0, 0], focal)
    assert gradient.abs() > 1e-6


def test_sizes_that_are_no_whole_numbers_are_refused() -> None:
    without_checks_of_types = unwrap(check_size)
    with pytest.raises(ValueError, match=r"an image of 2\.5 × 512 pixels was given; both must be whole numbers from 1"):
        without_checks_of_types(2.5, 512)
