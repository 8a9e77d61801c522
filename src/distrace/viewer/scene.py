"""What the viewer shows: a field, and what is known of where it comes from."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF, check_field

Progress = Callable[[int, int], None]
"""Takes the number of iterations that are done, and of all."""

Refit = Callable[[Float[Tensor, "length"], Progress], Float[Tensor, "length"]]
"""From the code that is shown to the code that a fit from there ends at."""


@dataclass(frozen=True)
class Scene:
    """A shape in the unit sphere, y up; points and cameras of its observation are in the same frame."""

    title: str
    sdf: SDF
    model: Model | None = None
    code: Float[Tensor, "length"] | None = None
    points: Float[Tensor, "n 3"] | None = None
    cameras: Sequence[Camera] = ()
    refit: Refit | None = None
    radius: float = 1.0  # of the sphere that holds the surface

    @property
    def device(self) -> torch.device:
        return torch.device("cpu") if self.code is None else self.code.device


def model_scene(model: Model, code: Float[Tensor, "length"], title: str) -> Scene:
    """Returns the scene of a model's shape."""
    return Scene(title, model.field(code), model, code)


def field_scene(sdf: SDF | Model, radius: float = 1.0) -> Scene:
    """Returns the scene of any field, or of a model's first shape. Raises `TypeError` for what is no field."""
    if isinstance(sdf, Model):
        return model_scene(sdf, sdf.codes[0], f"{sdf.name}, {sdf.shapes[0]}")
    check_field(sdf)
    return Scene(getattr(sdf, "__name__", type(sdf).__name__), sdf, radius=radius)
