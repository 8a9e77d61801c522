"""`check-gradients` and `bench gradients`: what they write, what they say, and the exit status."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import distrace.cli
import distrace.cli.gradients
from distrace.benchmarks import ablation
from distrace.checking.gradcheck import DOUBLE, GradientCheck, GradientRow, check_gradients
from distrace.checkpoints.model import save_experiment
from distrace.fields.base import SDF
from experiments.fields.untrained import ball

VIEW = ("--distance", "3", "--focal-mm", "40", "--size", "8")
COMMON = {"seconds", "device", "version", "evaluations", "rows", "command", "machine"}


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About a sphere, without any training."""
    folder = tmp_path_factory.mktemp("models") / "ball"
    save_experiment(folder, ball(2, 16).decoder, torch.zeros(1, 1), ("ball",))
    return folder


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    def command(*arguments: object) -> int:
        """Its exit status."""
        monkeypatch.setattr(sys, "argv", ["distrace", *map(str, arguments)])
        try:
            distrace.cli.main()
        except SystemExit as stop:
            return int(stop.code or 0)
        return 0

    return command


def facts(out: Path) -> dict:
    content = json.loads((out / "result.json").read_text())
    assert set(content) >= COMMON
    assert content["evaluations"] > 100
    return content


def only_hits(found: GradientCheck) -> GradientCheck:
    """Without what a network of 16 units a layer is too coarse for: its pieces are as large as a footprint."""
    coarse = ("clearance", "footprint normal")
    return replace(found, rows=tuple(row for row in found.rows if row.quantity not in coarse))


def test_a_model_whose_derivatives_agree_ends_with_a_table_and_status_0(
    model: Path, run: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    def of_hits(*arguments, **options) -> GradientCheck:
        return only_hits(check_gradients(*arguments, **options))

    monkeypatch.setattr(distrace.cli.gradients, "check_gradients", of_hits)
    assert run("check-gradients", model, "--out", tmp_path, *VIEW) == 0
    content = facts(tmp_path)
    assert content["agrees"] is True
    assert {row["parameter"] for row in content["rows"]} >= {"code", "weights", "placement", "focal length"}
    keys = {"model", "quantity", "parameter", "median", "worst", "x", "y", "along", "derivative", "difference"}
    assert all(keys | {"pixels", "off", "left_out", "verdict", "step"} <= set(row) for row in content["rows"])
    said = capsys.readouterr().out
    zeros = [row for row in content["rows"] if row["verdict"] == "zero"]
    assert {row["quantity"] for row in zeros} == {"normal"}
    agreeing = len(content["rows"]) - len(zeros)
    assert content["verdicts"] == {"agrees": agreeing, "disagrees": 0, "zero": len(zeros)}
    assert f"{agreeing} of {len(content['rows'])} agree, 0 disagree, {len(zeros)} compare zero with zero" in said
    for column in (
        "of",
        "by",
        "median",
        "worst",
        "pixel",
        "along",
        "autograd",
        "differences",
        "off",
        "left out",
        "verdict",
    ):
        assert column in said.splitlines()[0]
    assert said.count("agrees") == agreeing


def test_a_derivative_that_disagrees_is_status_1_and_said(
    model: Path, run: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    wrong = GradientRow("depth", "code", 0.5, 0.9, 3, 4, "", (1.0,), (2.0,), 10, 9, 0, "disagrees")

    monkeypatch.setattr(
        distrace.cli.gradients, "check_gradients", lambda *_, **__: GradientCheck((wrong,), DOUBLE, 1000)
    )
    assert run("check-gradients", model, "--out", tmp_path, *VIEW) == 1
    content = facts(tmp_path)
    assert content["agrees"] is False
    assert content["rows"][-1]["worst"] == 0.9
    assert "DISAGREES" in capsys.readouterr().out


@pytest.mark.parametrize("command", [("check-gradients",), ("bench", "gradients"), ("bench", "trace")])
@pytest.mark.parametrize("given", ["1", "second", "mine.npy"])
def test_a_code_is_a_number_a_name_or_a_file(
    given: str, command: tuple[str, ...], run: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoder = ball(2, 16).decoder
    save_experiment(tmp_path / "balls", decoder, torch.tensor([[0.0], [0.2]]), ("first", "second"))
    np.save(tmp_path / "mine.npy", np.array([0.2], np.float32))
    point = torch.tensor([[0.3, 0.4, 0.5]])
    values = []

    def measure_point(sdf: SDF, *_: object) -> None:
        values.append(sdf(point))
        raise ValueError("one point is enough")

    monkeypatch.setattr("distrace.cli.gradients.check_gradients", lambda sdf, camera, size: measure_point(sdf))
    monkeypatch.setattr("distrace.cli.bench.check_gradients", measure_point)
    monkeypatch.setattr(ablation, "of_model", lambda model, code, camera: measure_point(model.field(code)))
    code = tmp_path / given if given.endswith(".npy") else given
    assert run(*command, tmp_path / "balls", "--code", code, "--out", tmp_path / "out") == 2
    assert len(values) == 1
    torch.testing.assert_close(values[0], decoder.field(torch.tensor([0.2]))(point))
    assert not torch.allclose(values[0], decoder.field(torch.tensor([0.0]))(point))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--code 3", "code 3 was given"),
        ("--code -1", "-1 is neither the number nor the name of a training shape, nor a code.npy"),
        ("--size 0", "0 × 0"),
        ("--distance 0", "its own place"),
        ("--distance 9000 --focal-mm 1", "sees nothing"),
        ("--device tpu", "is no device"),
        ("--colour red", "--colour"),
    ],
)
def test_whatever_is_wrong_is_one_line_and_status_2(
    words: str, message: str, model: Path, run: Callable[..., int], tmp_path: Path, capsys
) -> None:
    assert run("check-gradients", model, "--out", tmp_path, *words.split()) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert not (tmp_path / "result.json").exists()


def test_bench_gradients_writes_a_table(model: Path, run: Callable[..., int], tmp_path: Path) -> None:
    assert run("bench", "gradients", model, "--size", 16, "--out", tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"result.json"}
    content = facts(tmp_path)
    keys = {"model", "field", "quantity", "parameter", "method", "relative_error", "worst", "pixels", "verdict"}
    assert all(keys <= set(row) for row in content["rows"])
    by_code = {row["quantity"]: row for row in content["rows"] if row["parameter"] == "code"}
    assert by_code["depth"]["relative_error"] < 1e-5
    assert by_code["depth"]["pixels"] > 20
