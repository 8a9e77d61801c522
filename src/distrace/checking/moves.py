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
from torch.nn.functional import pad

from distrace.camera import Camera
from distrace.fields.base import SDF, Counted, chunked, placed
from distrace.fields.decoder import Decoder, ShapeField

Change = Callable[[Tensor], SDF]
Move = Callable[[Tensor], tuple[SDF, Camera]]
Moves = dict[str, dict[str, Move]]  # by parameter, and by its components


def all_moves(sdf: SDF, camera: Camera, changes: Mapping[str, Change]) -> Moves:
    """Returns the moves of the camera, of the similarity that places the shape, and of the field's own parameters.

    The camera moves along its own axes.
    """
    intrinsics = camera.intrinsics
    pose = camera.T_world_camera
    rotations, translations = _generators(intrinsics)
    zoom = torch.diag(intrinsics.diagonal() * intrinsics.new_tensor([1.0, 1.0, 0.0]))
    shifts = {axis: camera.width * translations[axis][:3, 1:] for axis in "xy"}
    similarities = {f"rotation {axis}": generator for axis, generator in rotations.items()}
    similarities |= {f"translation {axis}": generator for axis, generator in translations.items()}
    similarities["scale"] = torch.diag(intrinsics.new_tensor([1.0, 1.0, 1.0, 0.0]))

    def moved(generator: Tensor) -> Move:
        return lambda h: (sdf, replace(camera, T_world_camera=pose @ torch.linalg.matrix_exp(h * generator)))

    def refocused(change: Tensor) -> Move:
        return lambda h: (sdf, replace(camera, intrinsics=intrinsics + h * change))

    def displaced(generator: Tensor) -> Move:
        return lambda h: (placed(sdf, torch.linalg.matrix_exp(h * generator)), camera)

    def changed(change: Change) -> Move:
        return lambda h: (change(h), camera)

    return {
        "camera rotation": {axis: moved(generator) for axis, generator in rotations.items()},
        "camera translation": {axis: moved(generator) for axis, generator in translations.items()},
        "focal length": {"": refocused(zoom)},
        "principal point": {axis: refocused(shift) for axis, shift in shifts.items()},
        "placement": {name: displaced(generator) for name, generator in similarities.items()},
        **{name: {"": changed(change)} for name, change in changes.items()},
    }


def counted_moves(sdf: Counted, camera: Camera, changes: Mapping[str, Change]) -> Moves:
    """Returns the moves of a counted field, whose changed forms count there, too."""
    return all_moves(sdf, camera, {name: partial(_counted, sdf, change) for name, change in changes.items()})


def _counted(sdf: Counted, change: Change, h: Tensor) -> SDF:
    return sdf.counting(change(h))


def _generators(like: Tensor) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Returns the 4 × 4 generators of rotations about the axes, e × ·, and of translations along them."""
    units = torch.eye(3, dtype=like.dtype, device=like.device)
    crossed = [torch.linalg.cross(unit.expand(3, 3), units).T for unit in units]
    rotations = {axis: pad(matrix, (0, 1, 0, 1)) for axis, matrix in zip("xyz", crossed)}
    translations = {axis: pad(unit[:, None], (3, 0, 0, 1)) for axis, unit in zip("xyz", units)}
    return rotations, translations


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


def _direction(like: Tensor) -> Tensor:
    """Returns a random direction, the same each time, with the norm of `like`, or norm 1 where that is zero."""
    direction = torch.randn(like.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(like)
    return direction / direction.norm() * (like.norm() if like.any() else 1.0)
