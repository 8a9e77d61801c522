"""Gradients of outlines, ours and Mitsuba's, against central differences of each renderer's own images.

A black sphere or cube on white: only its outline has a derivative. The loss is a weighted mean of the image, so that
every parameter changes it.
"""

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.fields.base import SDF
from distrace.fields.primitives import box, sphere
from distrace.render import render
from distrace.tracing.sphere_tracing import TraceConfig
from experiments.clips.mitsuba_scene import mitsuba, sensor

PARAMETERS = ("position x", "position y", "size")
START = (0.1, -0.05, 0.35)  # x, y, and the radius or half the edge: all of it is in the image
STEP = 0.05  # of central differences: pixels at outlines are black or white, so many must change
FINER = 8  # of each pixel, in the differences' images: pixel centres alone would move by jumps
SAMPLES = 128  # of each of Mitsuba's pixels, and as many of outlines
GRID = 64  # values along each side of Mitsuba's `sdfgrid`
SHAPES = ("sphere", "cube")
METHODS = ("distrace", "Mitsuba, mesh", "Mitsuba, sdfgrid")
BLACK = {"type": "diffuse", "reflectance": 0.0}
COUNT = len(SHAPES) * len(METHODS) * len(PARAMETERS)


@dataclass(frozen=True)
class BoundaryRow:
    """The derivative of the weighted mean of an image by a parameter of its shape."""

    field: str
    parameter: str
    method: str
    relative_error: float  # of the derivative, from the difference
    derivative: float
    difference: float


Loss = Callable[[Float[Tensor, "3"]], float]


def field_of(shape: str, values: Float[Tensor, "3"]) -> SDF:
    """Returns the sphere or the cube of a position and a size."""
    centre = torch.cat([values[:2], values.new_zeros(1)])
    size = values[2]
    return sphere(size, centre) if shape == "sphere" else lambda points: box(size.expand(3))(points - centre)


def weights_of(camera: Camera) -> Float[Tensor, "height width"]:
    """Returns weights that grow evenly to the right and downward, so that a motion changes the mean."""
    across, down = (camera.pixels() / camera.width).unbind(-1)
    return 2 * across + down


def boundary_rows(camera: Camera, methods: tuple[str, ...] = METHODS) -> Iterator[BoundaryRow]:
    """Yields each shape and parameter by each method. The camera is in float64, and sees the origin in its middle."""
    for shape in SHAPES:
        for method in methods:
            loss, gradient = _ours(shape, camera) if method == "distrace" else _mitsubas(shape, method, camera)
            for number, (parameter, derivative) in enumerate(zip(PARAMETERS, gradient, strict=True)):
                step = torch.zeros(3, dtype=torch.float64)
                step[number] = STEP
                start = torch.tensor(START, dtype=torch.float64)
                difference = (loss(start + step) - loss(start - step)) / (2 * STEP)
                error = abs(derivative - difference) / abs(difference)
                yield BoundaryRow(shape, parameter, method, error, derivative, difference)


def _ours(shape: str, camera: Camera) -> tuple[Loss, list[float]]:
    """Returns the loss of values, from a finer image, and its gradient at the start, from the image itself."""

    def mean(values: Float[Tensor, "3"], camera: Camera) -> Tensor:
        buffers = render(field_of(shape, values), camera, config=TraceConfig())
        white = torch.ones(1, dtype=values.dtype)
        image = shade(buffers, lambda points, normals, directions: torch.zeros_like(points[:, :1]), white)
        return (image[..., 0] * weights_of(camera)).mean()

    values = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    mean(values, camera).backward()
    assert values.grad is not None
    finer = camera.resized(FINER)
    return lambda values: mean(values, finer).item(), values.grad.tolist()


def _mitsubas(shape: str, method: str, camera: Camera) -> tuple[Loss, list[float]]:
    """Returns the same by Mitsuba's `direct_projective`, which samples outlines (Zhang et al., SIGGRAPH 2023)."""
    mi = mitsuba("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # it warns of shapes that leave the image
    drjit: Any = importlib.import_module("drjit")
    gridded = method.endswith("sdfgrid")
    make = partial(_grid, shape) if gridded else partial(_vertices, shape)
    start = torch.tensor(START, dtype=torch.float64, requires_grad=True)
    made = make(start)
    plugin = _gridded(mi, made) if gridded else _meshed(mi, shape)
    light = {"type": "constant"}
    eye = sensor(mi, camera, {"type": "independent"})
    scene = mi.load_dict({"type": "scene", "shape": plugin, "light": light, "sensor": eye})
    parameters = mi.traverse(scene)
    key = "shape.grid" if gridded else "shape.vertex_positions"
    weights = mi.TensorXf(weights_of(camera).numpy()[..., None].astype(np.float32))
    projective = mi.load_dict({"type": "direct_projective", "sppc": SAMPLES, "sppp": SAMPLES, "sppi": 0})
    plain = mi.load_dict({"type": "direct"})

    def place(values: Tensor) -> Any:
        array = values.detach().numpy().astype(np.float32)
        parameters[key] = mi.TensorXf(array) if gridded else mi.Float(array.ravel())
        return parameters[key]

    def loss(values: Float[Tensor, "3"]) -> float:
        place(make(values))
        parameters.update()
        image = mi.render(scene, integrator=plain, spp=SAMPLES)
        return float(np.mean(np.array(image)[..., :1] * np.array(weights)))

    drjit.enable_grad(place(made))
    parameters.update()
    image = mi.render(scene, parameters, integrator=projective, spp=SAMPLES)
    drjit.backward(drjit.mean(image[..., :1] * weights, axis=None))
    slopes = np.array(drjit.grad(parameters[key]), np.float64)
    made.backward(torch.from_numpy(slopes).reshape(made.shape))
    assert start.grad is not None
    return loss, start.grad.tolist()


def _vertices(shape: str, values: Float[Tensor, "3"]) -> Float[Tensor, "n 3"]:
    unit = torch.from_numpy(np.array(_unit(shape).vertices))
    return unit * values[2] + torch.cat([values[:2], values.new_zeros(1)])


def _unit(shape: str) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(5) if shape == "sphere" else trimesh.creation.box((2, 2, 2))


def _grid(shape: str, values: Float[Tensor, "3"]) -> Float[Tensor, "z y x 1"]:
    """Returns distances at the corners of cells in [-1, 1]³, in Mitsuba's order."""
    line = torch.linspace(-1, 1, GRID, dtype=values.dtype)
    z, y, x = torch.meshgrid(line, line, line, indexing="ij")
    return field_of(shape, values)(torch.stack([x, y, z], dim=-1))[..., None]


def _meshed(mi: Any, shape: str) -> Any:
    unit = _unit(shape)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(BLACK)
    mesh = mi.Mesh(shape, len(unit.vertices), len(unit.faces), props=properties)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.array(unit.vertices, np.float32).ravel())
    parameters["faces"] = mi.UInt32(np.array(unit.faces, np.uint32).ravel())
    parameters.update()
    return mesh


def _gridded(mi: Any, values: Tensor) -> dict[str, Any]:
    to_world = mi.ScalarTransform4f().translate([-1, -1, -1]).scale(2)
    grid = mi.TensorXf(values.detach().numpy().astype(np.float32))
    return {"type": "sdfgrid", "grid": grid, "to_world": to_world, "bsdf": BLACK}
