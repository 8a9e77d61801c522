"""Learning shapes: that it works, that a run goes on as if it had not been stopped, and what its files hold."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from statistics import mean

import numpy as np
import pytest
import torch
from spheres import Spheres
from torch import Tensor

import distrace.cli.train
import distrace.cli.training_run
from distrace.checkpoints.model import Model, load_model, save_experiment, save_model
from distrace.cli import main, train_samples
from distrace.data.samples import write_samples
from distrace.errors import DoubtfulResult
from distrace.fields.decoder import NetworkSpecs
from distrace.files import run_lock
from distrace.threads import flushed_denormals
from distrace.training.batches import Samples, Side, load_samples
from distrace.training.checkpointing import NAME, load_training, save_training
from distrace.training.config import TrainConfig
from distrace.training.fine_tuning import CERTAIN, REACH, Distillation, oversampled
from distrace.training.losses import training_loss
from distrace.training.trainer import Training, TrainingStep, begin_with, bound_codes, start_training, train

CPU = torch.device("cpu")
SPECS = NetworkSpecs(dims=(32, 32, 32), code_length=4, latent_in=(2,), norm_layers=(0, 1, 2))
CONFIG = TrainConfig(steps=12, samples_per_step=64)
RADII = (0.45, 0.6)
TINY = ("--steps", "120", "--samples-per-step", "32", "--layers", "3", "--width", "16", "--code-length", "4")


def of_sphere(radius: float, count: int = 3000, seed: int = 0) -> np.ndarray:
    """Signed samples: half of them near the surface."""
    random = np.random.default_rng(seed)
    direction = random.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance = np.where(np.arange(count) % 2, random.normal(0, 0.05, count), random.uniform(-radius, 1 - radius, count))
    return np.column_stack([direction * np.maximum(radius + distance, 0)[:, None], np.maximum(distance, -radius)])


def spheres(*radii: float) -> Samples:
    parts = [torch.from_numpy(of_sphere(radius)).float() for radius in radii]
    names = [f"sphere{number}" for number in range(len(radii))]
    outside = Side.of([part[part[:, 3] >= 0] for part in parts])
    return Samples(names, outside, Side.of([part[part[:, 3] < 0] for part in parts]))


def sample_files(folder: Path, *radii: float) -> Path:
    for number, radius in enumerate(radii):
        write_samples(folder / f"sphere{number}.npz", of_sphere(radius).astype(np.float32))
    return folder


def finished(samples: Samples, config: TrainConfig) -> Training:
    training = start_training(len(samples.names), SPECS, config, CPU)
    for _ in train(samples, training, config):
        pass
    return training


@cache
def two_spheres() -> Training:
    """Spheres of two radii, learnt in a second, once in a process."""
    return finished(spheres(*RADII), TrainConfig(steps=300, samples_per_step=256, learning_rate=5e-3))


def save_two_spheres(folder: Path) -> Path:
    """Writes them as a model."""
    training = two_spheres()
    save_experiment(folder, training.decoder, training.codes, ("sphere0", "sphere1"))
    return folder


def assert_same(one: Training, other: Training) -> None:
    assert one.step == other.step
    assert torch.equal(one.codes, other.codes)
    for name, value in one.decoder.state_dict().items():
        assert torch.equal(value, other.decoder.state_dict()[name]), name


def one_sentence(caught: pytest.ExceptionInfo, path: Path) -> None:
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The command line, in this process."""

    def command(*arguments: str | Path) -> None:
        monkeypatch.setattr(sys, "argv", ["distrace", *map(str, arguments)])
        main()

    return command


def test_a_tiny_network_learns_a_sphere() -> None:
    samples, config = spheres(0.5), TrainConfig(steps=300, samples_per_step=256, learning_rate=5e-3)
    training = start_training(1, SPECS, config, CPU)
    losses = [step.loss for step in train(samples, training, config)]
    assert sum(losses[-20:]) / 20 < sum(losses[:5]) / 5 / 5, "a fifth of the loss at the start"
    field = training.decoder.eval().field(training.codes[0].detach())
    along = torch.linspace(0.1, 0.9, 81)[:, None] * torch.tensor([0.6, 0.0, -0.8])
    with torch.no_grad():
        values = field(along)
    assert (values[:31] < 0).all(), "within 0.4"
    assert (values[50:] > 0).all(), "beyond 0.6"


