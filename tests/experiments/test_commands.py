"""`python -m experiments`: each makes its table from small models, and refuses what is wrong in one line."""

import pickle
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import trimesh
from test_cli import Command, model, names, observation, place, refuses, result
from test_cli import run as run_distrace
from test_train import SPECS

from distrace import metrics
from distrace.checkpoints.model import load_model
from distrace.mesh import MeshConfig
from experiments.__main__ import main
from experiments.commands import depth, real_scans
from experiments.datasets.splits import FOLDER
from experiments.fields.analytic import NAMES
from experiments.tables import completion, sparse_depth, spread, training_choices

__all__ = ["model", "observation", "place", "run_distrace"]  # fixtures


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Command:
    """The command line, in this process."""

    def command(*arguments: object) -> None:
        monkeypatch.setattr(sys, "argv", ["experiments", *map(str, arguments)])
        main()

    return command


@pytest.fixture(scope="module")
def spheres_split(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Balls: two that the model knows, one held out and one left out; and the folder of their meshes."""
    folder = tmp_path_factory.mktemp("balls")
    lines = ["name,split,design,turn,path,creator,licence,note"]
    for name, split, note in (
        ("sphere0", "train", ""),
        ("sphere1", "train", ""),
        ("held", "test", ""),
        ("flat", "out", "it is flat"),
    ):
        trimesh.creation.icosphere(subdivisions=2).export(folder / f"{name}.ply")
        lines.append(f"{name},{split},{name},0,{name}.ply,me,CC0-1.0,{note}")
    (folder / "balls.csv").write_text("\n".join(lines) + "\n")
    return folder / "balls.csv", folder


@pytest.mark.slow
def test_procedural_shapes_are_sampled_and_learnt_with_the_class(
    run: Command, run_distrace: Command, tmp_path: Path
) -> None:
    meshes, samples = tmp_path / "meshes", tmp_path / "samples"
    run("procedural", "tables", "--count", "3", "--out", meshes)
    assert result(meshes, "class", "meshes", "seed")["meshes"] == 3
    assert names(meshes) == {"tables~1.ply", "tables~2.ply", "tables~3.ply", "preview.png", "result.json"}
    first = (meshes / "tables~1.ply").read_bytes()
    run("procedural", "tables", "--count", "1", "--out", tmp_path / "fewer")
    assert (tmp_path / "fewer" / "tables~1.ply").read_bytes() == first
    run_distrace("sample", meshes, "--out", samples, "--count", "1000", "--workers", "1")
    run_distrace(
        "train",
        samples,
        "--split",
        FOLDER / "tables.csv",
        "--out",
        tmp_path / "model",
        "--steps",
        "2",
        "--layers",
        "2",
        "--width",
        "16",
        "--code-length",
        "4",
    )
    assert load_model(tmp_path / "model").shapes == ("tables~1", "tables~2", "tables~3")


def test_held_out_tells_a_model_all_distances(
    model: Path, spheres_split: tuple[Path, Path], run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    split, meshes = spheres_split
    monkeypatch.setattr(completion, "SAMPLES", 4000)
    monkeypatch.setattr(metrics, "POINTS", 2000)
    where = ("--model", model, "--split", split, "--meshes", meshes, "--out", tmp_path, "--resolution", 24)
    run("held-out", *where)
    (row,) = result(tmp_path, "rows", "summary")["rows"]
    assert (row["shape"], row["method"]) == ("held", "all distances")


@pytest.fixture
def small_trials(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trials of small views, in this process: others do not know that they are to be small."""
    for module in (depth, spread):
        monkeypatch.setattr(
            module, "parallel_map", lambda work, wanted, jobs, cluster: map(pickle.loads(pickle.dumps(work)), wanted)
        )
    monkeypatch.setattr(sparse_depth, "SIZE", 64)
    monkeypatch.setattr(spread, "MeshConfig", partial(MeshConfig, 32))
    monkeypatch.setattr(spread, "COMPLETIONS", 3)
    monkeypatch.setattr(metrics, "POINTS", 2000)


@pytest.fixture
def depth_table(
    model: Path, spheres_split: tuple[Path, Path], run: Command, small_trials: None, tmp_path: Path
) -> Callable[[str], None]:
    split, meshes = spheres_split
    where = ("--classes", split, "--models", model, "--meshes", meshes, "--out", tmp_path, "--resolution", 24)
    return lambda name: run(name, *where, "--methods", "points", "--views", 1, "--jobs", 1)


def test_sparse_depth_writes_a_table_and_goes_on(depth_table: Callable[[str], None], tmp_path: Path) -> None:
    depth_table("sparse-depth")
    facts = result(tmp_path, "rows", "ratios", "instances", "evaluations")
    assert [row["density"] for row in facts["rows"]] == ["dense", "50%", "10%", "100", "50", "20"]
    assert len(facts["instances"]) == 6
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "trials").rglob("*.json")}
    depth_table("sparse-depth")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "trials").rglob("*.json")} == before


