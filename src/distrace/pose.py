"""Rigid motions of an object before a camera, and how far two of them are apart."""

import math
from dataclasses import dataclass, replace

import roma
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from distrace.camera import Camera
from distrace.equality import ByValue
from distrace.rays import Rays


def exp_se3(
    rotation_vector: Float[Tensor, "*batch 3"], translation: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Returns the exponential of a twist: the rigid motion that it leads to in unit time, as a matrix.

    `rotation_vector` is the axis times the angle in radians; `translation` is the velocity of the origin, so the origin
    moves by V · translation (Murray, Li and Sastry, *A Mathematical Introduction to Robotic Manipulation*, 2.3.2). Both
    keep their gradients, also at zero: optimise them, and move a camera by `exp_se3(r, t) @ camera.T_world_camera`.

    >>> turn = torch.tensor([0.0, torch.pi / 2, 0.0])
    >>> (exp_se3(turn, torch.zeros(3))[:3, :3] @ torch.tensor([0.0, 0.0, 1.0])).round().tolist()
    [1.0, 0.0, 0.0]
    """
    x, y, z = rotation_vector.unbind(-1)
    zero = torch.zeros_like(x)
    rotation = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(*x.shape, 3, 3)
    generator = torch.cat([rotation, translation[..., None]], dim=-1)
    return torch.linalg.matrix_exp(pad(generator, (0, 0, 0, 1)))


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


@dataclass(frozen=True, eq=False, repr=False)
class Similarity(ByValue):
    """Where an object lies in the world: x_world = scale · rotation · x_object + translation."""

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: Float[Tensor, ""]

    @staticmethod
    def identity() -> "Similarity":
        return Similarity(torch.eye(3), torch.zeros(3), torch.ones(()))

    def to(self, device: torch.device | str) -> "Similarity":
        return Similarity(self.rotation.to(device), self.translation.to(device), self.scale.to(device))

    @property
    def T_world_object(self) -> Float[Tensor, "4 4"]:
        matrix = torch.eye(4).to(self.rotation)
        matrix[:3, :3], matrix[:3, 3] = self.scale * self.rotation, self.translation
        return matrix

    def to_world(self, points_object: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        return self.scale * self.turned(points_object) + self.translation

    def to_object(self, points_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        return (points_world - self.translation) @ self.rotation / self.scale

    def turned(self, vectors_object: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Directions of the object, in the world."""
        return vectors_object @ self.rotation.T

    def rays_in_object(self, rays: Rays) -> Rays:
        """Rays of the world as the object has them; distances along them are divided by the scale."""
        return Rays(self.to_object(rays.origins), rays.directions @ self.rotation)

    def camera_in_object(self, camera: Camera) -> Camera:
        """The camera that sees the object in its own frame as the given one does in the world; depths are divided."""
        pose = camera.T_world_camera.clone()
        pose[:3, :3] = self.rotation.T @ pose[:3, :3]
        pose[:3, 3] = self.to_object(pose[:3, 3])
        return replace(camera, T_world_camera=pose)

    def moved(self, step: Float[Tensor, "7"]) -> "Similarity":
        """Turned about the object's middle by an axis times an angle, shifted, in the world's axes, and grown by e to
        the last."""
        turned: Tensor = roma.special_procrustes(roma.rotvec_to_rotmat(step[:3]) @ self.rotation)  # pyright: ignore[reportAssignmentType]
        return Similarity(turned, self.translation + step[3:6], self.scale * step[6].exp())

    def step_from(self, other: "Similarity") -> Float[Tensor, "7"]:
        """By which the other would be moved here."""
        turn: Tensor = roma.rotmat_to_rotvec(self.rotation @ other.rotation.T)  # pyright: ignore[reportAssignmentType]
        return torch.cat([turn, self.translation - other.translation, (self.scale / other.scale).log()[None]])

    def change(self, points_object: Float[Tensor, "n 3"], gradient: Float[Tensor, "n 3"]) -> Float[Tensor, "n 7"]:
        """By which the object's field, whose gradient there is given, changes at fixed points of the world as it moves.

        In the object's frame those points move the other way: x → x − (ω × x + τ / scale + σ x).
        """
        turning = torch.linalg.cross(points_object, gradient) @ self.rotation.T
        growing = (points_object * gradient).sum(-1, keepdim=True)
        return -torch.cat([turning, self.turned(gradient) / self.scale, growing], dim=1)
