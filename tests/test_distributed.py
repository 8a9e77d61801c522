"""Training in several processes, and with samples on the disk: the same losses, codes and weights as in one."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from distrace.checkpoints.model import load_model
from distrace.cli import main
from distrace.data.samples import write_samples
from distrace.fields.decoder import NetworkSpecs
from distrace.training.batches import load_samples
from distrace.training.checkpointing import NAME, save_training
from distrace.training.config import TrainConfig
from distrace.training.distributed import ALONE, Processes, joined
from distrace.training.mapped_samples import map_samples, open_mapped
from distrace.training.trainer import start_training, train

CPU = torch.device("cpu")
RADII = (0.3, 0.4, 0.5, 0.6, 0.45)
SPECS = NetworkSpecs(dims=(16, 16, 16), code_length=4, latent_in=(2,), norm_layers=(0, 1, 2))
CONFIG = TrainConfig(steps=30, samples_per_step=64, shapes_per_step=2, warm_up=10)


def write_balls(folder: Path) -> list[Path]:
    """Samples of a ball for each radius."""
    for number, radius in enumerate(RADII):
        points = np.random.default_rng(number).uniform(-0.7, 0.7, (2000 + 100 * number, 3))
        distances = np.linalg.norm(points, axis=1, keepdims=True) - radius
        write_samples(folder / f"ball{number}.npz", np.hstack([points, distances]).astype(np.float32))
    return sorted(folder.glob("*.npz"))


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The command line, in this process."""

    def command(*arguments: str | Path) -> None:
        monkeypatch.setattr(sys, "argv", ["distrace", *map(str, arguments)])
        main()

    return command


def checkpoint(folder: Path) -> dict:
    return torch.load(folder / NAME, weights_only=True)


def assert_close(one: dict, other: dict) -> None:
    """Two checkpoints are those of one run, up to rounding."""
    assert one["step"] == other["step"]
    assert one["losses"] == pytest.approx(other["losses"], rel=1e-5)
    torch.testing.assert_close(one["codes"], other["codes"], rtol=1e-3, atol=1e-6)
    torch.testing.assert_close(one["decoder"], other["decoder"], rtol=1e-3, atol=1e-5)
    moments = [state["optimiser"]["state"][len(one["optimiser"]["state"]) - 1] for state in (one, other)]
    assert moments[0]["exp_avg"].shape == one["codes"].shape
    torch.testing.assert_close(moments[0]["exp_avg"], moments[1]["exp_avg"], rtol=1e-3, atol=1e-7)


