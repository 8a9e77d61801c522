"""What the viewer shows: a field, and what is known of where it comes from."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF, check_field, placed
from distrace.pose import Similarity

Progress = Callable[[int, int], None]
"""Takes the number of iterations that are done, and of all."""

Refit = Callable[[Float[Tensor, "length"], Progress], tuple[Float[Tensor, "length"], str]]
"""From the code that is shown to the code that a fit from there ends at, and the verdict on it."""


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
    place: Similarity = field(default_factory=Similarity.identity)  # of the object in the world of its files
    device: torch.device = torch.device("cpu")
    source: str | None = None  # of the model: its bundled name, or its folder


def model_scene(model: Model, code: Float[Tensor, "length"], title: str, source: str | None = None) -> Scene:
    """Returns the scene of a model's shape."""
    return Scene(title, model.field(code), model, code, device=code.device, source=source)


def field_scene(sdf: SDF | Model, radius: float = 1.0, device: torch.device | str = "cpu") -> Scene:
    """Returns the scene of any field, or of a model's first shape.

    Raises `TypeError` for what is no field, and `ValueError` for a radius that is not positive and finite.
    """
    if isinstance(sdf, Model):
        return model_scene(sdf, sdf.codes[0], f"{sdf.name}, {sdf.shapes[0]}")
    check_field(sdf)
    if not 0 < radius < math.inf:
        raise ValueError(f"a radius of {radius} was given; the field lies in a sphere of positive, finite radius")
    title = getattr(sdf, "__name__", type(sdf).__name__)
    place = replace(Similarity.identity(), scale=torch.tensor(radius))
    unit = sdf if radius == 1 else placed(sdf, torch.diag(torch.tensor([1 / radius] * 3 + [1.0])).to(device))
    return Scene(title, unit, place=place, device=torch.device(device))