def test_focal_also_looks_at_what_was_fitted_through_other_focal_lengths(
    depth_table: Callable[[str], None], tmp_path: Path
) -> None:
    depth_table("focal")
    facts = result(tmp_path, "rows", "tests")
    assert [row["focal_ratio"] for row in facts["rows"]] == [0.5, 0.71, 1.0, 1.41, 2.0]
    assert [row["tested_at"] for row in facts["tests"]] == [0.5, 0.71, 1.0, 1.41, 2.0]
    assert all(0 < row["iou_median"] <= 1 and row["depth_error_median"] < 0.5 for row in facts["tests"])


@pytest.mark.slow
@pytest.mark.usefixtures("small_trials")
def test_spread_correlates_spread_and_error(
    model: Path, spheres_split: tuple[Path, Path], run: Command, tmp_path: Path
) -> None:
    split, meshes = spheres_split
    run("spread", "--classes", split, "--models", model, "--meshes", meshes, "--jobs", 1, "--out", tmp_path)
    (row,) = result(tmp_path, "rows", "median_correlation")["rows"]
    assert -1 <= row["correlation"] <= 1


@pytest.mark.slow
def test_views_measures_analytic_fields_alone_where_no_model_is_named(
    run: Command, capsys: pytest.CaptureFixture, tmp_path: Path
) -> None:
    run("views", "--views", 1, "--sizes", 16, 16, "--out", tmp_path)
    assert [row["model"] for row in result(tmp_path, "rows")["rows"]] == list(NAMES)
    said = capsys.readouterr().out
    for line in result(tmp_path, "summary")["summary"]:
        assert any(text.startswith(line["model"]) and text.endswith(line["bar"]) for text in said.splitlines()), line


def test_splits_and_card_describe_what_a_model_was_trained_on(
    model: Path, spheres_split: tuple[Path, Path], run: Command, tmp_path: Path
) -> None:
    split, meshes = spheres_split
    run("splits", "--splits", split, "--meshes", meshes, "--out", tmp_path / "splits")
    rows = result(tmp_path / "splits", "rows")["rows"]
    assert {row["shape"] for row in rows} == {"sphere0", "sphere1", "held"}
    assert all(row["chamfer"] < 5 for row in rows), "they are one shape"
    run("card", "--model", model, "--split", split, "--meshes", meshes, "--out", tmp_path / "card")
    assert names(tmp_path / "card") == {"result.json", "walks.png", "shapes.png", "shapes.md"}
    said = (tmp_path / "card" / "shapes.md").read_text(encoding="utf-8")
    assert "| flat | left out: it is flat | me | CC0-1.0 |" in said
    assert "| held | held out | me | CC0-1.0 |" in said


