"""Simulated scans and the training of placement networks."""

from pathlib import Path

import pytest
import torch

from distrace.pose import Similarity
from experiments.networks import training
from experiments.networks.scans import ScanMaker, TrainingScans, joined_scans
from experiments.networks.training import loss_of, trained, validated, views_of


@pytest.fixture(scope="module")
def scans() -> TrainingScans:
    maker = ScanMaker("tables", [], Path("nowhere"), 5)
    return joined_scans([maker.make(number) for number in range(4)])


def test_most_points_of_a_scan_lie_in_the_true_unit_sphere(scans: TrainingScans) -> None:
    for k in range(len(scans)):
        place = Similarity(scans.rotation[k], scans.translation[k], scans.scale[k])
        inside = place.to_object(scans.points[k]).norm(dim=-1) < 1.1
        assert inside.float().mean() > 0.7, "a mask may be wrong by 15 % of its area, or be a box"


def test_scans_are_read_as_they_were_saved(scans: TrainingScans, tmp_path: Path) -> None:
    scans.save(tmp_path / "scans.pt")
    read = TrainingScans.load(tmp_path / "scans.pt")
    assert read.points.equal(scans.points)
    assert read.scale.equal(scans.scale)


def test_the_same_seed_makes_the_same_scan(scans: TrainingScans) -> None:
    again = ScanMaker("tables", [], Path("nowhere"), 5).make(0)
    assert again.points.equal(scans.points[:1])


def test_an_unvaried_view_tells_the_true_size_and_distance(scans: TrainingScans) -> None:
    views = views_of(scans, torch.Generator().manual_seed(0), varied=False)
    torch.testing.assert_close(views.place[:, 3], (scans.scale / scans.radius).log())
    away = (scans.translation - scans.centre).norm(dim=-1) / scans.radius
    torch.testing.assert_close(views.place[:, :3].norm(dim=-1), away)
    assert views.grids.amax((1, 2, 3)).min() > 0


def test_training_makes_the_true_placements_likelier(scans: TrainingScans, monkeypatch: pytest.MonkeyPatch) -> None:
    many = scans[torch.arange(28) % len(scans)]
    monkeypatch.setattr(training, "VALIDATION", 8)
    monkeypatch.setattr(training, "BATCH", 16)
    monkeypatch.setattr(training, "WARM_UP", 1)
    steps = []
    network = trained(many, 15, 0, steps.append)
    assert steps == list(range(1, 16))
    monkeypatch.setattr(training, "LEARNING_RATE", 0.0)
    untrained = trained(many, 15, 0, steps.append)
    views = views_of(many[slice(0, 8)], torch.Generator().manual_seed(0), varied=False)
    with torch.no_grad():
        assert loss_of(network, views) < loss_of(untrained, views) - 0.2
    assert validated(network, many)["size_percent"] >= 0
