"""Images whose gradient knows of outlines: against closed forms, and differences of images seen more finely."""

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.fields import primitives
from distrace.fields.base import SDF, Counted
from distrace.render import Buffers, render, render_rays
from distrace.tracing.sphere_tracing import TraceConfig

f64 = torch.float64
WHITE = torch.ones(1, dtype=f64)
MARCH = TraceConfig(step_scale=1.0, tolerance=1e-5, coarse_levels=0)
DISTANCE, FOCAL = 4.97, 60 / 32  # in widths of the image
LIGHT = normalize(torch.tensor([0.2, 0.4, 1.0], dtype=f64), dim=0)


def view(size: int, focal: Tensor | float = FOCAL, azimuth: float = 0.0) -> Camera:
    """A camera at the z axis, and its focal length."""
    scale = torch.ones(3, 3, dtype=f64)
    scale[0, 0], scale[1, 1] = (torch.as_tensor(focal) / FOCAL,) * 2
    camera = Camera.orbit(azimuth, 0, DISTANCE, height=size, width=size, dtype=f64)
    return Camera(camera.intrinsics * scale, camera.T_world_camera, size, size)


def seen(sdf: SDF, camera: Camera) -> Buffers:
    return render(sdf, camera, config=MARCH)


def black(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    return torch.zeros_like(points[:, :1])


def lambert(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    return (normals @ LIGHT).clamp_min(0)[:, None]


def pieces(points: Tensor, normals: Tensor, directions: Tensor) -> Tensor:
    """One colour of what is near the camera, another of what is behind."""
    return torch.where(points[:, 2:] > 0.44, 0.2, 0.7).to(points)


def ramp(size: int) -> Tensor:
    """Weights that grow to the right and a little downward."""
    x = (torch.arange(size, dtype=f64) + 0.5) / size
    return (3 * x[None, :] ** 2 + 0.7 * x[:, None])[..., None]


def derivative(function: Callable[[Tensor], Tensor], at: float) -> float:
    x = torch.tensor(at, dtype=f64, requires_grad=True)
    return torch.autograd.grad(function(x), x)[0].item()


@torch.no_grad()
def difference(function: Callable[[Tensor], Tensor], at: float, step: float) -> float:
    return (function(torch.tensor(at + step, dtype=f64)) - function(torch.tensor(at - step, dtype=f64))).item() / (
        2 * step
    )


def disk(radius: Tensor, focal: Tensor | float = FOCAL) -> Tensor:
    """The area of a sphere's image, in areas of the image."""
    return math.pi * focal**2 * radius**2 / (DISTANCE**2 - radius**2)


@pytest.mark.parametrize(("size", "radius"), [(24, 0.5), (32, 0.25), (48, 0.8), (96, 0.5)])
@pytest.mark.parametrize("scale", [1.0, 2.0])
def test_the_mean_of_a_black_sphere_on_white_falls_as_its_disk_grows(size: int, radius: float, scale: float) -> None:
    """Also of a field that is twice the distance. The hits themselves say nothing of it."""

    def mean(r: Tensor) -> Tensor:
        ball = primitives.sphere(r)
        return shade(seen(lambda points: scale * ball(points), view(size)), black, WHITE).mean()

    closed = derivative(lambda r: 1 - disk(r), radius)
    assert derivative(mean, radius) == pytest.approx(closed, rel=0.01)


def test_the_outline_moves_with_the_focal_length() -> None:
    mean = lambda focal: shade(seen(primitives.sphere(0.5), view(40, focal)), black, WHITE).mean()  # noqa: E731
    closed = derivative(lambda focal: 1 - disk(torch.tensor(0.5), focal), FOCAL)
    assert derivative(mean, FOCAL) == pytest.approx(closed, rel=0.01)


def moved(x: Tensor, size: int) -> Tensor:
    centre = torch.stack([x, *torch.tensor([0.03, 0.01], dtype=f64)])
    return shade(seen(primitives.sphere(0.5, centre), view(size)), black, WHITE)


def turned(angle: Tensor, size: int) -> Tensor:
    camera = view(size)
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    turn = torch.stack([angle.cos(), zero, angle.sin(), zero, one, zero, -angle.sin(), zero, angle.cos()])
    pose = torch.cat([turn.reshape(3, 3) @ camera.T_world_camera[:3, :3], camera.T_world_camera[:3, 3:]], dim=1)
    camera = Camera(camera.intrinsics, torch.cat([pose, camera.T_world_camera[3:]]), size, size)
    return shade(seen(primitives.sphere(0.5), camera), black, WHITE)


def before_a_ball(width: Tensor, size: int) -> Tensor:
    """A tilted box that hides a part of a sphere, and nothing beside it."""
    half = torch.stack([width, *torch.tensor([0.3, 0.1], dtype=f64)])
    middle, tilt = torch.tensor([0.02, 0.01, 0.55], dtype=f64), torch.tensor([[0.8, 0.6], [-0.6, 0.8]], dtype=f64)
    turn = torch.block_diag(tilt, torch.eye(1, dtype=f64))
    box = primitives.box(half)
    sdf = primitives.union(primitives.sphere(0.6, -middle / 2), lambda points: box((points - middle) @ turn))
    return shade(seen(sdf, view(size)), pieces, WHITE)


@pytest.mark.parametrize(
    ("image", "at", "step"),
    [(moved, 0.05, 0.01), (turned, 0.01, 0.003), (before_a_ball, 0.2, 0.02)],
    ids=["translation", "rotation of the camera", "a box before a sphere"],
)
def test_the_gradient_agrees_with_differences_of_a_finer_image(image, at: float, step: float) -> None:
    size = 56
    mean = lambda fineness: lambda x: (image(x, fineness) * ramp(fineness)).mean()  # noqa: E731
    expected = difference(mean(256), at, step)
    assert abs(expected) > 0.05
    assert derivative(mean(size), at) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("at", [0.3, 0.31, 0.33])
def test_an_outline_moves_the_pixel_more_whose_centre_is_nearer(at: float) -> None:
    """The straight edge of a box: each of its two pixels changes by its tent, one pixel to either side."""
    width, front, size = torch.tensor(at, dtype=f64, requires_grad=True), 0.1, 16
    half = torch.stack([width, *torch.tensor([0.5, front], dtype=f64)])
    row = shade(seen(primitives.box(half), view(size)), black, WHITE)[size // 2, :, 0]
    scale = size * FOCAL / (DISTANCE - front)
    edge = size / 2 + scale * at
    found = torch.stack([torch.autograd.grad(row[x], width, retain_graph=True)[0] for x in range(size // 2, size)])
    centres = torch.arange(size // 2, size, dtype=f64) + 0.5
    torch.testing.assert_close(found, -scale * (1 - (centres - edge).abs()).clamp_min(0), rtol=0, atol=0.02 * scale)


@pytest.mark.slow
def test_of_a_shaded_sphere_hits_and_outline_together_make_the_derivative() -> None:
    """By the closed form of a distant disk's mean: r² · a constant. Hits near a round outline need some averaging."""

    def mean(r: Tensor) -> Tensor:
        camera, total = view(48), torch.zeros((), dtype=f64)
        for x in range(3):
            for y in range(3):
                shifted = camera.intrinsics.clone()
                shifted[:2, 2] += torch.tensor([x + 0.1 * y, y + 0.1 * x], dtype=f64) / 3
                total = (
                    total
                    + shade(
                        seen(primitives.sphere(r), Camera(shifted, camera.T_world_camera, 48, 48)), lambert, WHITE
                    ).mean()
                )
        return total / 9

    with torch.no_grad():
        dark = 1 - mean(torch.tensor(0.5, dtype=f64)).item()
    closed = -dark * derivative(disk, 0.5) / disk(torch.tensor(0.5)).item()
    assert derivative(mean, 0.5) == pytest.approx(closed, rel=0.05)


@pytest.mark.slow
def test_a_network_moves_its_outline_with_its_code() -> None:
    model = load_model("sofas")
    code, direction = model.codes[0], normalize(model.codes[3] - model.codes[0], dim=0)

    def mean(step: Tensor, size: int) -> Tensor:
        camera = Camera.orbit(30, 20, DISTANCE, height=size, width=size)
        image = shade(render(model.field(code + step.float() * direction), camera), black, WHITE.float())
        return (image * ramp(size)).mean()

    expected = difference(lambda step: mean(step, 384), 0.0, 0.05)  # whole pixels change: noisy in small images
    assert derivative(lambda step: mean(step, 192), 0.0) == pytest.approx(expected, rel=0.05)


def test_values_are_those_at_the_centres_of_pixels() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    buffers = seen(primitives.sphere(radius), view(24))
    image = shade(buffers, lambert, WHITE)
    lit = (buffers.normal @ LIGHT).clamp_min(0)
    assert (image[..., 0] == torch.where(buffers.mask, lit, 1.0)).all()


def test_an_outline_between_equal_colours_changes_nothing() -> None:
    centre = torch.tensor([0.1, 0, 0], dtype=f64, requires_grad=True)
    white = lambda points, normals, directions: torch.ones_like(points[:, :1])  # noqa: E731
    image = shade(seen(primitives.sphere(0.5, centre), view(24)), white, WHITE)
    image.square().sum().backward()
    assert centre.grad is not None
    assert (centre.grad == 0).all()


def test_without_gradients_outlines_cost_nothing() -> None:
    counted = Counted(primitives.sphere(torch.tensor(0.5, dtype=f64, requires_grad=True)))
    with torch.no_grad():
        buffers = seen(counted, view(24))
        assert buffers.normal.any()
        before = counted.evaluations
        assert not shade(buffers, black, WHITE).requires_grad
    assert counted.evaluations == before
    constant = Counted(primitives.sphere(0.5))
    buffers = seen(constant, view(24))
    assert buffers.normal.any()
    before = constant.evaluations
    shade(buffers, black, WHITE)
    assert constant.evaluations == before


def test_outlines_cost_as_much_as_they_are_long() -> None:
    costs = []
    for size in (32, 128):
        counted = Counted(primitives.sphere(torch.tensor(0.5, dtype=f64, requires_grad=True)))
        buffers = seen(counted, view(size))
        assert buffers.normal.any()
        before = counted.evaluations
        shade(buffers, black, WHITE)
        costs.append(counted.evaluations - before)
    assert costs[1] < 8 * costs[0]


def test_a_batch_of_views_has_the_gradient_of_each() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    views = [view(16), view(16, azimuth=40)]
    both = Camera(
        *(torch.stack([getattr(v, name) for v in views]) for name in ("intrinsics", "T_world_camera")), 16, 16
    )
    centre = torch.tensor([0.1, 0.05, 0], dtype=f64)
    means = [shade(seen(primitives.sphere(radius, centre), v), black, WHITE).mean() for v in (both, *views)]
    gradients = [torch.autograd.grad(mean, radius)[0].item() for mean in means]
    assert gradients[0] == pytest.approx(sum(gradients[1:]) / 2, rel=1e-9)


def test_a_view_of_nothing_is_background_and_has_a_gradient() -> None:
    radius = torch.tensor(0.5, dtype=f64, requires_grad=True)
    away = primitives.sphere(radius, torch.tensor([0, 9.0, 0], dtype=f64))
    background = WHITE.clone().requires_grad_()
    image = shade(seen(away, view(8)), black, background)
    assert (image == 1).all()
    (by_background,) = torch.autograd.grad(image.sum(), background)
    assert by_background.item() == 64


def test_rays_without_neighbours_are_refused() -> None:
    buffers = render_rays(primitives.sphere(0.5), view(8), torch.tensor([[4.0, 4.0]], dtype=f64))
    with pytest.raises(ValueError, match=r"\[1\]"):
        shade(buffers, black, WHITE)


@pytest.mark.slow
def test_a_sphere_finds_its_place_from_an_image_alone() -> None:
    """It overlaps the target in part: one side of its outline has to come in, the other to go out."""
    camera = view(24)
    with torch.no_grad():
        target = shade(seen(primitives.sphere(0.45, torch.tensor([0.25, -0.1, 0], dtype=f64)), camera), black, WHITE)
    place = torch.tensor([-0.15, 0.15, 0.3], dtype=f64, requires_grad=True)
    adam = torch.optim.Adam([place], lr=0.04)
    for i in range(40):
        adam.param_groups[0]["lr"] = 0.04 * (1 - i / 40)
        centre = torch.cat([place[:2], torch.zeros(1, dtype=f64)])
        image = shade(seen(primitives.sphere(place[2], centre), camera), black, WHITE)
        adam.zero_grad()
        (image - target).square().mean().backward()
        adam.step()
    torch.testing.assert_close(place.detach(), torch.tensor([0.25, -0.1, 0.45], dtype=f64), rtol=0, atol=0.03)
