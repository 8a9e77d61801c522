"""Depths by planes swept through the unit sphere, and hollows that no outline shows."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.field import SDF
from distrace.photographs.hull import carved_hull, visual_hull
from distrace.photographs.sweep import OFF, seen_through, swept
from distrace.primitives import difference, sphere
from distrace.reconstruction.reconstruct import ReconstructConfig, Reconstruction, begin_with_hull
from distrace.reconstruction.surface_network import SurfaceSpecs
from distrace.render import render

BOWL = difference(sphere(0.8), sphere(0.55, torch.tensor([0.0, 0.0, 0.6])))  # hollow to z = 0.05


def painted(points: Tensor) -> Tensor:
    """Waves in all directions, none longer than a window."""
    waves = torch.sin(points @ torch.tensor([[31.0, 7, -5], [-9, 27, 11], [13, -17, 25]]))
    return 0.5 + 0.16 * waves.sum(-1, keepdim=True).expand(*points.shape[:-1], 3)


def photographed(sdf: SDF, cameras: list[Camera]) -> list[Photograph]:
    found = []
    for number, camera in enumerate(cameras):
        with torch.no_grad():
            buffers = render(sdf, camera)
        points = camera.rays().at(buffers.depth / camera.cosines())
        image = torch.where(buffers.mask[..., None], painted(points), 0.0)
        found.append(Photograph(f"{number:02}", camera, image, buffers.mask))
    return found


@pytest.fixture(scope="module")
def bowl() -> list[Photograph]:
    """Seen from its open side by nine cameras."""
    places = [(azimuth, elevation) for azimuth in (-25, 0, 25) for elevation in (-25, 0, 25)]
    return photographed(BOWL, [Camera.orbit(*place, 3.0, height=120, width=120, focal_px=160.0) for place in places])


@pytest.mark.usefixtures("unchecked")
def test_depths_that_are_sure_are_right(bowl: list[Photograph]) -> None:
    for depths, view in zip(swept(bowl), bowl, strict=True):
        with torch.no_grad():
            true = render(BOWL, view.camera).depth
        assert depths.sure.sum() > 0.3 * view.known_mask.sum()
        assert not depths.sure[~view.known_mask].any()
        off = (depths.depth - true)[depths.sure].abs()
        assert off.median() < 0.015
        assert (off < OFF).float().mean() > 0.8  # of the rest windows reach across an edge


def test_a_hollow_is_carved_that_no_outline_shows(bowl: list[Photograph]) -> None:
    steps = torch.linspace(-0.95, 0.95, 40)
    places = torch.cartesian_prod(steps, steps, steps)
    true = BOWL(places)
    hollow = (sphere(0.45, torch.tensor([0.0, 0.0, 0.6]))(places) < 0) & (sphere(0.75)(places) < 0)
    hull, carved = visual_hull(bowl), carved_hull(bowl)
    assert (hull(places[hollow]) < 0).float().mean() > 0.9
    assert (carved(places[hollow]) > 0).float().mean() > 0.9
    assert (carved(places[true < -0.05]) < 0).float().mean() > 0.99, "what is there stays"


@pytest.mark.usefixtures("unchecked")
def test_a_network_begins_with_a_hollow_where_that_is_asked_for(bowl: list[Photograph]) -> None:
    specs, hollow = SurfaceSpecs(width=32, layers=2, frequencies=3, features=4), torch.tensor([[0.0, 0.0, 0.5]])
    found = []
    for carved in (False, True):
        config = ReconstructConfig(hull_steps=300, rays=256, learning_rate=5e-3, carved=carved)
        state = Reconstruction.fresh(specs, config, len(bowl), torch.device("cpu"))
        begin_with_hull(state, bowl, config)
        found.append(state.surface(hollow).item())
    filled, open_ = found
    assert filled < -0.05
    assert open_ > 0.05


@pytest.mark.usefixtures("unchecked")
def test_nothing_is_seen_through_where_nothing_tells_depths(bowl: list[Photograph]) -> None:
    plain = [replace(view, image=torch.full_like(view.image, 0.5)) for view in bowl]
    places = 2 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(0)) - 1
    assert not seen_through(plain, places).any()
    assert seen_through(bowl, places).any()
    assert not seen_through(bowl[:1], places).any(), "one view has no other to be compared with"
