"""Ways to move a field and its camera by one number h: what derivatives are checked along.

All are without units: h = 1 turns by a radian, shifts by the unit sphere's radius, doubles a focal length, shifts the
principal point by the image's width, and changes a code or weights by as much as they are.
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
    """Counts how often fields are asked, all together."""

    def __init__(self) -> None:
        self.asked: list[Counted] = []

    @property
    def evaluations(self) -> int:
        return sum(counted.evaluations for counted in self.asked)

    def field(self, sdf: SDF) -> Counted:
        self.asked.append(Counted(sdf))
        return self.asked[-1]

    def move(self, move: Move) -> Move:
        """The same, and its fields are counted."""

        def counted(h: Tensor) -> tuple[SDF, Camera]:
            sdf, camera = move(h)
            return self.field(sdf), camera

        return counted


def all_moves(sdf: SDF, camera: Camera, changes: Mapping[str, Change]) -> Moves:
    """Of the camera, of the place of the shape, and of the field's own parameters."""
    of_field = {name: {"": lambda h, change=change: (change(h), camera)} for name, change in changes.items()}
    return {**camera_moves(sdf, camera), **placements(sdf, camera), **of_field}


def camera_moves(sdf: SDF, camera: Camera) -> Moves:
    """The pose in the camera's own axes, the focal length, and the principal point."""
    like = camera.intrinsics
    turns, shifts = _turns(like), _shifts(like)
    longer = torch.diag(torch.stack([like[0, 0], like[1, 1], like.new_zeros(())]))
    aside = {axis: camera.width * torch.outer(_unit(like, 3, k), _unit(like, 3, 2)) for k, axis in enumerate("xy")}
    return {
        "camera rotation": {axis: partial(_posed, sdf, camera, turn) for axis, turn in turns.items()},
        "camera translation": {axis: partial(_posed, sdf, camera, shift) for axis, shift in shifts.items()},
        "focal length": {"": partial(_seen, sdf, camera, longer)},
        "principal point": {axis: partial(_seen, sdf, camera, change) for axis, change in aside.items()},
    }


def placements(sdf: SDF, camera: Camera) -> Moves:
    """The similarity that places the shape in the world."""
    like = camera.intrinsics
    generators = {f"rotation {axis}": turn for axis, turn in _turns(like).items()}
    generators |= {f"translation {axis}": shift for axis, shift in _shifts(like).items()}
    generators |= {"scale": torch.diag(like.new_tensor([1.0, 1, 1, 0]))}
    return {"placement": {name: partial(_put, sdf, camera, generator) for name, generator in generators.items()}}


def decoder_changes(decoder: Decoder, code: Float[Tensor, "length"]) -> dict[str, Change]:
    """A decoder's field as its code moves, and as all its weights do; each in a random direction."""
    along = _direction(code.detach())
    return {"code": lambda h: decoder.field(code + h * along), "weights": weight_change(decoder, code.detach())}


def weight_change(network: nn.Module, *inputs: Tensor) -> Change:
    """A network's field as all its weights move in a random direction; `inputs` follow the points in its call."""
    weights = {name: weight.detach() for name, weight in network.named_parameters()}
    along = {name: _direction(weight) for name, weight in weights.items()}

    def change(h: Tensor) -> SDF:
        moved = {name: weight + h * along[name] for name, weight in weights.items()}
        return chunked(lambda points: torch.func.functional_call(network, moved, (points, *inputs)), 4096)

    return change


def own_changes(field: SDF) -> dict[str, Change]:
    """The weights of a network, code and weights of one shape of a decoder; of other callables nothing is known."""
    if isinstance(field, nn.Module):
        return {"weights": weight_change(field)}
    if isinstance(field, ShapeField) and field.code is not None:
        return decoder_changes(field.decoder, field.code)
    return {}


def in_double(field: SDF) -> SDF:
    """The same field in float64, where it is a network or one shape of a decoder; others as they are."""
    if isinstance(field, nn.Module):
        return deepcopy(field).double().requires_grad_(False)
    if isinstance(field, ShapeField) and field.code is not None:
        return in_double(field.decoder).field(field.code.detach().double())
    return field


def _posed(sdf: SDF, camera: Camera, generator: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return sdf, replace(camera, T_world_camera=camera.T_world_camera @ torch.linalg.matrix_exp(h * generator))


def _seen(sdf: SDF, camera: Camera, change: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return sdf, replace(camera, intrinsics=camera.intrinsics + h * change)


def _put(sdf: SDF, camera: Camera, generator: Tensor, h: Tensor) -> tuple[SDF, Camera]:
    return placed(sdf, torch.linalg.matrix_exp(h * generator)), camera


def _turns(like: Tensor) -> dict[str, Tensor]:
    """Generators of rotations: e × ·."""
    turns = {}
    for k, axis in enumerate(AXES):
        turns[axis] = like.new_zeros(4, 4)
        turns[axis][(k + 2) % 3, (k + 1) % 3], turns[axis][(k + 1) % 3, (k + 2) % 3] = 1, -1
    return turns


def _shifts(like: Tensor) -> dict[str, Tensor]:
    return {axis: torch.outer(_unit(like, 4, k), _unit(like, 4, 3)) for k, axis in enumerate(AXES)}


def _unit(like: Tensor, length: int, k: int) -> Tensor:
    return torch.eye(length, dtype=like.dtype, device=like.device)[k]


def _direction(like: Tensor) -> Tensor:
    """A random one, the same each time, as long as what it changes; of length 1 where that is zero."""
    direction = torch.randn(like.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(like)
    return direction / direction.norm() * (like.norm() if like.any() else 1.0)
