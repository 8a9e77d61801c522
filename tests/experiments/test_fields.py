"""Fields that break what sphere tracing assumes: what the table counts, and that fast is right on each."""

import pytest
import torch

from distrace.benchmarks.measuring import poster_view, reference_depth
from distrace.fields.primitives import box, union
from distrace.render import render
from experiments.costs.fields import COUNT, FieldRow, field_rows, hard_fields
from experiments.costs.pages import fields_page

SOFA = union(box(torch.tensor([0.6, 0.15, 0.3])), box(torch.tensor([0.15, 0.5, 0.3])))
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
        assert gradient.norm(dim=-1).max() <= hard.steepest * 1.001, name
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