def test_real_scans_have_a_row_and_a_folder_each(
    model: Path, run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=1.2).export(tmp_path / "ball.ply")
    given = real_scans.Input("ball", str(model), (tmp_path / "ball.ply",))
    monkeypatch.setattr(real_scans, "inputs", lambda data: [given])
    run("real-scans", tmp_path, "--resolution", 16, "--out", tmp_path / "out")
    (row,) = result(tmp_path / "out", "rows", "evaluations", "command", "machine")["rows"]
    assert (row["input"], row["verdict"]) == ("ball", "trusted")
    assert row["explained"] > 0.9
    assert row["evaluations"] > 1000
    assert {"mesh.ply", "code.npy", "placement.json"} == names(tmp_path / "out" / "ball")


@pytest.mark.slow
def test_choices_trains_small_networks(
    spheres_split: tuple[Path, Path],
    run: Command,
    run_distrace: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    split, meshes = spheres_split
    run_distrace(
        "sample", meshes, "--split", split, "--variants", 1, "--count", 1500, "--workers", 1, "--out", tmp_path / "s"
    )
    monkeypatch.setattr(training_choices, "SPECS", SPECS)
    monkeypatch.setattr(completion, "SAMPLES", 500)
    monkeypatch.setattr(completion, "SAMPLES_FIT", replace(completion.SAMPLES_FIT, iterations=4))
    monkeypatch.setattr(metrics, "POINTS", 500)
    where = ("--samples", tmp_path / "s", "--split", split, "--meshes", meshes, "--out", tmp_path / "out")
    run("choices", *where, "--others", tmp_path / "s", "--steps", 40, "--resolution", 24)
    rows = result(tmp_path / "out", "rows")["rows"]
    assert [row["codes"] for row in rows] == [2, 2, 4, 4, 4, 4, 4, 9, 9]
    assert [row["steps"] for row in rows[-2:]] == [40, 40 * 9 // 4]
    assert all(row["held_out_median"] > 0 for row in rows)


BAD = [
    ("procedural lamps", "lamps"),
    ("procedural sofas --count 0", "--count 0 was given; at least one shape"),
    ("procedural sofas --count 1 --out {tmp}/text", "text is a file"),
    ("memory {tmp}/missing", "neither a folder nor a bundled model"),
    ("pose --model {model} --cameras 0", "--cameras 0"),
    ("training --model {model} --split sofas --meshes {tmp}/missing", "no shape in common"),
    ("training --model {model}", "there is no split"),
    (
        "completion --model {model} --split sofas --meshes {tmp}/missing",
        "is missing; `distrace data furniture",
    ),
    ("completion --model {model} --split {tmp}/text", "lacks the columns"),
    ("completion --model {model} --split {tmp}/missing", "there is no split"),
    ("fame --model {model}", "fame"),
    ("sparse-depth --views 5", "--views 5"),
    ("sparse-depth --shapes 0", "--shapes 0"),
    ("spread --jobs 0", "--jobs 0"),
    ("spread --classes", "--classes names none"),
    ("multiview", "no clips were given"),
    ("noise --models {model}", "1 models"),
    ("sparse-depth --classes {tmp}/missing", "there is no split"),
    ("splits --splits {tmp}/missing", "there is no split"),
    ("splits --meshes {tmp}/missing", "is missing; `distrace data furniture"),
    ("real-scans {tmp}/missing", "frame-000090.depth.png does not exist"),
    ("card --model {tmp}/missing --split sofas", "neither a folder nor a bundled model"),
    ("choices --samples {tmp}/missing", "holds no samples of chairs"),
]


@pytest.mark.parametrize(("words", "message"), BAD, ids=[words.replace("/", ".") for words, _ in BAD])
def test_whatever_is_wrong_is_one_line_and_status_two(
    words: str, message: str, place: dict[str, str], run: Command, capsys: pytest.CaptureFixture
) -> None:
    refuses(words, message, place, run, capsys, "python -m experiments")
