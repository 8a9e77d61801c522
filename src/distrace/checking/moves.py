"""Ways to change a field or its camera by one number h, along which derivatives are checked.

h has no unit. h = 1 turns by a radian, shifts by the radius of the unit sphere, or doubles a focal length. It shifts
the principal point by the image's width, and changes a code or weights by their own norm.
"""

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from distrace.camera import Camera
from distrace.fields.base import SDF, Counted, chunked, placed
from distrace.fields.decoder import Decoder, ShapeField

AXES = "xyz"
Change = Callable[[Tensor], SDF]
Move = Callable[[Tensor], tuple[SDF, Camera]]
Moves = Mapping[str, Mapping[str, Move]]  # by parameter, and by its components


class Tally:
    """Counts the evaluations of several fields together."""

    def __init__(self) -> None:
        self.fields: list[Counted] = []

    @property
    def evaluations(self) -> int:
        return sum(counted.evaluations for counted in self.fields)

    def field(self, sdf: SDF) -> Counted:
        """Returns the field, counted."""
        self.fields.append(Counted(sdf))
        return self.fields[-1]

    def move(self, move: Move) -> Move:
        """Returns the move with its fields counted."""

        def counted(h: Tensor) -> tuple[SDF, Camera]:
            sdf, camera = move(h)
            return self.field(sdf), camera

        return counted


def all_moves(sdf: SDF, camera: Camera, changes: Mapping[str, Change]) -> Moves:
    """Returns the moves of the camera, of the shape's placement, and of the field's own parameters."""
    of_field = {name: {"": lambda h, change=change: (change(h), camera)} for name, change in changes.items()}
    return {**camera_moves(sdf, camera), **placements(sdf, camera), **of_field}


def camera_moves(sdf: SDF, camera: Camera) -> Moves:
    """Returns the moves of the pose along the camera's own axes, of the focal length, and of the principal point."""
    like = camera.intrinsics
    pose_moves = {
        name: {axis: partial(_move_pose, sdf, camera, generator) for axis, generator in generators.items()}
        for name, generators in (("camera rotation", _rotations(like)), ("camera translation", _translations(like)))
    }
    zoom = torch.diag(torch.stack([like[0, 0], like[1, 1], like.new_zeros(())]))
    shifts = {axis: camera.width * torch.outer(_unit(like, 3, k), _unit(like, 3, 2)) for k, axis in enumerate("xy")}
    return {
        **pose_moves,
        "focal length": {"": partial(_change_intrinsics, sdf, camera, zoom)},
        "principal point": {axis: partial(_change_intrinsics, sdf, camera, shift) for axis, shift in shifts.items()},
    }


def placements(sdf: SDF, camera: Camera) -> Moves:
    """Returns the moves of the similarity that places the shape in the world."""
    like = camera.intrinsics
    generators = {f"rotation {axis}": generator for axis, generator in _rotations(like).items()}
    generators |= {f"translation {axis}": generator for axis, generator in _translations(like).items()}
    generators |= {"scale": torch.diag(like.new_tensor([1.0, 1, 1, 0]))}
    return {"placement": {name: partial(_move_shape, sdf, camera, generator) for name, generator in generators.items()}}


def decoder_changes(decoder: Decoder, code: Float[Tensor, "length"]) -> dict[str, Change]:
    """Returns a decoder's field as its code moves, and as all its weights move, each in a random direction."""
    direction = _direction(code.detach())
    return {"code": lambda h: decoder.field(code + h * direction), "weights": weight_change(decoder, code.detach())}


def weight_change(network: nn.Module, *inputs: Tensor) -> Change:
    """Returns a network's field as all its weights move in a random direction; `inputs` follow the points."""
    weights = {name: weight.detach() for name, weight in network.named_parameters()}
    directions = {name: _direction(weight) for name, weight in weights.items()}

    def change(h: Tensor) -> SDF:
        changed = {name: weight + h * directions[name] for name, weight in weights.items()}
        return chunked(lambda points: torch.func.functional_call(network, changed, (points, *inputs)), 4096)

    return change


def own_changes(field: SDF) -> dict[str, Change]:
    """Returns the changes of a network's weights, or of a decoder's code and weights; none for other callables."""
    if isinstance(field, nn.Module):
        return {"weights": weight_change(field)}
    if isinstance(field, ShapeField) and field.code is not None:
        return decoder_changes(field.decoder, field.code)
    return {}


def in_double(field: SDF) -> SDF:
    """Returns a float64 copy of a network or of a decoder's shape, and any other callable as it is."""
    if isinstance(field, nn.Module):
        return deepcopy(field).double().requires_grad_(False)
    if isinstance(field, ShapeField) and field.code is not None:
        return in_double(field.decoder).field(field.code.detach().double())
    return field


def _move_pose(sdf: SDF, camera: Camera, generator: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return sdf, replace(camera, T_world_camera=camera.T_world_camera @ torch.linalg.matrix_exp(h * generator))


def _change_intrinsics(sdf: SDF, camera: Camera, change: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return sdf, replace(camera, intrinsics=camera.intrinsics + h * change)


def _move_shape(sdf: SDF, camera: Camera, generator: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return placed(sdf, torch.linalg.matrix_exp(h * generator)), camera


def _rotations(like: Tensor) -> dict[str, Tensor]:
    """Returns the generators of rotations, e × ·."""
    generators = {}
    for k, axis in enumerate(AXES):
        generators[axis] = like.new_zeros(4, 4)
        generators[axis][(k + 2) % 3, (k + 1) % 3] = 1
        generators[axis][(k + 1) % 3, (k + 2) % 3] = -1
    return generators


def _translations(like: Tensor) -> dict[str, Tensor]:
    return {axis: torch.outer(_unit(like, 4, k), _unit(like, 4, 3)) for k, axis in enumerate(AXES)}


def _unit(like: Tensor, length: int, k: int) -> Tensor:
    return torch.eye(length, dtype=like.dtype, device=like.device)[k]


def _direction(like: Tensor) -> Tensor:
    """Returns a random direction, the same each time, with the norm of `like`, or norm 1 where that is zero."""
    direction = torch.randn(like.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(like)
    return direction / direction.norm() * (like.norm() if like.any() else 1.0)