def test_two_spheres_get_codes_of_their_own() -> None:
    samples, config = spheres(0.3, 0.6), TrainConfig(steps=300, samples_per_step=256, learning_rate=5e-3)
    training = finished(samples, config)
    at = torch.tensor([[0.0, 0.45, 0.0]])
    with torch.no_grad():
        small, large = (training.decoder.field(code)(at) for code in training.codes)
    assert small > 0.02
    assert large < -0.02


def test_a_draw_takes_as_many_samples_inside_as_outside_of_every_shape() -> None:
    torch.manual_seed(0)
    samples = spheres(0.3, 0.6, 0.5)
    shapes, rows = samples.draw(shapes=2, samples=64, variants=1.0)
    batch = samples.at(rows)
    assert len(set(shapes.tolist())) == 2
    assert batch.shape == (2, 32, 4)
    assert ((batch[..., 3] < 0).sum(1) == 16).all()
    for shape, points in zip(shapes, batch):
        radius = (0.3, 0.6, 0.5)[shape]
        torch.testing.assert_close(points[:, :3].norm(dim=-1) - radius, points[:, 3], atol=1e-5, rtol=0)


@pytest.mark.parametrize("stop", [1, 7])
def test_a_run_that_was_stopped_ends_bit_for_bit_like_one_that_was_not(tmp_path: Path, stop: int) -> None:
    samples = spheres(0.3, 0.6)
    first = start_training(2, SPECS, CONFIG, CPU)
    for _ in islice(train(samples, first, CONFIG), stop):
        pass
    save_training(tmp_path, first, CONFIG, samples.names)
    torch.manual_seed(99)  # what happened meanwhile is of no account
    loaded = load_training(tmp_path, samples.names, CPU)
    assert loaded is not None
    resumed, config = loaded
    assert config == CONFIG
    assert resumed.step == stop
    steps = [step.step for step in train(samples, resumed, config)]
    assert steps == list(range(stop + 1, CONFIG.steps + 1))
    assert_same(resumed, finished(samples, CONFIG))


def test_samples_of_wrong_sign_and_large_errors_count_more() -> None:
    values, distances = torch.tensor([0.01, 0.01, 0.3]), torch.tensor([0.02, -0.02, 0.05])
    errors = torch.tensor([0.01, 0.03, 0.05])  # beyond 0.1 all is far
    torch.testing.assert_close(training_loss(values, distances, CONFIG), errors.mean())
    wrong = training_loss(values, distances, replace(CONFIG, wrong_sign=4.0))
    torch.testing.assert_close(wrong, (errors * torch.tensor([1.0, 4.0, 1.0])).mean())
    large = training_loss(values, distances, replace(CONFIG, large=0.02))
    squared = torch.tensor([0.01, (0.03**2 + 0.02**2) / 0.04, (0.05**2 + 0.02**2) / 0.04])
    torch.testing.assert_close(large, squared.mean())


def test_a_run_keeps_the_mean_loss_of_every_hundred_steps() -> None:
    samples, config = spheres(0.5), replace(CONFIG, steps=230)
    training = start_training(1, SPECS, config, CPU)
    losses = [step.loss for step in train(samples, training, config)]
    assert training.losses == pytest.approx([mean(losses[:100]), mean(losses[100:200]), mean(losses[200:])])