def two_processes(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Runs a module or a script in two processes."""
    launcher = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    return subprocess.run(
        [*launcher, *map(str, arguments)], env=environment, capture_output=True, text=True, timeout=600
    )


def test_every_shape_belongs_to_one_process() -> None:
    shapes = torch.tensor([4, 0, 3, 1])
    rows = torch.arange(10.0).reshape(5, 2)
    processes = [Processes(rank, 3) for rank in range(3)]
    assert [shapes[process.own(shapes)].tolist() for process in processes] == [[0, 3], [4, 1], []]
    assert [process.part(rows)[:, 0].tolist() for process in processes] == [[0, 6], [2, 8], [4]]
    for shape in range(5):  # as the trainer numbers a shape's code within its process
        assert torch.equal(processes[shape % 3].part(rows)[shape // 3], rows[shape])


def test_without_torchrun_a_process_is_alone() -> None:
    with joined(CPU) as (processes, device):
        assert (processes, device) == (ALONE, CPU)
        assert torch.equal(torch.arange(3)[processes.own(torch.arange(3))], torch.arange(3))
        assert processes.from_leader(lambda: 7) == 7


def test_mapped_samples_are_those_of_the_files(tmp_path: Path) -> None:
    paths = write_balls(tmp_path / "samples")
    map_samples(paths, tmp_path / "mapped")
    mapped, loaded = open_mapped(tmp_path / "mapped"), load_samples(paths)
    assert mapped.names == loaded.names
    for one, other in ((mapped.outside, loaded.outside), (mapped.inside, loaded.inside)):
        assert torch.equal(one.rows, other.rows)
        assert torch.equal(one.counts, other.counts)
    _, rows = mapped.draw(3, 60, 1.0)
    assert torch.equal(mapped.at(rows), loaded.at(rows))


def test_samples_are_mapped_once_and_again_when_a_file_changes(tmp_path: Path) -> None:
    paths, mapped = write_balls(tmp_path / "samples"), tmp_path / "mapped"
    map_samples(paths, mapped)
    before = (mapped / "outside.f32").stat().st_ino
    map_samples(paths, mapped)
    assert (mapped / "outside.f32").stat().st_ino == before
    map_samples(paths[:2], mapped)
    assert open_mapped(mapped).names == ["ball0", "ball1"]
    (mapped / "index.json").write_text("[")
    with pytest.raises(ValueError, match=r"index\.json is damaged; remove the folder"):
        map_samples(paths, mapped)


def test_mapped_samples_train_the_same_model(tmp_path: Path) -> None:
    paths = write_balls(tmp_path / "samples")
    map_samples(paths, tmp_path / "mapped")
    codes = []
    for samples in (load_samples(paths), open_mapped(tmp_path / "mapped")):
        training = start_training(len(RADII), SPECS, CONFIG, CPU)
        for _ in train(samples, training, CONFIG):
            pass
        codes.append(training.codes)
    assert torch.equal(*codes)


def test_the_command_maps_samples_and_says_what_needs_them_in_memory(
    tmp_path: Path, run: Callable[..., None], capsys: pytest.CaptureFixture
) -> None:
    paths = write_balls(tmp_path / "samples")
    for path in paths[1:]:
        path.unlink()
    small = ("--steps", "2", "--layers", "2", "--width", "8", "--code-length", "2", "--memory-map")
    run("train", tmp_path / "samples", "--out", tmp_path / "first", *small)
    assert open_mapped(tmp_path / "first" / "mapped-samples").names == ["ball0"]
    more = ("--begin-with", tmp_path / "first", "--dwell", "3", "--memory-map", "--steps", "2")
    with pytest.raises(SystemExit):
        run("train", tmp_path / "samples", "--out", tmp_path / "second", *more)
    assert "--dwell needs all samples in memory" in capsys.readouterr().err


@pytest.mark.slow
def test_two_processes_train_as_one_and_each_goes_on_where_the_other_stopped(
    tmp_path: Path, run: Callable[..., None]
) -> None:
    samples = tmp_path / "samples"
    fresh = start_training(len(RADII), SPECS, CONFIG, CPU)
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        save_training(folder, fresh, CONFIG, [path.stem for path in write_balls(samples)])
    run("train", samples, "--out", one)
    done = two_processes("-m", "distrace", "train", samples, "--out", two)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("continuing from step 0 of 30") == 1  # one process prints
    assert_close(checkpoint(one), checkpoint(two))
    assert [json.loads(line)["step"] for line in (two / "metrics.jsonl").read_text().splitlines()] == [30]
    assert load_model(two).shapes == load_model(one).shapes

    for before, after in ((one, "one then one"), (one, "one then two"), (two, "two then one")):
        shutil.copytree(before, tmp_path / after)
    run("train", samples, "--out", tmp_path / "one then one", "--steps", "50")
    run("train", samples, "--out", tmp_path / "two then one", "--steps", "50")
    done = two_processes("-m", "distrace", "train", samples, "--out", tmp_path / "one then two", "--steps", "50")
    assert done.returncode == 0, done.stderr
    for name in ("two then one", "one then two"):
        assert_close(checkpoint(tmp_path / "one then one"), checkpoint(tmp_path / name))


SHARED = """
import sys
from pathlib import Path
import torch
from distrace.training.checkpointing import gathered, load_training, save_training, sharded
from distrace.training.distributed import joined
from distrace.training.mapped_samples import open_mapped
from distrace.training.trainer import train

folder = Path(sys.argv[1])
with joined(torch.device("cpu")) as (processes, device):
    samples = open_mapped(folder / "mapped")
    training, config = load_training(folder, samples.names, device)
    training = sharded(training, processes)
    assert len(training.codes) == 3 - processes.rank
    for step in train(samples, training, config, None, processes):
        pass
    training = gathered(training, processes, len(samples.names))
    if processes.leads:
        save_training(folder, training, config, samples.names)
"""


@pytest.mark.slow
def test_a_step_without_a_shape_of_ones_own_is_a_step_of_all(tmp_path: Path) -> None:
    paths = write_balls(tmp_path / "samples")
    map_samples(paths, tmp_path / "mapped")
    samples = open_mapped(tmp_path / "mapped")
    config = replace(CONFIG, shapes_per_step=1)  # which one process owns, and not the other
    training = start_training(len(RADII), SPECS, config, CPU)
    save_training(tmp_path, training, config, samples.names)
    (tmp_path / "shared.py").write_text(SHARED)
    done = two_processes(tmp_path / "shared.py", tmp_path)
    assert done.returncode == 0, done.stderr
    for _ in train(samples, training, config):
        pass
    shared = checkpoint(tmp_path)
    save_training(tmp_path, training, config, samples.names)
    assert_close(checkpoint(tmp_path), shared)
