"""Fields that break what sphere tracing assumes: what the table counts, and that fast is right on each."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from distrace.benchmarks.measuring import poster_view, reference_depth, reference_distance
from distrace.benchmarks.random_views import RandomView, Shot
from distrace.fields.primitives import box, sphere, union
from distrace.rays import Rays, meet_sphere
from distrace.render import render
from experiments.costs.fields import COUNT, FieldRow, field_rows
from experiments.costs.pages import fields_page
from experiments.fields import analytic
from experiments.fields.analytic import hard_fields

SOFA = union(box(torch.tensor([0.6, 0.15, 0.3])), box(torch.tensor([0.15, 0.5, 0.3])))
SHOT = Shot(azimuth=20.0, elevation=10.0, distance=3.0, focal_mm=40.0, target=(0.0, 0.0, 0.0), size=64)
NAMES = ["decoder × 2", "thin plate", "high frequencies", "gap of a pixel", "clamped"]


@pytest.fixture(scope="module")
def rows() -> list[FieldRow]:
    return list(field_rows(SOFA, poster_view(64)))


def test_every_strategy_is_counted_on_every_field(rows: list[FieldRow]) -> None:
    assert len(rows) == COUNT
    assert list(dict.fromkeys(row.field for row in rows)) == NAMES
    assert all(0 <= row.admitted <= row.wrong and row.admitted <= row.exhausted for row in rows)
    assert all(row.visible > 50 and row.queries > 0 for row in rows)


def test_fast_gets_nearly_all_pixels_right_or_says_that_it_does_not_know(rows: list[FieldRow]) -> None:
    for row in rows:
        if row.strategy == "fast":
            assert row.wrong - row.admitted <= 0.02 * row.visible, row.field


def test_the_fields_are_as_steep_as_they_say_and_no_steeper() -> None:
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 1.6 - 0.8
    for name, hard in hard_fields(SOFA, poster_view(64)).items():
        at = points.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(hard.sdf(at).sum(), at)
        assert gradient.norm(dim=-1).max() <= hard.lipschitz * 1.001, name
    wild = hard_fields(SOFA, poster_view(64))["high frequencies"].sdf
    at = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(wild(at).sum(), at)
    assert gradient.norm(dim=-1).max() > 1.3


def test_the_gap_is_as_wide_as_a_pixel_and_seen_through_its_walls() -> None:
    camera = poster_view(64)
    gap = hard_fields(SOFA, camera)["gap of a pixel"].sdf
    x = torch.linspace(-0.2, 0.2, 4001)
    outside = gap(torch.stack([x, torch.zeros_like(x), torch.zeros_like(x)], dim=-1)) > 0
    width = outside.sum() * (x[1] - x[0])
    pixel = 4.97 / camera.intrinsics[0, 0]
    assert width == pytest.approx(float(pixel), rel=0.05)


def test_a_steeper_field_gives_the_same_image() -> None:
    camera = poster_view(64)
    truth = reference_depth(SOFA, camera)
    for steepness in (2.0, 5.0):
        with torch.no_grad():
            buffers = render(lambda points, by=steepness: by * SOFA(points), camera)
        assert (buffers.mask == torch.isfinite(truth)).float().mean() > 0.998
        both = buffers.mask & torch.isfinite(truth)
        assert (buffers.depth - truth)[both].abs().max() < 1e-3


def test_the_page_tells_what_went_unnoticed(rows: list[FieldRow]) -> None:
    text = fields_page([*rows, FieldRow("field", "fast", 10, 7, 3, 4, 100)])
    assert "4 + 3" in text
    assert all(name in text for name in NAMES)


@pytest.fixture(scope="module")
def drawn() -> list[RandomView]:
    return list(analytic.analytic_views(sphere(0.6), 2, (32, 48), 0))


def test_every_family_is_drawn_and_no_field_is_steeper_than_its_lipschitz_constant(drawn: list[RandomView]) -> None:
    assert [view.model for view in drawn] == [name for name in analytic.NAMES for _ in range(2)]
    for view in drawn:
        points = (torch.tensor(view.shot.target) + 0.3 * torch.randn(500, 3)).requires_grad_()
        (gradient,) = torch.autograd.grad(view.sdf(points).sum(), points)
        assert gradient.norm(dim=-1).max() <= view.lipschitz * 1.001, view.model


@pytest.mark.slow
def test_every_family_but_the_camera_in_the_solid_is_seen(drawn: list[RandomView]) -> None:
    for view in drawn:
        truth = reference_depth(lambda points, view=view: view.sdf(points) / view.lipschitz, view.camera())
        seen = int(torch.isfinite(truth).sum())
        assert (seen == 0) == (view.model == "camera in the solid"), view.model
        if view.model.startswith("tiny"):
            assert 0.1 * 0.3**2 < seen / truth.numel() < 0.9**2
            assert view.sdf(torch.zeros(1, 3)) > 0.01, "off centre"


@pytest.mark.parametrize("pixels", [1, 2, 3])
def test_thin_solids_are_as_many_pixels_thick_as_they_say(pixels: int) -> None:
    """Along a line through the middle at right angles to the plate, and over the gap."""
    for name, inside in (("plate", True), ("gap", False)):
        shot = replace(SHOT, size=100)
        family = analytic.families(sphere(0.6))[f"{name} of {pixels} px"]
        thin = family(np.random.default_rng(1), shot).sdf
        middle = torch.from_numpy(np.random.default_rng(1).uniform(-0.2, 0.2, 3)).float()
        points = middle + 0.25 * torch.nn.functional.normalize(torch.randn(20000, 3), dim=-1)
        narrowest = thin(middle[None]).abs() * 2  # the distance to the wall on either side
        assert float(narrowest) == pytest.approx(pixels * shot.pixel(middle), rel=0.02), name
        assert (thin(middle[None]) < 0) == inside
        assert (thin(points) < 0).any()


def test_the_gap_can_be_seen_through() -> None:
    family = analytic.families(sphere(0.6))["gap of 3 px"]
    through = 0
    for seed in range(6):
        view = family(np.random.default_rng(seed), replace(SHOT, focal_mm=60.0))
        middle = torch.from_numpy(np.random.default_rng(seed).uniform(-0.2, 0.2, 3)).float()
        sight = torch.nn.functional.normalize(middle - SHOT.eye(), dim=0)
        ray = Rays(SHOT.eye()[None], sight[None])
        through += bool(reference_distance(view.sdf, ray, meet_sphere(ray)).isinf())
    assert through >= 2
