"""Ratios of derivatives to differences: exact ones, and DIST's."""

import json
from pathlib import Path

import pytest
import torch
from torch import Tensor

from distrace.checkpoints.model import Model, save_experiment
from experiments.commands.costs import Gradients
from experiments.costs.gradients import COUNT, QUERIES, RatioRow, ratio_rows, subjects
from experiments.fields.untrained import ball


@pytest.fixture(scope="module")
def ratios() -> dict[tuple[str, str, str], tuple[RatioRow, Tensor]]:
    model = Model("ball", ball(3, 32).decoder, torch.zeros(1, 1), ("ball",))
    rows = [line for subject in subjects(model, model.codes[0], 32) for line in ratio_rows(subject)]
    return {(row.field, row.parameter, row.method): (row, image) for row, image in rows}


def test_the_exact_derivative_has_the_ratio_one_and_dists_has_not(ratios) -> None:
    for (_, _, method), (row, image) in ratios.items():
        assert row.pixels > 20
        if method == "exact":
            assert row.relative_error < 1e-6, row
            assert row.worst < 1e-3, row
            assert (image[~image.isnan()] - 1).abs().max() < 1e-2
        else:
            assert row.relative_error > 0.05, row
    assert len(ratios) == COUNT
    assert {method for _, _, method in ratios} == {"exact", *(f"DIST, k = {k}" for k in QUERIES)}


def test_on_the_sphere_dists_ratio_is_that_of_the_papers_own_code(ratios) -> None:
    for k, facing, grazing in ((1, 1.5, 0.85), (3, 4.5, 2.56), (5, 7.5, 3.42)):
        _, image = ratios["sphere", "radius", f"DIST, k = {k}"]
        assert image[15:17, 15:17].mean() == pytest.approx(facing, rel=0.02)
        assert image[~image.isnan()].min() < grazing


def test_a_face_at_a_grazing_angle_is_among_the_boxs_pixels(ratios) -> None:
    row, image = ratios["box", "size", "DIST, k = 1"]
    assert image[~image.isnan()].min() < 0.3
    assert row.ratio_high > 1.4


def test_a_subject_counts_its_evaluations() -> None:
    model = Model("ball", ball(1, 8).decoder, torch.zeros(1, 1), ("ball",))
    sphere_subject, *_ = subjects(model, model.codes[0], 16)
    assert sphere_subject.sdf.evaluations == 0
    list(ratio_rows(sphere_subject))
    assert sphere_subject.sdf.evaluations > 1000


def test_the_command_writes_the_table_and_maps(tmp_path: Path) -> None:
    save_experiment(tmp_path / "ball", ball(2, 16).decoder, torch.zeros(1, 1), ("ball",))
    Gradients(str(tmp_path / "ball"), tmp_path / "out", size=16, repeats=1).run()
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(content["rows"]) == COUNT
    assert {"field", "parameter", "method", "relative_error", "ratio", "pixels", "model"} <= set(content["rows"][0])
    exact = [row for row in content["rows"] if row["method"] == "exact"]
    assert len(exact) == COUNT / 4
    assert all(row["relative_error"] < 1e-5 for row in exact)
    text = (tmp_path / "out" / "index.html").read_text(encoding="utf-8")
    assert text.count("<img") == COUNT / 4
    assert "decoder by weights: exact, DIST, k = 1" in text