def test_a_run_of_a_version_that_kept_no_losses_goes_on(tmp_path: Path) -> None:
    samples, config = spheres(0.5), replace(CONFIG, steps=130)
    first = start_training(1, SPECS, config, CPU)
    for _ in islice(train(samples, first, config), 120):
        pass
    save_training(tmp_path, first, config, samples.names)
    torch.save({name: value for name, value in checkpoint(tmp_path).items() if name != "losses"}, tmp_path / NAME)
    loaded = load_training(tmp_path, samples.names, CPU)
    assert loaded is not None
    assert [step.step for step in train(samples, *loaded)] == list(range(121, 131))
    assert len(loaded[0].losses) == 2


def test_another_seed_gives_another_network() -> None:
    one, other = (finished(spheres(0.5), replace(CONFIG, steps=1, seed=seed)) for seed in (0, 1))
    assert not torch.equal(one.codes, other.codes)
    assert not torch.equal(one.decoder.lin1.weight, other.decoder.lin1.weight)


def test_codes_stay_within_their_bound() -> None:
    config = replace(CONFIG, code_bound=0.05, code_learning_rate=0.1)
    norms = finished(spheres(0.3, 0.6), config).codes.norm(dim=-1)
    assert norms.max() <= 0.05 * (1 + 1e-6)
    assert finished(spheres(0.3, 0.6), replace(config, code_bound=9.0)).codes.norm(dim=-1).min() > 0.06


def test_only_codes_beyond_the_bound_are_scaled() -> None:
    codes = torch.tensor([[3.0, 4.0], [0.3, 0.4], [0.0, 0.0]])
    bound_codes(codes, 1.0)
    torch.testing.assert_close(codes, torch.tensor([[0.6, 0.8], [0.3, 0.4], [0.0, 0.0]]))


def test_a_trained_folder_opens_as_a_model(tmp_path: Path) -> None:
    samples = spheres(0.3, 0.6)
    training = finished(samples, CONFIG)
    save_experiment(tmp_path, training.decoder, training.codes, tuple(samples.names))
    model = load_model(tmp_path)
    assert model.shapes == ("sphere0", "sphere1")
    points = samples.outside.parts[0][:50, :3]
    with torch.no_grad():
        for number, code in enumerate(training.codes):
            torch.testing.assert_close(model.field(number)(points), training.decoder.field(code)(points))


def test_what_a_model_knows_is_where_another_training_begins(tmp_path: Path) -> None:
    first = finished(samples := spheres(0.3, 0.6), CONFIG)
    save_experiment(tmp_path / "trained", first.decoder, first.codes, tuple(samples.names))
    save_model(tmp_path / "bundled", model := load_model(tmp_path / "trained"))  # without weight norm
    points = samples.outside.parts[0][:50, :3]
    for name in ("trained", "bundled"):
        second = start_training(4, SPECS, CONFIG, CPU)
        begin_with(second, ["sphere1", "new", "sphere0", "sphere0~warped1"], load_model(tmp_path / name))
        assert_close = torch.testing.assert_close
        assert_close(second.codes[[2, 0]].detach(), model.codes, rtol=1e-3, atol=1e-3)
        assert_close(second.codes[1].detach(), model.codes.mean(0), rtol=1e-3, atol=1e-3)
        assert torch.equal(second.codes[3], second.codes[2]), "a variant's is its original's"
        with torch.no_grad():
            values = second.decoder.eval().field(model.codes[0])(points)
            assert_close(values, model.field(0)(points), rtol=1e-2, atol=1e-3)
        before = second.decoder.lin0.parametrizations.weight.original1.clone()
        next(train(spheres(0.3, 0.4, 0.6, 0.7), second, replace(CONFIG, warm_up=1)))
        assert not torch.equal(before, second.decoder.lin0.parametrizations.weight.original1), "the optimiser has it"


