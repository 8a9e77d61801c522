"""Commands on a device that is not the CPU: everything that meets is on one."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from pretended import DEVICE, pretended, there
from test_train import save_two_spheres

import distrace.cli.console
from distrace.camera import Camera
from distrace.checkpoints.model import load_model
from distrace.cli import multiview, parsed, pose
from distrace.data.observation import View
from distrace.data.photograph import Photograph
from distrace.data.photographs import Photographs, save_photographs
from distrace.data.unit_sphere import UnitSphere
from distrace.fitting.fit import FitConfig
from distrace.fitting.fit_code import CodeFitConfig
from distrace.render import render
from distrace.report import views_page
from experiments.baselines.deepsdf import SampleFitConfig
from experiments.tables import methods
from experiments.tables.methods import CLOUDS, METHODS, completed_by, observation_of

Command = Callable[..., None]


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_two_spheres(tmp_path_factory.mktemp("models") / "spheres")


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Command]:
    """The command line, where `--device cuda` is the pretended one."""
    monkeypatch.setattr(distrace.cli.console, "chosen_device", lambda name: DEVICE)
    with pretended(monkeypatch):
        options = ("--device", "cuda", "--out", tmp_path / "out")
        yield lambda *words: parsed([str(word) for word in (*words, *options)]).run()
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


@pytest.mark.slow
def test_what_is_fitted_is_on_the_models_device(
    model: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose, "FRAMES", 2)
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
    monkeypatch.setattr(methods, "DEEPSDF", SampleFitConfig(samples=100, iterations=3))
    for config in (CodeFitConfig(iterations=1, starts=1), FitConfig(iterations=2, starts=1)):
        with pretended(monkeypatch):
            fit = completed_by(method, load_model(model).to("meta"), observation_of(view, method), config)
            assert fit.code.device == DEVICE
            assert fit.code.cpu().isfinite().all()


@pytest.fixture
def photographs(model: Path, tmp_path: Path) -> Path:
    """Three of a sphere, of which the first has a mask."""
    views = []
    for k in range(3):
        camera = Camera.orbit(25 * k, 20, 3, height=24, width=24, focal_px=30.0)
        with torch.no_grad():
            seen = render(load_model(model).field(1), camera)
        image = torch.where(seen.mask[..., None], 0.5 + 0.4 * seen.normal, 0.1)
        views.append(Photograph(f"{k}", camera, image, seen.mask if k == 0 else None))
    unit_sphere = UnitSphere(torch.zeros(3).double(), 1.0)
    save_photographs(tmp_path / "views", Photographs(tuple(views), unit_sphere, "ours"))
    return tmp_path / "views"


@pytest.mark.slow
@pytest.mark.parametrize("more", [(), ("--changing-light", "--fixed")])
def test_photographs_are_brought_to_the_model(
    more: tuple[str, ...],
    model: Path,
    photographs: Path,
    command: Command,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, little in (("SHOWN", 1), ("FRAMES", 1), ("SIZE", 24)):
        monkeypatch.setattr(views_page, name, little)
    for name in ("KNOWN_PLACE", "UNKNOWN_PLACE"):
        short = replace(
            getattr(multiview, name), rounds=2, coarse_rounds=1, iterations=2, trial_rounds=1, place_rounds=1
        )
        monkeypatch.setattr(multiview, name, short)
    command("multiview", model, photographs, *more, "--starts", 2, "--rays", 200, "--resolution", 16)
    assert (tmp_path / "out" / "result.json").exists()
