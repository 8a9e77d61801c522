"""Rigid motions of an object before a camera."""

import math

import pytest
import roma
import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.fields import primitives
from distrace.pose import (
    Similarity,
    aimed,
    exp_se3,
    object_in_camera,
    pose_error,
    turned_object,
    with_object_at,
    zoomed,
)
from distrace.render import render

f64 = torch.float64


def camera() -> Camera:
    return Camera.orbit(30, 20, 4.0, height=20, width=30, dtype=f64)


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=f64)


def test_where_the_object_is_and_where_the_camera_is_tell_the_same() -> None:
    again = with_object_at(camera(), *object_in_camera(camera()))
    torch.testing.assert_close(again.T_world_camera, camera().T_world_camera)
    _, translation = object_in_camera(camera())
    torch.testing.assert_close(translation, vector(0, 0, 4))  # an orbit looks at the origin


def test_a_turned_object_stays_where_it_is_and_a_shifted_one_keeps_its_orientation() -> None:
    turned = turned_object(camera(), vector(0.1, -0.2, 0.3), vector(0, 0, 0))
    torch.testing.assert_close(object_in_camera(turned)[1], vector(0, 0, 4))
    degrees, percent = pose_error(turned, camera())
    assert degrees == pytest.approx(math.degrees(vector(0.1, -0.2, 0.3).norm().item()))
    assert percent == pytest.approx(0, abs=1e-9)
    shifted = turned_object(camera(), vector(0, 0, 0), vector(0.2, 0, 0))
    assert pose_error(shifted, camera()) == (pytest.approx(0, abs=1e-5), pytest.approx(5))


def test_an_object_turned_about_the_cameras_axis_moves_its_points_so() -> None:
    """By 90° about the optical axis: what was to the right, x, is below, y."""
    turned = turned_object(camera(), vector(0, 0, math.pi / 2), vector(0, 0, 0))
    rotation, _ = object_in_camera(camera())
    to_the_right = rotation.T @ vector(1, 0, 0)
    torch.testing.assert_close(object_in_camera(turned)[0] @ to_the_right, vector(0, 1, 0))


def test_many_small_turns_leave_a_rotation() -> None:
    moved = Camera.orbit(30, 20, 4.0, height=20, width=30)
    for k in range(300):
        moved = turned_object(moved, torch.tensor([0.1, 0.07 * (k % 3), -0.05]), torch.zeros(3))
    rotation = moved.T_world_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), rtol=0, atol=2e-6)


def test_a_zoom_changes_focal_lengths_alone() -> None:
    zoom = zoomed(camera(), vector(math.log(1.5))[0])
    expected = camera().intrinsics.clone()
    expected[0, 0] *= 1.5
    expected[1, 1] *= 1.5
    torch.testing.assert_close(zoom.intrinsics, expected)


@pytest.mark.parametrize("start", [vector(0, 0, 9), vector(9, 0, 0), vector(3, 7, 1)], ids=["behind", "aside", "askew"])
def test_an_aimed_camera_sees_the_origin_on_the_pixel_from_where_it_stood(start: Tensor) -> None:
    away = Camera.look_at(vector(0, 0, 5), vector(0, 0, 5) + start, height=20, width=30)
    pixel = vector(21.0, 4.0)
    found = aimed(away, pixel)
    seen, depth = found.project(torch.zeros(1, 3, dtype=f64))
    torch.testing.assert_close(seen[0], pixel)
    assert depth > 0
    torch.testing.assert_close(found.T_world_camera[:3, 3], vector(0, 0, 5))


def test_the_exponential_of_a_twist_is_a_screw_and_batches() -> None:
    """Half of it twice is all of it; its rotation is Rodrigues'; along the axis it shifts by the velocity alone."""
    turns = torch.randn(5, 3, dtype=f64, generator=torch.Generator().manual_seed(0))
    motion = exp_se3(turns, 0.7 * turns)
    half = exp_se3(turns / 2, 0.35 * turns)
    torch.testing.assert_close(half @ half, motion)
    torch.testing.assert_close(motion[:, :3, :3], roma.rotvec_to_rotmat(turns))
    torch.testing.assert_close(motion[:, :3, 3], 0.7 * turns)


@pytest.mark.parametrize("angle", [0.0, 1.0])
def test_the_exponential_of_a_twist_has_the_derivatives_of_finite_differences(angle: float) -> None:
    turn = vector(angle, -angle / 2, 0).requires_grad_()
    assert torch.autograd.gradcheck(exp_se3, (turn, vector(0.1, 0.2, 0.3).requires_grad_()))


def test_a_camera_in_the_objects_frame_keeps_the_placements_gradient() -> None:
    seen = Camera.orbit(30, 20, 4, height=15, width=15, dtype=f64)
    identity = Similarity(*(part.double() for part in (torch.eye(3), torch.zeros(3), torch.ones(()))))

    def depths(step: Tensor) -> Tensor:
        return render(primitives.sphere(0.5), identity.moved(step).camera_in_object(seen)).depth[6:9, 6:9]

    assert torch.autograd.gradcheck(depths, (torch.zeros(7, dtype=f64, requires_grad=True),), atol=1e-5)
