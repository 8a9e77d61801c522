"""How cost grows: the rows of the table."""

from pathlib import Path

import pytest
import torch

from distrace.benchmarks.measuring import poster_view, reference_distance
from distrace.checkpoints.model import load_model
from distrace.fields.primitives import sphere
from distrace.rays import meet_sphere
from experiments.costs import growth
from experiments.costs.pages import growth_page
from experiments.fields.untrained import RADIUS, ball


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "SIZES", (16, 32))
    monkeypatch.setattr(growth, "NETWORKS", ((2, 16), (3, 16)))
    monkeypatch.setattr(growth, "VIEWS", (1, 3))


@pytest.mark.slow
def test_a_row_for_every_size_strategy_network_and_number_of_views() -> None:
    rows = [*growth.by_size(sphere(0.5), 1), *growth.by_network(1), *growth.by_views(sphere(0.5), 1)]
    assert [row.value for row in rows] == ["16", "16", "32", "32", "2 × 16", "2 × 16", "3 × 16", "3 × 16", "1", "3"]
    assert all(row.per_pixel == row.queries / row.visible for row in rows)
    assert "3 × 16" in growth_page(rows)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="peaks are read from Linux")
def test_memory_is_what_the_images_take_and_little_more() -> None:
    small, large = growth.peak_memory("sofas", "0", 64), growth.peak_memory("sofas", "0", 256)
    assert 0 <= small < 300
    assert large < 700  # 540 to 640: two activations of 100,000 points are 400


def test_more_pixels_cost_more_and_each_of_them_less() -> None:
    small, large = (row for row in growth.by_size(sphere(0.5), 1) if row.strategy == "fast")
    assert small.queries < large.queries
    assert small.per_pixel > large.per_pixel


def test_views_share_one_occupancy() -> None:
    one, three = growth.by_views(sphere(0.5), 1)
    assert three.visible > 2.9 * one.visible
    assert three.queries < 3 * one.queries


@pytest.mark.slow
def test_many_shapes_in_one_call_are_measured_beside_their_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(growth, "SHAPES", (2,))
    whole, evaluations = growth.by_shapes(load_model("sofas"), 1)
    assert whole.queries == evaluations.queries > 10_000
    assert 100 < evaluations.operations < whole.operations


@pytest.mark.parametrize(("layers", "width"), [(4, 128), (8, 256)])
def test_an_untrained_network_is_about_a_sphere(layers: int, width: int) -> None:
    rays = poster_view(16).rays()
    with torch.no_grad():
        found = reference_distance(ball(layers, width), rays, meet_sphere(rays))
    hit = torch.isfinite(found)
    assert hit.sum() > 10
    assert rays.at(found)[hit].norm(dim=-1).mean() == pytest.approx(RADIUS, rel=0.5)