def test_a_model_is_learnt_further_from_both_sides_of_where_it_is_wrong() -> None:
    """A ball of 0.4 is wrong for one of 0.5 between them, and up to REACH away samples count as well."""
    samples = replace(spheres(0.5, 0.5, 0.5), names=["ball", "ball~1", "unknown"])
    model = Model("balls", Spheres(), torch.tensor([[0.4, 0, 0, 0]]).repeat(2, 1), ("ball", "ball~1"))
    dwelt = oversampled(samples, model, 5)
    radii = {}
    for side in ("outside", "inside"):
        before, after = getattr(samples, side).parts, getattr(dwelt, side).parts
        times = torch.tensor([(after[0] == sample).all(-1).sum() for sample in before[0]])
        assert set(times.tolist()) == {1, 5}
        assert all(torch.equal(after[other], before[other]) for other in (1, 2)), (
            "a variant, and what the model does not know"
        )
        radii[side] = before[0][:, :3].norm(dim=-1)
        radii[side, 5] = radii[side][times == 5]
    assert 0.5 <= radii["outside", 5].min() <= radii["outside", 5].max() < 0.5 + REACH
    assert radii["inside", 5].min() > 0.4 - REACH
    wrong = (radii["inside"] > 0.4) & (radii["inside"] < 0.5 - CERTAIN)
    assert torch.isin(radii["inside"][wrong], radii["inside", 5]).all()


def test_a_model_that_is_right_leaves_the_samples_as_they_are() -> None:
    samples = spheres(0.5)
    dwelt = oversampled(samples, Model("balls", Spheres(), torch.tensor([[0.5, 0, 0, 0]]), ("sphere0",)), 5)
    assert torch.equal(dwelt.outside.parts[0], samples.outside.parts[0])
    assert torch.equal(dwelt.inside.parts[0], samples.inside.parts[0])


def test_a_run_goes_on_at_the_rate_that_is_given(tmp_path: Path) -> None:
    samples = spheres(0.3, 0.6)
    save_training(tmp_path, finished(samples, CONFIG), CONFIG, samples.names)
    training, config = load_training(tmp_path, samples.names, CPU)
    other = replace(config, steps=1000, learning_rate=0.01, code_learning_rate=0.03)
    next(train(samples, training, other))
    share = min(1, (CONFIG.steps + 1) / CONFIG.warm_up)
    rates = [group["lr"] for group in training.optimiser.param_groups]
    assert rates == pytest.approx([0.01 * share, 0.03 * share])


@pytest.mark.parametrize("option", [("--dwell", "3"), ("--keep", "0.5")])
def test_a_run_that_looks_at_a_model_needs_it_when_it_goes_on(tmp_path: Path, run, capsys, option) -> None:
    samples, first, second = sample_files(tmp_path / "samples", 0.5), tmp_path / "first", tmp_path / "second"
    run("train", samples, "--out", first, *TINY[2:], "--steps", "3")
    run("train", samples, "--out", second, "--begin-with", first, "--steps", "2", *option)
    with pytest.raises(SystemExit):
        run("train", samples, "--out", second, "--steps", "4")
    assert "add --begin-with" in capsys.readouterr().err
    run("train", samples, "--out", second, "--steps", "4", "--begin-with", first)
    assert checkpoint(second)["step"] == 4


def test_a_model_stays_what_it_was_between_its_shapes_if_it_is_to(tmp_path: Path) -> None:
    """Learning a larger sphere further moves the field at other codes; less so the more it counts."""
    config = replace(CONFIG, steps=300, warm_up=10)
    known = finished(spheres(0.3, 0.6), config)
    save_experiment(tmp_path, known.decoder, known.codes, ("sphere0", "sphere1"))
    kept = Distillation.of(model := load_model(tmp_path), names := ["sphere0", "new", "sphere1"])
    points, codes = torch.rand(50, 200, 3) - 0.5, kept.drawn(torch.arange(3).repeat(50)[:50])
    changes = []
    for keep in (0.0, 10.0):
        training = start_training(3, SPECS, config, CPU)
        begin_with(training, names, model)
        for _ in train(replace(spheres(0.3, 0.45, 0.6), names=names), training, replace(config, keep=keep), kept):
            pass
        with torch.no_grad():
            now = training.decoder.eval()(points, codes[:, None])
        changes.append((now - kept.values(points, codes)).abs().mean())
    assert changes[1] < changes[0] / 3


