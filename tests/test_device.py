"""Commands on a device that is not the CPU: everything that meets is on one."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import torch
from pretended import DEVICE, pretended, there
from test_train import finished, spheres

import distrace.cli.console
from distrace.camera import Camera
from distrace.checkpoint import load_model, save_experiment
from distrace.cli import _run
from distrace.data.photograph import Photograph
from distrace.data.view import View
from distrace.fitting.fit import FitConfig
from distrace.fitting.fit_code import CodeFitConfig
from distrace.fitting.methods import CLOUDS, METHODS, steps_of
from distrace.fitting.prior import prior_of
from distrace.photographs.fit_photos import fit_photos
from distrace.render import render
from distrace.training.train import TrainConfig

Command = Callable[..., None]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two spheres."""
    folder, samples = tmp_path_factory.mktemp("models") / "spheres", spheres(0.45, 0.6)
    training = finished(samples, TrainConfig(steps=300, samples_per_step=256, learning_rate=5e-3))
    save_experiment(folder, training.decoder, training.codes, tuple(samples.names))
    return folder


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Command]:
    """The command line, where `--device cuda` is the pretended one."""
    monkeypatch.setattr(distrace.cli.console, "chosen_device", lambda name: DEVICE)
    with pretended(monkeypatch):
        yield lambda *words: _run([str(word) for word in (*words, "--device", "cuda", "--out", tmp_path / "out")])
    torch.set_flush_denormal(False)


def test_tensors_of_two_devices_refuse_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    with pretended(monkeypatch):
        one, other = torch.ones(2, device="meta"), torch.ones(2)
        assert (one + there(other)).tolist() == [2.0, 2.0]
        assert one[torch.tensor([1])].device == DEVICE
        assert (one + other.to("meta")).cpu().tolist() == [2.0, 2.0]
        with pytest.raises(RuntimeError, match="found at least two devices"):
            one + other
        with pytest.raises(TypeError, match="to numpy"):
            one.numpy()


@pytest.mark.parametrize(
    "words",
    [
        "render {} --size 24 --clearance",
        "render {} --size 24 --strategy coarse_to_fine",
        "mesh {} --resolution 16",
    ],
)
def test_what_is_rendered_is_on_one_device(words: str, model: Path, command: Command, tmp_path: Path) -> None:
    command(*words.format(model).split())
    assert (tmp_path / "out" / "result.json").exists()


def test_what_is_fitted_is_on_the_models_device(model: Path, command: Command, tmp_path: Path) -> None:
    view, few = tmp_path / "out" / "view.npz", ("--iterations", 1, "--starts", 1, "--resolution", 16)
    command("render", model, "--size", 16)
    for words in (("complete", model, view, *few), ("pose", model, view, "--starts", 1, "--azimuth", 32)):
        (tmp_path / "out" / "result.json").unlink()
        command(*words)
        assert (tmp_path / "out" / "result.json").exists()


@pytest.mark.parametrize("method", [*METHODS, *CLOUDS])
def test_what_was_seen_is_brought_to_the_model(method: str, model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera.orbit(30, 20, 2.5, height=16, width=16, focal_px=16.0)
    with torch.no_grad():
        seen = render(load_model(model).field(1), camera)
        view = View(camera, seen.depth, seen.mask, seen.normal)
    for config in (CodeFitConfig(iterations=1, starts=1, stages=1), FitConfig(iterations=2, starts=1)):
        with pretended(monkeypatch):
            *_, last = steps_of(load_model(model).to("meta"), view, method, config)
            assert last.code.device == DEVICE
            assert last.code.cpu().isfinite().all()


def test_photographs_are_fitted_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    model = load_model("sofas")
    views = [Photograph(f"{k}", Camera.orbit(40 * k, 20, 3, height=8, width=8), torch.rand(8, 8, 3)) for k in (0, 1)]
    with pretended(monkeypatch):
        moved = model.to("meta")
        with pytest.raises(ValueError, match="photographs are fitted on the CPU"):
            next(fit_photos(moved.decoder, views, prior_of(moved.codes)))
