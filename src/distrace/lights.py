"""Lights whose parameters are differentiable, and matt surfaces in them, as `shade` draws them.

Colours are linear, with red, green and blue. A light says how bright it makes a white matt surface: what a surface
reflects is its albedo times the sum over all lights.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from distrace.boundary import Colour
from distrace.fields.colour import Albedo

HARMONICS = 9  # of the degrees 0, 1 and 2
COSINE_LOBE = (1.0, 2 / 3, 1 / 4)  # of each degree, divided by π: Ramamoorthi and Hanrahan, SIGGRAPH 2001, eq. 8


Light = Callable[[Float[Tensor, "n 3"], Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Maps points and unit normals to how bright a light makes a white matt surface there."""


@dataclass(frozen=True)
class Ambient:
    """The same light from everywhere.

    >>> Ambient(torch.tensor([0.2, 0.2, 0.3]))(torch.zeros(1, 3), torch.tensor([[0.0, 1.0, 0.0]]))
    tensor([[0.2000, 0.2000, 0.3000]])
    """

    colour: Float[Tensor, "3"]

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return self.colour.expand_as(points)


@dataclass(frozen=True)
class Directional:
    """Light from one direction, like the sun's; a surface that faces it has the brightness `colour`."""

    direction: Float[Tensor, "3"]  # to the light, of any length
    colour: Float[Tensor, "3"]

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return (normals @ normalize(self.direction, dim=0)).clamp_min(0)[:, None] * self.colour


@dataclass(frozen=True)
class Point:
    """Light from a point: `colour` at a distance of 1, and less by the square of the distance."""

    position: Float[Tensor, "3"]
    colour: Float[Tensor, "3"]

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        towards = self.position - points
        squared = towards.square().sum(-1, keepdim=True)
        cosine = (normals * towards).sum(-1, keepdim=True).clamp_min(0) / squared.sqrt()
        return cosine / squared * self.colour


@dataclass(frozen=True)
class SphericalHarmonics:
    """Light from all around, by the harmonics of degrees 0 to 2 of its radiance; negative where these are."""

    coefficients: Float[Tensor, "9 3"]  # in the order of `harmonics`

    def __call__(self, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        return white_in_harmonics(normals) @ self.coefficients


def harmonics(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Returns the real spherical harmonics of degrees 0 to 2, orthonormal on the sphere, at unit vectors.

    In the order 1; y, z, x; xy, yz, 3z² − 1, xz, x² − y².
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.ones_like(x), y, z, x, x * y, y * z, 3 * z.square() - 1, x * z, x.square() - y.square()]
    factors = [
        0.5 / math.sqrt(math.pi),
        *[math.sqrt(3 / (4 * math.pi))] * 3,
        *[math.sqrt(15 / (4 * math.pi))] * 2,
        math.sqrt(5 / (16 * math.pi)),
        math.sqrt(15 / (4 * math.pi)),
        math.sqrt(15 / (16 * math.pi)),
    ]
    return torch.stack(basis, dim=-1) * directions.new_tensor(factors)


def white_in_harmonics(normals: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 9"]:
    """Returns how bright each harmonic makes a white matt surface."""
    first, second, third = COSINE_LOBE
    return harmonics(normals) * normals.new_tensor([first, *[second] * 3, *[third] * 5])


def lit(albedo: Albedo | Float[Tensor, "3"], lights: Sequence[Light]) -> Colour:
    """Returns the colour of a matt surface in lights, as `shade` takes it: linear, without shadows.

    Raises `ValueError` without lights.

    >>> from distrace import Camera, primitives, render, shade
    >>> buffers = render(primitives.sphere(0.5), Camera.orbit(0, 0, 4, height=15, width=15))
    >>> sun = Directional(torch.tensor([0.0, 0.0, 1.0]), torch.ones(3))
    >>> shade(buffers, lit(torch.full((3,), 0.5), [sun]), background=torch.zeros(3))[7, 7]
    tensor([0.5000, 0.5000, 0.5000])
    """
    if not lights:
        raise ValueError("no light was given; give at least one, such as lights.Ambient(torch.ones(3))")

    def colour(
        points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        reflected = albedo if isinstance(albedo, Tensor) else albedo(points, normals)
        return reflected * torch.stack([light(points, normals) for light in lights]).sum(0)

    return colour