def test_a_model_that_is_kept_keeps_the_shapes_that_no_sample_tells(tmp_path: Path, run) -> None:
    both, one = sample_files(tmp_path / "both", 0.3, 0.5), sample_files(tmp_path / "one", 0.3)
    run("train", both, "--out", tmp_path / "first", *TINY[2:], "--steps", "3")
    before = load_model(tmp_path / "first")
    run("train", one, "--out", tmp_path / "kept", "--begin-with", tmp_path / "first", "--steps", "2", "--keep", "1")
    run("train", one, "--out", tmp_path / "without", "--begin-with", tmp_path / "first", "--steps", "2")
    kept, without = load_model(tmp_path / "kept"), load_model(tmp_path / "without")
    assert without.shapes == before.shapes[:1]
    assert kept.shapes == before.shapes
    torch.testing.assert_close(kept.codes[1], before.codes[1])
    assert not torch.allclose(kept.codes[0], before.codes[0])


def test_codes_at_which_a_model_is_kept_are_as_usual_as_its_own() -> None:
    codes = 0.3 * torch.randn(40, 4, generator=torch.Generator().manual_seed(0)) + 1
    kept = Distillation.of(Model("some", Spheres(), codes, tuple(map(str, range(40)))), [*map(str, range(40)), "new"])
    torch.testing.assert_close(kept.codes[40], codes.mean(0))
    torch.manual_seed(0)
    drawn = torch.cat([kept.drawn(torch.arange(40)) for _ in range(200)])
    torch.testing.assert_close(drawn.mean(0), codes.mean(0), atol=0.02, rtol=0)
    assert ((drawn.std(0) / codes.std(0) - 1.06).abs() < 0.1).all()  # the prior has a least deviation
    nearness = torch.corrcoef(torch.stack([drawn[:, 3], codes[:, 3].repeat(200)]))[0, 1]
    assert 0.35 < nearness < 0.55  # the mean of 0 to 0.9


def test_a_model_of_another_size_cannot_be_kept(tmp_path: Path, run, capsys) -> None:
    samples, first, second = sample_files(tmp_path / "samples", 0.5), tmp_path / "first", tmp_path / "second"
    run("train", samples, "--out", first, *TINY[2:], "--steps", "3")
    run("train", samples, "--out", second, "--begin-with", first, "--steps", "2", "--keep", "1")
    with pytest.raises(SystemExit):
        run("train", samples, "--out", second, "--begin-with", "sofas", "--steps", "3")
    assert "has codes of another length than sofas" in capsys.readouterr().err


def test_a_folder_is_learnt_from_a_model_of_another_size(tmp_path: Path, run) -> None:
    samples, first = sample_files(tmp_path / "samples", 0.5), tmp_path / "first"
    run("train", samples, "--out", first, *TINY[2:], "--steps", "3")
    run("train", samples, "--out", tmp_path / "second", "--begin-with", first, "--steps", "1")
    assert load_model(tmp_path / "second").decoder.specs.dims == (16, 16, 16)


def test_there_is_no_run_to_go_on_with_in_an_empty_folder(tmp_path: Path) -> None:
    assert load_training(tmp_path, ["a"], CPU) is None


