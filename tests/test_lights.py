"""Lights shade as their formulas say, and their derivatives agree with finite differences."""

import math

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.colour_space import to_linear, to_srgb
from distrace.fields import primitives
from distrace.lights import Ambient, Directional, Light, Point, SphericalHarmonics, harmonics, lit, white_in_harmonics
from distrace.render import Buffers, render


def directions(count: int) -> Tensor:
    """Returns unit vectors, evenly spread (a Fibonacci lattice)."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * k / count
    angle = k * math.pi * (3 - math.sqrt(5))
    across = (1 - z.square()).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), z], dim=1)


def ball(dtype: torch.dtype = torch.float64) -> Buffers:
    camera = Camera.orbit(20, 30, 4, height=9, width=9, dtype=dtype)
    return render(primitives.sphere(0.6), camera)


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    basis = harmonics(directions(20_000))
    gram = 4 * math.pi * basis.T @ basis / len(basis)
    assert torch.allclose(gram, torch.eye(9, dtype=torch.float64), atol=1e-3)


def test_a_white_surface_gathers_the_light_of_its_hemisphere() -> None:
    around = directions(20_000)
    coefficients = torch.randn(9, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    radiance = harmonics(around) @ coefficients
    normals = directions(7)
    cosines = (normals @ around.T).clamp_min(0)
    gathered = 4 * cosines @ radiance / len(around)  # ∫ radiance · cosine / π
    assert torch.allclose(white_in_harmonics(normals) @ coefficients, gathered, atol=2e-3)


def test_a_distant_point_is_a_directional_light() -> None:
    points = directions(5) * 0.5
    normals = directions(5)
    towards = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    colour = torch.tensor([0.2, 0.5, 1.0], dtype=torch.float64)
    distance = 1e5
    far = Point(distance * normalize(towards, dim=0), distance**2 * colour)
    assert torch.allclose(far(points, normals), Directional(towards, colour)(points, normals), atol=1e-4)


def test_a_point_light_falls_with_the_square_of_its_distance() -> None:
    light = Point(torch.tensor([0.0, 2.0, 0.0]), torch.ones(3))
    up = torch.tensor([[0.0, 1.0, 0.0]])
    assert light(torch.zeros(1, 3), up).allclose(torch.full((1, 3), 0.25))
    assert light(torch.zeros(1, 3), -up).equal(torch.zeros(1, 3))


@pytest.mark.parametrize("kind", ["ambient", "directional", "point", "harmonics", "albedo"])
def test_derivatives_of_a_lit_image_agree_with_finite_differences(kind: str) -> None:
    random = torch.Generator().manual_seed(3)
    buffers = ball()

    def image(values: Tensor) -> Tensor:
        of_kind: dict[str, Light] = {
            "ambient": Ambient(values[:3]),
            "directional": Directional(values[:3], values[3:6]),
            "point": Point(3 * values[:3], values[3:6]),
            "harmonics": SphericalHarmonics(values[:27].reshape(9, 3)),
        }
        light = of_kind.get(kind, Ambient(values.new_ones(3)))
        albedo = values[:3] if kind == "albedo" else values.new_tensor([0.7, 0.4, 0.2])
        return shade(buffers, lit(albedo, [light]), values.new_zeros(3))

    values = 0.5 + torch.rand(27, generator=random, dtype=torch.float64)
    values.requires_grad_()
    assert torch.autograd.gradcheck(image, (values,), atol=1e-6)


def test_lights_add_up() -> None:
    buffers = ball(torch.float32)
    first = Ambient(torch.full((3,), 0.2))
    second = Directional(torch.tensor([0.0, 1.0, 1.0]), torch.full((3,), 0.5))
    background = torch.zeros(3)
    white = torch.ones(3)
    both = shade(buffers, lit(white, [first, second]), background)
    apart = shade(buffers, lit(white, [first]), background) + shade(buffers, lit(white, [second]), background)
    assert torch.allclose(both, apart, atol=1e-6)


def test_no_light_is_refused() -> None:
    with pytest.raises(ValueError, match="no light was given"):
        lit(torch.ones(3), [])


def test_srgb_and_linear_are_inverse() -> None:
    values = torch.linspace(0, 1, 101, dtype=torch.float64)
    assert torch.allclose(to_linear(to_srgb(values)), values, atol=1e-6)
    assert to_srgb(values).diff().min() > 0
