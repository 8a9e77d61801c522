"""The log of a run: a line at a time, without repeated steps where a run was resumed."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from distrace.cli import main
from distrace.cli.metrics_log import NAME, MetricsLog, check_log, is_due
from distrace.data.samples import write_samples
from distrace.optional import MissingLibrary


def lines(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / NAME).read_text().splitlines()]


def test_a_resumed_run_goes_on_after_its_checkpoint(tmp_path: Path) -> None:
    with MetricsLog(tmp_path, 0) as log:
        for step in (100, 200, 300):
            log.write(step, {"loss": step / 1000})
    with (tmp_path / NAME).open("a") as file:
        file.write('{"step": 150, "los')  # killed here
    first = lines_before_the_cut(tmp_path)
    with MetricsLog(tmp_path, 250) as log:  # the checkpoint is older than the last line
        log.write(300, {"loss": 0.4})
        written = lines(tmp_path)  # each line is in the file at once
    assert [line["step"] for line in written] == [100, 200, 300]
    assert [line["loss"] for line in written] == [0.1, 0.2, 0.4]
    assert written[2]["seconds"] >= written[1]["seconds"] == first[1]["seconds"]


def lines_before_the_cut(folder: Path) -> list[dict]:
    return [json.loads(line) for line in (folder / NAME).read_text().splitlines()[:-1]]


def test_a_fresh_run_leaves_nothing_of_another(tmp_path: Path) -> None:
    (tmp_path / NAME).write_text('{"step": 100, "seconds": 1.0}\n[]\n{"step": "x"}\n')
    with MetricsLog(tmp_path, 0) as log:
        log.write(1, {"loss": float("nan")})
    (line,) = lines(tmp_path)
    assert (line["step"], line["loss"]) == (1, None)


def test_a_line_is_due_every_hundred_steps_and_at_the_end() -> None:
    assert [step for step in range(1, 331) if is_due(step, 250, 330)] == [100, 200, 250, 300, 330]


def test_a_training_is_logged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    points = np.random.default_rng(0).uniform(-0.6, 0.6, (900, 3))
    distances = np.linalg.norm(points, axis=1, keepdims=True) - 0.5
    write_samples(tmp_path / "samples" / "ball.npz", np.hstack([points, distances]).astype(np.float32))
    small = ["--samples-per-step", "16", "--layers", "2", "--width", "8", "--code-length", "2"]
    command = ["distrace", "train", str(tmp_path / "samples"), "--out", str(tmp_path / "out"), "--log", "tensorboard"]
    for steps, options in (("120", small), ("205", [])):
        monkeypatch.setattr(sys, "argv", [*command, "--steps", steps, *options])
        main()
    written = lines(tmp_path / "out")
    assert [line["step"] for line in written] == [100, 120, 200, 205]
    assert all(line["loss"] > 0 and line["learning_rate"] > 0 for line in written)
    seconds = [line["seconds"] for line in written]
    assert seconds == sorted(seconds)
    events = EventAccumulator(str(tmp_path / "out" / "tensorboard")).Reload()
    scalars = events.Scalars("loss")
    assert [event.step for event in scalars] == [100, 120, 200, 205]
    assert [event.value for event in scalars] == pytest.approx([line["loss"] for line in written])


def test_a_missing_library_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    check_log("none")
    with pytest.raises(MissingLibrary, match=r"^--log tensorboard needs tensorboard; install it by pip install '.*'$"):
        check_log("tensorboard")
