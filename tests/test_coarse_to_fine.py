"""Coarse-to-fine starts."""

from dataclasses import replace

import pytest
import torch

from distrace.camera import Camera
from distrace.fields import primitives
from distrace.rays import meet_sphere
from distrace.render import render
from distrace.tracing import coarse_to_fine as pyramid
from distrace.tracing.sphere_tracing import COARSE_TO_FINE

f64 = torch.float64
sphere = primitives.sphere(0.5)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (3, 7), (5, 4), (17, 30)])
@pytest.mark.parametrize("levels", [1, 2, 4])
def test_images_of_any_size_have_a_start_for_every_pixel(height: int, width: int, levels: int) -> None:
    camera = Camera.orbit(30, 20, 4.97, height=height, width=width, focal_px=2 * width)
    start, _ = pyramid.starts(sphere, camera, 1.0, replace(COARSE_TO_FINE, coarse_levels=levels))
    assert start.shape == (height, width)
    assert not start.isnan().any()


@pytest.mark.parametrize("levels", [1, 2, 3])
@pytest.mark.parametrize("size", [12, 24, 33, 64])
def test_every_ray_that_hits_a_sphere_hits_it_from_its_start(size: int, levels: int) -> None:
    camera = Camera.orbit(30, 20, 4.97, height=size, width=size, dtype=f64)
    seen = render(sphere, camera, config=replace(COARSE_TO_FINE, coarse_levels=levels, steps=100))
    assert (seen.mask == meet_sphere(camera.rays(), 0.5).meets).all()


def test_a_start_is_where_its_coarse_ray_stood_less_half_its_pixel() -> None:
    """With one level and one step: 1.5 · 0.1 beyond the near bound, the same for the four pixels of each."""
    camera = Camera.orbit(30, 20, 4.97, height=32, width=32, dtype=f64)
    config = replace(COARSE_TO_FINE, coarse_levels=1, coarse_steps=1)
    start, evaluations = pyramid.starts(sphere, camera, 1.0, config)
    coarse = camera.resized(0.5)
    bounds = meet_sphere(coarse.rays())
    half_diagonal = 2**0.5 * coarse.tolerance(1.0) * bounds.far
    assert half_diagonal[bounds.meets].max() < 0.2
    stood = torch.where(bounds.near + 0.15 < bounds.far, bounds.near + 0.15 - half_diagonal, -torch.inf)
    assert evaluations == bounds.meets.sum()
    torch.testing.assert_close(start, stood.repeat_interleave(2, 0).repeat_interleave(2, 1))


def test_coarse_rays_are_counted_apart() -> None:
    camera = Camera.orbit(30, 20, 4.97, height=32, width=32)
    _, evaluations = pyramid.starts(sphere, camera, 1.0, COARSE_TO_FINE)
    assert render(sphere, camera, config=COARSE_TO_FINE).trace.setup_evaluations == evaluations
    assert evaluations <= 3 * (16 * 16 + 8 * 8)
