"""Where the unit sphere lies: there and back, and estimated from axes, points and masks."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from photographed import POINT, WORLD, ball, in_world

from distrace.camera import Camera
from distrace.data.space_carving import within_masks
from distrace.data.unit_sphere import UnitSphere, among_points, between_axes, nearest_to_rays

RING = [Camera.orbit(40 * k, 20 * (k % 3) - 10, 4.0, height=48, width=64, focal_px=64.0) for k in range(9)]


def test_points_and_cameras_go_to_the_world_and_back() -> None:
    points = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(WORLD.to_unit(WORLD.to_world(points)), points)
    torch.testing.assert_close(WORLD.to_world(torch.zeros(3)), torch.tensor([2.0, -3.0, 40.0]))
    torch.testing.assert_close(WORLD.to_world(torch.tensor([1.0, 0, 0])), torch.tensor([7.0, -3.0, 40.0]))
    camera = WORLD.camera_to_unit(WORLD.camera_to_world(RING[3]))
    torch.testing.assert_close(camera.T_world_camera, RING[3].T_world_camera, atol=1e-5, rtol=0)


def test_a_camera_sees_the_same_pixel_in_both_frames() -> None:
    for camera in in_world():
        pixel, depth = camera.project(WORLD.to_world(POINT))
        unit_pixel, unit_depth = WORLD.camera_to_unit(camera).project(POINT)
        torch.testing.assert_close(unit_pixel, pixel)
        torch.testing.assert_close(unit_depth * WORLD.radius, depth)


def test_a_centre_far_away_is_not_rounded_before_it_is_subtracted() -> None:
    far = UnitSphere(torch.tensor([1e6, 0.3, 0.0], dtype=torch.float64), 2.0)
    point = torch.tensor([1e6 + 1.0, 0.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(far.to_unit(point), torch.tensor([0.5, -0.15, 0.0], dtype=torch.float64))


def test_axes_through_a_point_meet_there_and_the_sphere_is_around_what_the_views_show() -> None:
    unit_sphere = between_axes([WORLD.camera_to_world(camera) for camera in RING])
    torch.testing.assert_close(unit_sphere.centre, WORLD.centre, atol=1e-4, rtol=0)
    half = math.atan(math.hypot(24, 32) / 64)
    assert unit_sphere.radius == pytest.approx(WORLD.radius * 4 * math.sin(half), rel=1e-4)


def test_a_cropped_camera_is_followed_along_the_middle_of_its_image() -> None:
    whole = between_axes(RING)
    cropped = between_axes([camera.cropped(0, 0, 48, 40) for camera in RING])
    assert whole.centre.norm() < 1e-5
    assert cropped.centre.norm() > 1e-3


@pytest.mark.parametrize("degrees", [0.0, 0.3])
def test_parallel_axes_are_refused(degrees: float) -> None:
    beside = RING[0].T_world_camera.clone()
    beside[0, 3] += 1
    pair = [RING[0], replace(RING[0], T_world_camera=beside).turned(degrees)]
    with pytest.raises(ValueError, match=r"look in one direction.*unit_sphere in views\.json"):
        between_axes(pair)


def test_cameras_that_look_outward_are_refused() -> None:
    backward = torch.diag(torch.tensor([-1.0, 1, -1, 1]))
    outward = [replace(camera, T_world_camera=camera.T_world_camera @ backward) for camera in RING]
    with pytest.raises(ValueError, match="meet behind the cameras"):
        between_axes(outward)


def test_the_nearest_point_of_skew_lines_is_halfway_between_them() -> None:
    origins = torch.tensor([[-5.0, 0, 1], [0, -5, -1]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0, 0], [0, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(nearest_to_rays(origins, directions), torch.zeros(3, dtype=torch.float64))


def test_points_tell_the_sphere_although_some_are_far_away() -> None:
    drawn = np.random.default_rng(0)
    ball_points = drawn.normal(size=(500, 3))
    ball_points *= 2 * drawn.random((500, 1)) ** (1 / 3) / np.linalg.norm(ball_points, axis=1, keepdims=True)
    points = np.concatenate([ball_points + np.arange(1, 4), drawn.normal(size=(25, 3)) * 100])
    unit_sphere = among_points(points)
    assert unit_sphere is not None
    assert (unit_sphere.centre - torch.tensor([1.0, 2, 3])).norm() < 0.3
    assert 1.9 < unit_sphere.radius < 2.5
    assert among_points(points[:5]) is None


@pytest.mark.parametrize("radius", [0.15, 0.5])
def test_masks_of_a_ball_tell_a_sphere_that_just_encloses_it(radius: float) -> None:
    masks = [ball(camera, radius) for camera in RING]
    unit_sphere = within_masks([WORLD.camera_to_world(camera) for camera in RING], masks)
    away = (unit_sphere.centre - WORLD.centre).norm().item() / WORLD.radius
    found = unit_sphere.radius / WORLD.radius
    pixel = 4 / 64
    assert radius - pixel / 2 <= found - away
    assert found + away < 1.3 * radius + 2 * pixel, "a hull of nine views and pixels is larger than the ball"


def test_one_wrong_mask_among_many_does_not_carve_the_object_away() -> None:
    cameras = [Camera.orbit(20 * k, 15 * (k % 4) - 20, 4.0, height=48, width=64, focal_px=64.0) for k in range(18)]
    masks = [ball(camera) for camera in cameras]
    masks[4] = torch.zeros_like(masks[4])
    masks[4][:3, :3] = True
    assert within_masks(cameras, masks).radius > 0.45


def test_masks_that_share_nothing_are_refused() -> None:
    masks = [torch.zeros(48, 64, dtype=torch.bool) for _ in RING]
    for k, mask in enumerate(masks):
        mask[6 * (k % 2) * 6 : 6 * (k % 2) * 6 + 4, 5 * k : 5 * k + 3] = True
    with pytest.raises(ValueError, match="nothing lies within the masks of 9 views"):
        within_masks(RING, masks)
