"""Rigid motions of an object before a camera, and how far two of them are apart."""

import math
from dataclasses import replace

import roma
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera


def object_in_camera(camera: Camera) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation and translation from the world, whose origin is the object's middle, to the camera."""
    rotation = camera.T_world_camera[:3, :3].T
    return rotation, -rotation @ camera.T_world_camera[:3, 3]


def with_object_at(camera: Camera, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Camera:
    """The same camera where it sees the object so: the inverse of `object_in_camera`."""
    pose = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    pose[:3, :3], pose[:3, 3] = rotation.T, -rotation.T @ translation
    return replace(camera, T_world_camera=pose)


def turned_object(camera: Camera, rotation_vector: Float[Tensor, "3"], shift: Float[Tensor, "3"]) -> Camera:
    """The camera that sees the object turned about its middle, by an axis times an angle in the camera's axes, and
    then shifted."""
    rotation, translation = object_in_camera(camera)
    turned: Tensor = roma.special_procrustes(roma.rotvec_to_rotmat(rotation_vector) @ rotation)  # pyright: ignore[reportAssignmentType]
    return with_object_at(camera, turned, translation + shift)  # a rotation to rounding, after many turns, too


def zoomed(camera: Camera, log_factor: Tensor) -> Camera:
    """The same camera with another focal length."""
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 0], intrinsics[1, 1] = (intrinsics[k, k] * log_factor.exp() for k in (0, 1))
    return replace(camera, intrinsics=intrinsics)


def aimed(camera: Camera, pixel: Float[Tensor, "2"]) -> Camera:
    """The camera turned about its own place until the world's origin lies on a pixel's ray, ahead of it."""
    rotation, translation = object_in_camera(camera)
    there = torch.linalg.inv(camera.intrinsics) @ torch.cat([pixel, torch.ones_like(pixel[:1])])
    distance = translation.norm().clamp_min(1e-6)
    wanted, now = there / there.norm(), translation / distance
    axis = torch.linalg.cross(now, wanted)
    if not axis.norm() > 1e-6:  # straight behind: any axis across serves
        axis = torch.linalg.cross(now, now.roll(1) + 0.1)
    angle = torch.acos((now @ wanted).clamp(-1, 1))
    turn = roma.rotvec_to_rotmat(axis / axis.norm() * angle)
    return with_object_at(camera, turn @ rotation, turn @ translation)


def pose_error(camera: Camera, truth: Camera) -> tuple[float, float]:
    """Degrees between two orientations, and the object's shift before the camera in percent of its true distance."""
    (rotation, translation), (true, there) = (object_in_camera(which) for which in (camera, truth))
    degrees = math.degrees(float(roma.rotmat_geodesic_distance(rotation.double(), true.double())))
    return degrees, 100 * float((translation - there).norm() / there.norm())
