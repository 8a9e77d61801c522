"""Antialiased pictures of a sphere, against pictures with many rays a pixel."""

import numpy as np
import pytest
import torch
from seen_ball import BALL, camera_and_buffers

from distrace import antialiasing
from distrace.antialiasing import Style, smooth_outline
from distrace.camera import Camera
from distrace.render import Buffers, render
from distrace.shading import shaded_picture

camera, seen = camera_and_buffers(24, 20)


def test_the_covered_share_is_that_of_the_disc(camera: Camera, seen: Buffers) -> None:
    shaded, _ = Style(samples=8, background=None).draw(BALL, seen, camera)
    assert shaded.shape == (24, 20, 4)
    fine = camera.resized(32.0)
    with torch.no_grad():
        area = float(render(BALL, fine).mask.sum()) / 32**2
    assert shaded[..., 3].sum() / 255 == pytest.approx(area, rel=0.003)
    assert 20 < ((shaded[..., 3] > 0) & (shaded[..., 3] < 255)).sum() < 100


def test_bands_do_not_show(camera: Camera, seen: Buffers, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Style(samples=2).draw(BALL, seen, camera)
    monkeypatch.setattr(antialiasing, "BAND", 5 * 4 * 20)
    for picture, in_bands in zip(whole, Style(samples=2).draw(BALL, seen, camera)):
        assert picture.shape == in_bands.shape == (24, 20, 3)
        assert np.abs(picture.astype(int) - in_bands).max() <= 1


def test_light_comes_from_where_it_was_put(camera: Camera, seen: Buffers) -> None:
    above, _ = Style(light=np.array([0.0, 1.0, 0.0])).draw(BALL, seen, camera)
    below, _ = Style(light=np.array([0.0, -1.0, 0.0])).draw(BALL, seen, camera)
    assert above[8, 10].sum() > above[16, 10].sum() + 100
    assert above[8, 10].sum() > below[8, 10].sum() + 100


def test_a_smooth_outline_is_nearer_to_many_rays_a_pixel_than_one_ray_is(camera: Camera, seen: Buffers) -> None:
    exact = Style(samples=8).draw(BALL, seen, camera)[0].astype(int)
    once = shaded_picture(seen.normal, seen.mask, seen.rays.directions)
    smooth = smooth_outline(seen, camera)
    assert smooth.shape == once.shape
    assert np.abs(smooth - exact).mean() < 0.5 * np.abs(once - exact).mean()
    centre = seen.mask[10:14, 8:12]
    assert centre.all()
    assert (smooth[10:14, 8:12] == once[10:14, 8:12]).all()


def test_a_picture_of_nothing_has_no_outline() -> None:
    camera = Camera.orbit(0, 0, 4.0, height=8, width=8)
    with torch.no_grad():
        assert (smooth_outline(render(lambda points: points.norm(dim=-1) + 1, camera), camera) == 255).all()
