"""Verdicts: what a right shape, a wrong one and a much too large one are called."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from distrace.data.scan import Scan, scan_of_points
from distrace.data.up import Up
from distrace.fields import primitives
from distrace.fitting.judge import disagreement_of, judged, points_on_zero_set
from distrace.pose import Similarity
from distrace.rays import Rays

SPHERE = primitives.sphere(0.6)
PLACE = Similarity(torch.eye(3), torch.tensor([4.0, 1.0, -2.0]), torch.tensor(2.5))


def directions(count: int) -> Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)


def scan() -> Scan:
    """The front of a sphere, seen along z, and a little of what is behind."""
    points = directions(2000)
    return scan_of_points(PLACE.to_world(0.6 * points[points[:, 2] > -0.5]), Up.along("y"))


def with_rays(seen: Scan, x: Tensor) -> Scan:
    """The scan with free rays along −z that pass the centre at some distances, in sizes."""
    origins = PLACE.to_world(torch.stack([x, torch.zeros_like(x), torch.full_like(x, 5.0)], dim=1))
    rays = Rays(origins, torch.tensor([0.0, 0.0, -1.0]).expand(len(x), 3))
    return replace(seen, free=rays, free_until=torch.full_like(x, torch.inf))


def test_the_true_surface_is_trusted() -> None:
    verdict = judged(with_rays(scan(), torch.linspace(0.65, 0.95, 40)), SPHERE, PLACE)
    assert verdict.name == "trusted"
    assert verdict.explained > 0.99
    assert verdict.blocked == 0


def test_a_shape_where_rays_saw_through_fails() -> None:
    verdict = judged(with_rays(scan(), torch.linspace(0.0, 0.95, 40)), SPHERE, PLACE)
    assert verdict.name == "failed"
    assert verdict.blocked == pytest.approx(0.6 / 0.95, abs=0.06)
    assert "blocks" in verdict.reason


@pytest.mark.parametrize(("radius", "name"), [(0.8, "failed"), (0.6, "trusted")])
def test_points_away_from_the_surface_tell(radius: float, name: str) -> None:
    assert judged(scan(), primitives.sphere(radius), PLACE).name == name


def test_a_shape_far_larger_than_what_was_seen_is_doubtful() -> None:
    points = 0.6 * directions(40_000)
    cap = scan_of_points(PLACE.to_world(points[points[:, 2] > 0.57]), Up.along("y"))
    verdict = judged(cap, SPHERE, PLACE)
    assert verdict.explained > 0.99
    assert verdict.name in ("doubtful", "failed")
    assert "span" in verdict.reason


def test_a_field_that_is_nowhere_negative_explains_nothing() -> None:
    assert judged(scan(), lambda points: SPHERE(points).abs() + 1e-3, PLACE).explained == 0
    thin = judged(scan(), lambda points: SPHERE(points).abs() - 3e-3, PLACE)
    assert thin.explained > 0.99


def test_another_fit_elsewhere_makes_it_doubtful() -> None:
    surface = PLACE.to_world(points_on_zero_set(SPHERE, 300, torch.empty(0)))
    assert len(surface) > 250
    assert disagreement_of(surface, PLACE, []) == 0
    assert disagreement_of(surface, PLACE, [(SPHERE, PLACE)]) < 1e-2
    larger = [(primitives.sphere(0.8), PLACE)]
    assert disagreement_of(surface, PLACE, larger) == pytest.approx(0.2, abs=0.02)
    verdict = judged(scan(), SPHERE, PLACE, larger)
    assert verdict.disagreement == pytest.approx(0.2, abs=0.02)
    assert verdict.name == "doubtful"


def test_a_wrong_silhouette_tells() -> None:
    assert judged(scan(), SPHERE, PLACE, silhouette=0.8).name == "doubtful"
    assert judged(scan(), SPHERE, PLACE, silhouette=0.4).name == "failed"


def test_an_unlikely_placement_is_doubtful() -> None:
    assert judged(scan(), SPHERE, PLACE, prior_deviation=3.9).name == "trusted"
    found = judged(scan(), SPHERE, PLACE, prior_deviation=4.1)
    assert found.name == "doubtful"
    assert "of another size, or elsewhere" in found.reason
