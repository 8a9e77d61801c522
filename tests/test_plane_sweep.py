"""Depths by a plane sweep, their consistency between views, and hollows that no outline shows."""

from dataclasses import replace

import pytest
import torch
from photographed import EXACT
from torch import Tensor

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.fields.base import SDF
from distrace.fields.primitives import difference, sphere
from distrace.photos.visual_hull import visual_hull
from distrace.reconstruction.multiview_depth import (
    DEPTH_ERROR,
    NO_DEPTHS,
    ConsistentDepths,
    DepthMap,
    consistent_depth_loss,
    plane_sweep,
)
from distrace.reconstruction.networks import SurfaceSpecs
from distrace.reconstruction.reconstruct import informative_depths, initialise
from distrace.reconstruction.state import ReconstructConfig, Reconstruction
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
            buffers = render(sdf, camera, config=EXACT)
        points = camera.rays().at(buffers.depth / camera.cosines())
        image = torch.where(buffers.mask[..., None], painted(points), 0.0)
        found.append(Photograph(f"{number:02}", camera, image, buffers.mask))
    return found


@pytest.fixture(scope="module")
def bowl() -> list[Photograph]:
    """Seen from its open side by four cameras."""
    places = [(azimuth, elevation) for azimuth in (-12, 12) for elevation in (-12, 12)]
    return photographed(BOWL, [Camera.orbit(*place, 3.0, height=96, width=96, focal_px=128.0) for place in places])


@pytest.fixture(scope="module")
def maps(bowl: list[Photograph]) -> list[DepthMap]:
    return plane_sweep(bowl)


@pytest.fixture(scope="module")
def depths(maps: list[DepthMap]) -> ConsistentDepths:
    return ConsistentDepths.of(maps)


def test_reliable_depths_are_right(bowl: list[Photograph], maps: list[DepthMap]) -> None:
    for found, view in zip(maps, bowl, strict=True):
        assert found.reliable.sum() > 0.3 * view.known_mask.sum()
        assert not found.reliable[~view.known_mask].any()
        off = BOWL(view.camera.rays().at(found.depth / view.camera.cosines())[found.reliable]).abs()
        assert off.median() < 0.015
        assert (off < DEPTH_ERROR).float().mean() > 0.8  # of the rest windows reach across an edge


def test_consistent_depths_lie_on_the_surface(maps: list[DepthMap], depths: ConsistentDepths) -> None:
    sure = sum(int(each.reliable.sum()) for each in maps)
    assert 0.5 * sure < len(depths) < sure
    assert BOWL(depths.rays.at(depths.distance)).abs().quantile(0.9) < DEPTH_ERROR
    assert (depths.rays.at(depths.near).norm(dim=-1) - 1).abs().max() < 1e-5
    shifted = replace(maps[0], depth=maps[0].depth + 0.2)
    assert len(ConsistentDepths.of([shifted, *maps[1:]])) < 0.95 * len(depths), "inconsistent depths are dropped"


def test_the_depth_loss_is_higher_where_a_hollow_is_filled_or_a_part_is_missing(depths: ConsistentDepths) -> None:
    points = depths.sample(2000, torch.Generator().manual_seed(0))
    true = consistent_depth_loss(BOWL(points))
    assert consistent_depth_loss(sphere(0.8)(points)) > 3 * true
    assert consistent_depth_loss(BOWL(points) + 0.1) > 3 * true


@pytest.mark.slow
def test_initialisation_finds_a_hollow_that_no_outline_shows(bowl: list[Photograph], depths: ConsistentDepths) -> None:
    specs = SurfaceSpecs(width=32, layers=2, frequencies=3, features=4)
    hollow = torch.tensor([[0.0, 0.0, 0.5]])
    config = ReconstructConfig(initial_steps=450, rays=256, learning_rate=5e-3)
    hull = visual_hull(bowl)
    found = []
    for some in (NO_DEPTHS, depths):
        state = Reconstruction.fresh(specs, config, len(bowl), torch.device("cpu"))
        initialise(state, hull, config, some)
        assert (state.surface(torch.tensor([[0.0, 0.0, -0.4], [0.65, 0.0, 0.1]])) < 0).all(), "the solid stays"
        found.append(state.surface(hollow).item())
    filled, open_ = found
    assert filled < -0.05
    assert open_ > 0.05


def test_depths_are_used_only_where_they_lie_deep_within_the_hull(
    bowl: list[Photograph], depths: ConsistentDepths, maps: list[DepthMap], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("distrace.photos.visual_hull.CELLS", 80)
    monkeypatch.setattr("distrace.reconstruction.reconstruct.plane_sweep", lambda _: maps)
    assert len(informative_depths(bowl, visual_hull(bowl))) == len(depths)
    assert informative_depths(bowl, BOWL) is NO_DEPTHS
    monkeypatch.setattr("distrace.reconstruction.reconstruct.plane_sweep", lambda _: [])
    assert informative_depths(bowl, sphere(0.8)) is NO_DEPTHS


def test_the_eikonal_term_weighs_more_with_depths() -> None:
    config = ReconstructConfig(eikonal=0.5, eikonal_with_depths=4.0, colour=3.0)
    assert [config.weight("eikonal", some) for some in (False, True)] == [0.5, 2.0]
    assert [config.weight("colour", some) for some in (False, True)] == [3.0, 3.0]


def test_without_texture_or_neighbour_there_are_no_depths(bowl: list[Photograph]) -> None:
    plain = [replace(view, image=torch.full_like(view.image, 0.5)) for view in bowl[:3]]
    assert len(ConsistentDepths.of(plane_sweep(plain))) == 0
    assert len(ConsistentDepths.of(plane_sweep(bowl[:1]))) == 0, "one view has no other to be compared with"