@pytest.mark.parametrize("damage", ["cut", "words", "empty", "other", "other-network", "losses", "step"])
def test_a_damaged_checkpoint_ends_in_one_sentence(tmp_path: Path, damage: str) -> None:
    path = tmp_path / NAME
    save_training(tmp_path, start_training(1, SPECS, CONFIG, CPU), CONFIG, ["a"])
    whole = path.read_bytes()
    changes = {"other-network": {"specs": {"dims": (8, 8)}}, "losses": {"losses": False}, "step": {"step": "some"}}
    if damage == "other":
        torch.save({"some": torch.zeros(3)}, path)
    elif damage in changes:
        torch.save(torch.load(path, weights_only=True) | changes[damage], path)
    else:
        path.write_bytes({"cut": whole[: len(whole) // 2], "words": b"no checkpoint", "empty": b""}[damage])
    with pytest.raises(ValueError, match="is not a checkpoint of a training run; move it away") as caught:
        load_training(tmp_path, ["a"], CPU)
    one_sentence(caught, path)


def test_a_checkpoint_of_other_samples_ends_in_one_sentence(tmp_path: Path) -> None:
    save_training(tmp_path, start_training(2, SPECS, CONFIG, CPU), CONFIG, ["a", "b"])
    for names in (["a"], ["a", "c"], ["a", "b", "c"]):
        with pytest.raises(ValueError, match="was trained on 2 files of samples, and now there are") as caught:
            load_training(tmp_path, names, CPU)
        one_sentence(caught, tmp_path / NAME)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"pos": np.ones((5, 4))}, "is not a file of samples"),
        ({"pos": np.ones((5, 4)), "neg": np.ones((5, 3))}, r"neg has shape \[5, 3\]"),
        ({"pos": np.ones((0, 4)), "neg": np.ones((5, 4))}, r"pos has shape \[0, 4\]"),
        ({"pos": np.full((5, 4), np.nan), "neg": np.ones((5, 4))}, "pos has no row of finite values"),
        ({"pos": np.ones((5, 4)), "neg": np.ones((5, 4))}, "none of the 5 distances in neg is negative"),
        ({"pos": -np.ones((5, 4)), "neg": np.ones((5, 4))}, "none of the 5 distances in pos is positive"),
        ({"pos": 500 * np.ones((5, 4)), "neg": -500 * np.ones((5, 4))}, "points lie 866 from the origin"),
        ({"pos": np.full((5, 4), 5e-4), "neg": -np.full((5, 4), 5e-4)}, "points lie 0.000866 from the origin"),
        ({"pos": np.array([[0.5, 0, 0, 90]]), "neg": np.array([[0.5, 0, 0, -50]])}, "up to 90 from the surface"),
        ({"pos": np.array([[None]], dtype=object), "neg": np.ones((5, 4))}, "is not a file of samples"),
        (None, "is not a file of samples"),
    ],
)
def test_what_is_no_file_of_samples_ends_in_one_sentence(tmp_path: Path, arrays: dict | None, message: str) -> None:
    path = tmp_path / "shape.npz"
    path.write_bytes(b"words")
    if arrays is not None:
        np.savez(path, **arrays)
    with pytest.raises(ValueError, match=message) as caught:
        load_samples([path])
    one_sentence(caught, path)


def test_rows_of_nan_are_dropped_and_counted(tmp_path: Path) -> None:
    samples = of_sphere(0.5).astype(np.float32)
    inside = samples[:, 3] < 0
    pos, neg = samples[~inside], samples[inside]
    pos[3, 3] = np.nan
    neg[:2, 0] = np.inf
    np.savez(tmp_path / "ball.npz", pos=pos, neg=neg)
    with pytest.warns(DoubtfulResult, match="^3 samples that are not finite were dropped$"):
        loaded = load_samples([tmp_path / "ball.npz"])
    assert torch.equal(loaded.outside.parts[0], torch.from_numpy(np.delete(pos, 3, axis=0)))
    assert torch.equal(loaded.inside.parts[0], torch.from_numpy(neg[2:]))


def test_samples_count_by_their_sign_on_whichever_side_they_are_stored(tmp_path: Path) -> None:
    samples = of_sphere(0.5).astype(np.float32)
    np.savez(tmp_path / "ball.npz", pos=samples[:2000], neg=samples[2000:])
    loaded = load_samples([tmp_path / "ball.npz"])
    assert (loaded.outside.parts[0][:, 3] >= 0).all()
    assert (loaded.inside.parts[0][:, 3] < 0).all()
    assert len(loaded.outside.parts[0]) + len(loaded.inside.parts[0]) == len(samples)


