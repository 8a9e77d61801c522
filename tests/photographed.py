"""Small folders of photographs for tests: cameras around an object, in a world of its own, and what they saw."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from distrace.boundary import shade
from distrace.camera import Camera
from distrace.data.photographs import Photograph, UnitSphere, load_photographs
from distrace.fields.primitives import sphere
from distrace.rays import meet_sphere
from distrace.render import render
from distrace.tracing.sphere_tracing import TraceConfig

EXACT = TraceConfig(coarse_levels=0, tolerance=1e-5, steps=200)  # of few pixels several times as fast as `fast`
WORLD = UnitSphere(torch.tensor([2.0, -3.0, 40.0], dtype=torch.float64), 5.0)
POINT = torch.tensor([0.2, -0.1, 0.3], dtype=torch.float64)  # in the unit sphere
SIZES = ((24, 32), (20, 30), (24, 32), (27, 22))


def cameras() -> list[Camera]:
    """Four different ones in the frame of the unit sphere; the principal points are off the middles."""
    found = []
    for k, (height, width) in enumerate(SIZES):
        camera = Camera.orbit(80 * k, 25 * k - 30, 3 + 0.2 * k, height=height, width=width, dtype=torch.float64)
        intrinsics = torch.tensor([[30.0 + k, 0, width / 2 + 1], [0, 31 + k, height / 2 - 0.5], [0, 0, 1]]).double()
        found.append(Camera.from_matrices(intrinsics, camera.T_world_camera, height, width))
    return found


def in_world() -> list[Camera]:
    return [WORLD.camera_to_world(camera) for camera in cameras()]


def colours(camera: Camera, seed: int = 0) -> np.ndarray:
    """Noise in levels of 255."""
    return np.random.default_rng(seed).integers(0, 255, (camera.height, camera.width, 3), np.uint8)


def ball(camera: Camera, radius: float = 0.5) -> Tensor:
    """The mask of a ball about the unit sphere's centre."""
    return meet_sphere(camera.rays(), radius).near.isfinite()


def photographs(masks: bool = True) -> list[Photograph]:
    views = []
    for k, camera in enumerate(cameras()):
        image = torch.from_numpy(colours(camera, k).astype(np.float32) / 255)
        views.append(Photograph(f"view{k}", camera, image, ball(camera) if masks else None))
    return views


def stripes(points: Tensor) -> Tensor:
    waves = (points @ torch.tensor([[19.0, 4, 2], [2, 16, 6], [4, 2, 14]]).to(points)).sin()
    return 0.5 + 0.4 * waves


@torch.no_grad()
def striped_ball(cameras: Sequence[Camera], finer: float = 1.0) -> list[Photograph]:
    """A ball of radius 0.5, painted, and its masks."""
    found = []
    for number, camera in enumerate(cameras):
        buffers = render(sphere(0.5), camera, config=EXACT)
        image = shade(buffers, lambda points, *_: stripes(finer * points), torch.zeros(3))
        found.append(Photograph(f"{number:02}", camera, image, buffers.mask))
    return found


def write_images(folder: Path, suffix: str = ".png") -> None:
    """view0 to view3 in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, camera in enumerate(cameras()):
        Image.fromarray(colours(camera, k)).save(folder / f"view{k}{suffix}")


def write_masks(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for k, camera in enumerate(cameras()):
        Image.fromarray(ball(camera).numpy()).save(folder / f"view{k}.png")


def reads_back(folder: Path, layout: str, shift: float = 0.0) -> None:
    """The cameras are those that were written, but for a shift in pixels, and see a point where they should."""
    loaded = load_photographs(folder)
    assert loaded.layout == layout
    assert len(loaded.views) == len(SIZES)
    point_world = WORLD.to_world(POINT)
    for k, (view, camera) in enumerate(zip(loaded.views, in_world())):
        assert view.name == f"view{k}"
        assert view.image.shape == (camera.height, camera.width, 3)
        assert (view.camera.height, view.camera.width) == (camera.height, camera.width)
        np.testing.assert_array_equal((view.image * 255).round().byte().numpy(), colours(camera, k))
        expected, depth = camera.project(point_world)
        pixel, unit_depth = view.camera.project(loaded.unit_sphere.to_unit(point_world).float())
        torch.testing.assert_close(pixel.double(), expected + shift, atol=2e-3, rtol=0)
        torch.testing.assert_close(unit_depth.double() * loaded.unit_sphere.radius, depth, atol=1e-3, rtol=0)
        rays, expected_rays = view.camera.rays(camera.pixels().float() + shift), camera.rays()
        torch.testing.assert_close(rays.directions.double(), expected_rays.directions, atol=1e-5, rtol=0)
        origins = loaded.unit_sphere.to_world(rays.origins.double())
        torch.testing.assert_close(origins, expected_rays.origins, atol=1e-4, rtol=0)


def refused(folder: Path, *words: str) -> None:
    """In one sentence, with all these words."""
    with pytest.raises(ValueError) as caught:
        load_photographs(folder)
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == [], message


def cut(path: Path, length: int) -> None:
    path.write_bytes(path.read_bytes()[:length])
