"""Rigid motions and similarities: of an object before a camera, and of an object in the world."""

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
from distrace.vectors import length, perpendicular


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
    return pad(generator, (0, 0, 0, 1)).matrix_exp()


def object_in_camera(camera: Camera) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Returns rotation and translation from the world, whose origin is the object's centre, to the camera."""
    rotation = camera.T_world_camera[:3, :3].T
    return rotation, -rotation @ camera.T_world_camera[:3, 3]


def with_object_at(camera: Camera, rotation: Float[Tensor, "3 3"], translation: Float[Tensor, "3"]) -> Camera:
    """Returns the camera with the object at this place before it: the inverse of `object_in_camera`."""
    pose = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ translation
    return replace(camera, T_world_camera=pose)


def turned_object(camera: Camera, rotation_vector: Float[Tensor, "3"], shift: Float[Tensor, "3"]) -> Camera:
    """Returns the camera with the object rotated about its centre, by a vector in the camera's axes, and then shifted.

    The vector is the axis times the angle in radians.
    """
    rotation, translation = object_in_camera(camera)
    return with_object_at(camera, _rotated(rotation, rotation_vector), translation + shift)


def zoomed(camera: Camera, log_factor: Tensor) -> Camera:
    """Returns the same camera with its focal lengths × exp(log_factor)."""
    intrinsics = camera.intrinsics.clone()
    factor = log_factor.exp()
    intrinsics[0, 0] = intrinsics[0, 0] * factor
    intrinsics[1, 1] = intrinsics[1, 1] * factor
    return replace(camera, intrinsics=intrinsics)


def aimed(camera: Camera, pixel: Float[Tensor, "2"]) -> Camera:
    """Returns the camera rotated in its place so that the world's origin lies on a pixel's ray, ahead of it."""
    rotation, translation = object_in_camera(camera)
    ahead = camera.intrinsics.inverse() @ torch.cat([pixel, torch.ones_like(pixel[:1])])
    towards_pixel = ahead / length(ahead)
    towards_origin = translation / length(translation).clamp_min(1e-6)
    axis = torch.cross(towards_origin, towards_pixel, dim=-1)
    if not length(axis) > 1e-6:  # straight behind: any axis across serves
        axis = perpendicular(towards_origin)
    angle = torch.acos((towards_origin @ towards_pixel).clamp(-1, 1))
    turn = roma.rotvec_to_rotmat(axis / length(axis) * angle)
    return with_object_at(camera, turn @ rotation, turn @ translation)


def pose_error(camera: Camera, truth: Camera) -> tuple[float, float]:
    """Returns the degrees between two orientations, and the shift of the object in percent of its true distance.

    >>> degrees, percent = pose_error(Camera.orbit(0, 0, 4.4), Camera.orbit(0, 0, 4))
    >>> round(degrees), round(percent)
    (0, 10)
    """
    rotation, translation = object_in_camera(camera)
    true_rotation, true_translation = object_in_camera(truth)
    degrees = math.degrees(float(roma.rotmat_geodesic_distance(rotation.double(), true_rotation.double())))
    return degrees, 100 * float(length(translation - true_translation) / length(true_translation))


def _rotated(rotation: Float[Tensor, "3 3"], rotation_vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Returns a rotation followed by another one, orthogonal to rounding also after many calls."""
    product = roma.rotvec_to_rotmat(rotation_vector) @ rotation
    return roma.special_procrustes(product)


@dataclass(frozen=True, eq=False, repr=False)
class Similarity(ByValue):
    """The placement of an object in the world: x_world = scale · rotation · x_object + translation.

    >>> Similarity.identity().to_world(torch.ones(2, 3)).shape
    torch.Size([2, 3])
    """

    rotation: Float[Tensor, "3 3"]
    translation: Float[Tensor, "3"]
    scale: Float[Tensor, ""]

    @staticmethod
    def identity() -> "Similarity":
        return Similarity(torch.eye(3), torch.zeros(3), torch.ones(()))

    @staticmethod
    def from_matrix(T_world_object: Float[Tensor, "4 4"]) -> "Similarity":
        """Returns the similarity of a matrix. Raises `ValueError` for one that is none."""
        gram = T_world_object[:3, :3].T @ T_world_object[:3, :3]
        scale = (gram.diagonal().sum() / 3).sqrt()
        rotation = T_world_object[:3, :3] / scale
        off = (rotation.T @ rotation - torch.eye(3).to(rotation)).abs().max()
        mirrored = torch.cross(rotation[:, 0], rotation[:, 1], dim=0) @ rotation[:, 2] < 0
        if T_world_object.shape != (4, 4) or not off < 1e-3 or mirrored:
            raise ValueError("the matrix is not a rotation times a positive scale, and a translation")
        return Similarity(rotation, T_world_object[:3, 3], scale)

    def to(self, device: torch.device | str) -> "Similarity":
        return Similarity(self.rotation.to(device), self.translation.to(device), self.scale.to(device))

    @property
    def T_world_object(self) -> Float[Tensor, "4 4"]:
        """The matrix of the similarity, as `placed` takes it."""
        matrix = torch.eye(4).to(self.rotation)
        matrix[:3, :3] = self.scale * self.rotation
        matrix[:3, 3] = self.translation
        return matrix

    def to_world(self, points_object: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Returns points of the object in the world."""
        return self.scale * self.turned(points_object) + self.translation

    def to_object(self, points_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Returns points of the world in the object's frame."""
        return (points_world - self.translation) @ self.rotation / self.scale

    def turned(self, vectors_object: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Returns directions of the object in the world."""
        return vectors_object @ self.rotation.T

    def rays_in_object(self, rays: Rays) -> Rays:
        """Returns rays of the world in the object's frame; distances along them are divided by the scale."""
        return Rays(self.to_object(rays.origins), rays.directions @ self.rotation)

    def camera_in_object(self, camera: Camera) -> Camera:
        """Returns the camera with the same view in the object's frame; depths are divided by the scale."""
        pose = camera.T_world_camera
        rotation = self.rotation.T @ pose[:3, :3]
        upper = torch.cat([rotation, self.to_object(pose[:3, 3])[:, None]], dim=1)
        return replace(camera, T_world_camera=torch.cat([upper, pose[3:]]))

    def moved(self, step: Float[Tensor, "7"]) -> "Similarity":
        """Returns the placement after a step: rotation vector (3), shift (3) and log scale, in the world's axes.

        The rotation is about the object's centre.
        """
        rotation = _rotated(self.rotation, step[:3])
        return Similarity(rotation, self.translation + step[3:6], self.scale * step[6].exp())

    def step_from(self, other: "Similarity") -> Float[Tensor, "7"]:
        """Returns the step by which `other.moved(step)` is this placement."""
        turn = roma.rotmat_to_rotvec(self.rotation @ other.rotation.T)
        return torch.cat([turn, self.translation - other.translation, (self.scale / other.scale).log()[None]])

    def change(self, points_object: Float[Tensor, "n 3"], gradient: Float[Tensor, "n 3"]) -> Float[Tensor, "n 7"]:
        """Returns the derivatives of the object's field at fixed points of the world by the step of `moved`.

        `gradient` is that of the field at the points. In the object's frame the points move the other way:
        x → x − (ω × x + τ / scale + σ x).
        """
        by_rotation = torch.cross(points_object, gradient, dim=-1) @ self.rotation.T
        by_scale = (points_object * gradient).sum(-1, keepdim=True)
        return -torch.cat([by_rotation, self.turned(gradient) / self.scale, by_scale], dim=1)