@pytest.mark.parametrize("below", ["SdfSamples", ".", "SdfSamples/ShapeNet"])
def test_samples_lie_below_a_folder_as_deepsdf_has_them(tmp_path: Path, below: str) -> None:
    """Beside them are meshes and archives of another kind, which are not learnt."""
    for name in ("chairs/1a", "chairs/2b", "sofas/1a"):
        path = tmp_path / "data/SdfSamples/ShapeNet" / f"{name}.npz"
        write_samples(path, of_sphere(0.5).astype(np.float32))
    if below == ".":
        (tmp_path / "data/SurfaceSamples/ShapeNet").mkdir(parents=True)
        (tmp_path / "data/SurfaceSamples/ShapeNet/1a.ply").touch()
        np.savez(tmp_path / "data/SurfaceSamples/1a.npz", offset=np.zeros(3))
    paths = train_samples.sample_files(tmp_path / "data" / below, tmp_path / "out")
    assert load_samples(paths).names == ["chairs-1a", "chairs-2b", "sofas-1a"]


def test_the_precision_that_a_stopwatch_chose_is_saved_before_the_first_step(tmp_path: Path, run, monkeypatch) -> None:
    samples, out = sample_files(tmp_path / "samples", 0.5), tmp_path / "model"
    monkeypatch.setattr(distrace.cli.train, "faster_in_bfloat16", lambda specs, device: True)

    def stopped(*given: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(distrace.cli.training_run, "run_training", stopped)
        with pytest.raises(SystemExit):
            run("train", samples, "--out", out, *TINY[2:], "--steps", "3")
    assert (checkpoint(out)["step"], checkpoint(out)["config"]["bfloat16"]) == (0, True)
    monkeypatch.setattr(distrace.cli.train, "faster_in_bfloat16", lambda specs, device: False)
    run("train", samples, "--out", out, "--steps", "3")
    assert json.loads((out / "result.json").read_text())["bfloat16"] is True


@pytest.mark.parametrize("before", [False, True])
def test_denormal_numbers_are_flushed_in_training_and_then_as_they_were(tmp_path: Path, run, before: bool) -> None:
    torch.set_flush_denormal(before)
    try:
        run("train", sample_files(tmp_path / "samples", 0.5), "--out", tmp_path / "model", *TINY[2:], "--steps", "2")
        with flushed_denormals():
            assert torch.tensor(1e-40) == 0
        assert (torch.tensor(1e-40) == 0).item() == before
    finally:
        torch.set_flush_denormal(False)


def checkpoint(folder: Path) -> dict:
    return torch.load(folder / NAME, weights_only=True)


def kill_once_saved(process: subprocess.Popen, folder: Path) -> None:
    """SIGKILL, as soon as there are steps to go on from."""
    patience = time.monotonic() + 300
    while not (folder / "preview.png").exists():
        assert process.poll() is None, "the run ended before it was killed"
        assert time.monotonic() < patience
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()


def assert_same_state(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


@pytest.mark.slow
def test_a_killed_run_goes_on_and_ends_like_one_that_was_not_killed(tmp_path: Path, run, monkeypatch) -> None:
    samples, killed, whole = sample_files(tmp_path / "samples", 0.3, 0.6), tmp_path / "killed", tmp_path / "whole"
    program = "import torch; torch.set_num_threads(1); from distrace.cli import main; main()"
    arguments = [sys.executable, "-c", program, "train", samples, "--out", killed, *TINY, "--save-every", "0"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(arguments, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    kill_once_saved(process, killed)
    state = checkpoint(killed)
    assert 0 < state["step"] < 120
    assert not (killed / "result.json").exists()

    run("train", samples, "--out", killed)  # its own configuration, not the default one, is gone on with
    chosen = state["config"]["bfloat16"]
    monkeypatch.setattr(distrace.cli.train, "faster_in_bfloat16", lambda specs, device: chosen)  # it is a stopwatch
    run("train", samples, "--out", whole, *TINY)

    one, other = checkpoint(killed), checkpoint(whole)
    assert one["step"] == other["step"] == 120
    assert one["config"] == other["config"]
    assert torch.equal(one["codes"], other["codes"])
    assert one["losses"] == other["losses"]
    assert_same_state(one["decoder"], other["decoder"])
    wanted = {"result.json", "specs.json", NAME, "preview.png", "losses.png", "metrics.jsonl"}
    wanted |= {"ModelParameters", "LatentCodes", ".lock"}
    assert {path.name for path in whole.iterdir()} == wanted
    assert load_model(whole).shapes == ("sphere0", "sphere1")


def test_a_run_that_is_done_does_nothing_more(tmp_path: Path, run, capsys: pytest.CaptureFixture) -> None:
    samples, out = sample_files(tmp_path / "samples", 0.5), tmp_path / "model"
    run("train", samples, "--out", out, *TINY[2:], "--steps", "3")
    before = checkpoint(out)
    capsys.readouterr()
    run("train", samples, "--out", out, "--steps", "3")
    assert "continuing from step 3 of 3" in capsys.readouterr().out
    assert_same_state(before["decoder"], checkpoint(out)["decoder"])
    assert json.loads((out / "result.json").read_text())["loss"] == before["losses"][-1]


def test_a_folder_that_another_run_is_writing_is_left_to_it(tmp_path: Path, run, capsys) -> None:
    samples, out = sample_files(tmp_path / "samples", 0.5), tmp_path / "model"
    out.mkdir()
    with run_lock(out), pytest.raises(SystemExit):
        run("train", samples, "--out", out, *TINY)
    assert f"another run is writing {out}; wait for its end, or give another --out" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == [".lock"]


def test_what_a_run_has_otherwise_is_not_taken_from_another_command(tmp_path: Path, run, capsys) -> None:
    samples, out = sample_files(tmp_path / "samples", 0.5), tmp_path / "model"
    run("train", samples, "--out", out, *TINY[2:], "--steps", "3")
    before = checkpoint(out)
    for given, message in (
        (("--width", "64"), "--width 64 was given, but the run in"),
        (("--samples-per-step", "3"), "--samples-per-step 3 was given"),
        (("--steps", "2"), "has done 3 already"),
    ):
        with pytest.raises(SystemExit) as stop:
            run("train", samples, "--out", out, *given)
        assert stop.value.code == 2
        assert message in " ".join(capsys.readouterr().err.split())
    assert_same_state(before["decoder"], checkpoint(out)["decoder"])


def test_a_training_that_diverges_keeps_what_was_saved_before(tmp_path: Path, run, capsys, monkeypatch) -> None:
    samples, out = sample_files(tmp_path / "samples", 0.5), tmp_path / "model"
    run("train", samples, "--out", out, *TINY[2:], "--steps", "3")
    before = checkpoint(out)
    lost = lambda *given: iter([TrainingStep(4, float("nan"), 0.1)])  # noqa: E731
    monkeypatch.setattr(distrace.cli.training_run, "run_training", lost)
    with pytest.raises(SystemExit):
        run("train", samples, "--out", out, "--steps", "9")
    assert "the training has diverged at step 4" in " ".join(capsys.readouterr().err.split())
    assert_same_state(before["decoder"], checkpoint(out)["decoder"])


def test_what_is_learnt_of_several_splits_is_what_any_of_them_trains_on(tmp_path: Path) -> None:
    columns = "name,split,design,turn,path,creator,licence"
    for name, rows in (("jets", ("a,train", "b,test")), ("parked", ("c,train", "d,out"))):
        lines = [f"{row},{row[0]},0,{row[0]}.ply,me,CC0-1.0" for row in rows]
        (tmp_path / f"{name}.csv").write_text("\n".join([columns, *lines]))
    samples = tmp_path / "samples"
    samples.mkdir()
    for name in ("a", "a~warped1", "b", "c", "d", "e"):
        (samples / f"{name}.npz").touch()
    splits = [tmp_path / f"{name}.csv" for name in ("jets", "parked")]
    assert [path.stem for path in train_samples.sample_files(samples, tmp_path, splits)] == ["a", "a~warped1", "c"]
    assert len(train_samples.sample_files(samples, tmp_path)) == 6
