"""`train`: from samples to a model, going on where it was stopped."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro

from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import Model, save_experiment
from distrace.cli.common import Every, opened
from distrace.cli.console import Run, console, progress, start
from distrace.cli.train_samples import sample_files
from distrace.fields.decoder import NetworkSpecs
from distrace.files import alone
from distrace.render import render
from distrace.report.charts import save_course
from distrace.report.completion_page import View
from distrace.shading import save_png, side_by_side
from distrace.threads import flushed_denormals
from distrace.training.batches import Samples, load_samples
from distrace.training.checkpointing import load_training, save_training
from distrace.training.config import TrainConfig
from distrace.training.distillation import Kept
from distrace.training.hard_samples import dwelling
from distrace.training.losses import COURSE
from distrace.training.trainer import Training, begin_with, faster_in_bfloat16
from distrace.training.trainer import start as start_training
from distrace.training.trainer import train as run_training

DEEPSDF = {"layers": 8, "width": 512, "code_length": 256}
TRIED = 20  # steps that tell how many fit into --minutes
PREVIEWED = 5


@dataclass(frozen=True)
class Train:
    """Train a DeepSDF decoder and the codes of its shapes. Run it again to go on after a stop."""

    samples: tyro.conf.Positional[Path]  # a folder of samples, as `sample` makes it, or of meshes
    out: Path = Path("out/model")
    split: tuple[Path, ...] = ()  # CSV files: learn only their training shapes and variants of these
    minutes: float | None = None  # as many steps as fit, at the speed of the first ones
    steps: int | None = None  # 36,000; more of them prolong a run that was stopped or is done
    wrong_sign: float | None = None  # 1; × as much counts a sample on the wrong side: what thin parts are lost by
    large: float | None = None  # errors above count by their squares; 0.02 keeps gaps open
    dwell: int | None = None  # 1; times a sample is drawn near places that --begin-with has on the wrong side
    keep: float | None = None  # 0; × as much as samples counts that --begin-with stays as it is between its shapes
    variant_weight: float | None = None  # 0.5; how often a variant or a procedural shape is drawn, to once the others
    learning_rate: float | None = None  # 0.001; less where a model is learnt further
    samples_per_step: int | None = None  # 2,048
    layers: int | None = None  # 8
    width: int | None = None  # 512
    code_length: int | None = None  # 256
    begin_with: str | None = None  # a model, bundled or in a folder, whose network and codes are learnt further
    seed: int | None = None  # 0
    save_every: float = 60.0  # seconds between checkpoints, of which a killed run loses at most one
    device: str = "cpu"

    def run(self) -> None:
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise ValueError(f"--minutes {self.minutes} was given; a finite time is needed, longer than none")
        saving = Every(self.save_every)
        run = start(self.out, self.device)
        with alone(run.out), flushed_denormals(), run.noticing():
            self._learn(run, saving)

    def _learn(self, run: Run, saving: Every) -> None:
        """All of it, from samples to the run's result."""
        loaded = load_samples(sample_files(self.samples, self.out, self.split)).to(run.device)
        known = None if self.begin_with is None else opened(self.begin_with, run.device)
        resumed = load_training(self.out, loaded.names, run.device)
        config = self._prolonged(*resumed) if resumed else self._fresh()
        kept = self._kept(config, known, loaded.names)
        if resumed:
            training = resumed[0]
            if kept and kept.codes.shape != training.codes.shape:
                raise ValueError(
                    f"the run in {self.out} has longer or shorter codes than {self.begin_with}; it began with another"
                )
            console.print(f"going on from step {training.step} of {config.steps}")
        else:
            training, config = self._begun(loaded, config, known, kept, run.device)
            save_training(self.out, training, config, loaded.names)  # what was timed is chosen once, and kept
        if known is not None and config.dwell > 1:
            console.print(f"looking where {known.name} is wrong")
            loaded = dwelling(loaded, known, config.dwell)
        loss = _run(run, loaded, training, config, kept, saving)
        facts = {"steps": training.step, "loss": loss, "shapes": len(loaded.names), "bfloat16": config.bfloat16}
        run.finish({**facts, "losses": training.losses})

    def _specs(self, known: Model | None) -> NetworkSpecs:
        """With weight norm, as DeepSDF has it; of a model's size if there is one."""
        said = _said(self, *DEEPSDF)
        if known is None:
            size = {**DEEPSDF, **said}
            layers, width, code_length = size.values()
            if min(layers, width) < 1:
                raise ValueError(f"--layers {layers} --width {width} were given; a network has at least one of each")
            return NetworkSpecs((width,) * layers, code_length, (layers // 2,), norm_layers=tuple(range(layers)))
        if said:
            sizes = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in said.items())
            raise ValueError(f"{sizes} was given beside --begin-with {known.name}, whose size the network takes")
        specs = known.decoder.specs
        if specs.norm_layers and not specs.weight_norm:
            raise ValueError(f"{known.name} has layer norms, which are not learnt further; train without --begin-with")
        return replace(specs, norm_layers=tuple(range(len(specs.dims))), weight_norm=True)

    def _fresh(self) -> TrainConfig:
        return replace(self._changed(TrainConfig()), **_said(self, "samples_per_step", "seed"))

    def _begun(
        self, samples: Samples, config: TrainConfig, known: Model | None, kept: Kept | None, device: torch.device
    ) -> tuple[Training, TrainConfig]:
        """A run at its first step, and for how many steps."""
        specs = self._specs(known)
        config = replace(config, bfloat16=faster_in_bfloat16(specs, device))
        training = start_training(len(samples.names), specs, config, device)
        if known is not None:
            begin_with(training, samples.names, known)
        if self.minutes is not None:
            config = _as_long_as(self.minutes, samples, specs, config, kept, device)
        return training, config

    def _kept(self, config: TrainConfig, known: Model | None, names: list[str]) -> Kept | None:
        """What is to stay of the model that is learnt further. Raises `ValueError` where none was given and one is."""
        if known is not None:
            return Kept.of(known, names) if config.keep else None
        if config.dwell > 1 or config.keep:
            raise ValueError(
                f"{self.out} is taught what a model has wrong or is to keep; add --begin-with and the model"
            )
        return None

    def _changed(self, config: TrainConfig) -> TrainConfig:
        """What was said replaces defaults, and what a run had before."""
        said = _said(self, "steps", "wrong_sign", "large", "dwell", "keep", "variant_weight", "learning_rate")
        if self.learning_rate is not None:
            said["code_learning_rate"] = 2 * self.learning_rate
        return replace(config, **said)

    def _prolonged(self, training: Training, config: TrainConfig) -> TrainConfig:
        """Raises `ValueError` where something was said that a run which goes on has otherwise, or did already."""
        specs = training.decoder.specs
        has = {"samples_per_step": config.samples_per_step, "seed": config.seed, "code_length": specs.code_length}
        has |= {"layers": len(specs.dims), "width": specs.dims[0]}
        for name, value in _said(self, *has).items():
            if value != has[name]:
                option = f"--{name.replace('_', '-')}"
                raise ValueError(
                    f"{option} {value} was given, but the run in {self.out} has {has[name]}; give another --out"
                )
        if self.steps is not None and self.steps < training.step:
            raise ValueError(
                f"--steps {self.steps} was given, but the run in {self.out} has done {training.step} already"
            )
        return self._changed(config)


def _said(command: Train, *names: str) -> dict[str, Any]:
    """Options that were given."""
    return {name: getattr(command, name) for name in names if getattr(command, name) is not None}


def _as_long_as(
    minutes: float, samples: Samples, specs: NetworkSpecs, config: TrainConfig, kept: Kept | None, device: torch.device
) -> TrainConfig:
    """The configuration with as many steps as fit into the time, by the median of a few on a training of their own."""
    trial = start_training(len(samples.names), specs, config, device)
    seconds = sorted(step.seconds for step in run_training(samples, trial, replace(config, steps=TRIED), kept))
    return replace(config, steps=max(int(minutes * 60 / seconds[TRIED // 2]), TRIED))


def _run(
    run: Run, samples: Samples, training: Training, config: TrainConfig, kept: Kept | None, saving: Every
) -> float:
    """Trains to the end, saving now and then; the mean loss of the last steps."""
    loss = training.losses[-1] if training.losses else math.nan
    with progress("training", config.steps) as bar:
        for step in run_training(samples, training, config, kept):
            if not math.isfinite(step.loss):
                raise ValueError(
                    f"the training has diverged at step {step.step}; {run.out} has what was saved before. Let wrong"
                    " signs and large errors count less, or look for samples that are far off"
                )
            loss = step.loss if math.isnan(loss) else 0.98 * loss + 0.02 * step.loss
            bar.advance(f"loss {loss:.5f}", to=step.step)
            if saving.passed():
                _save(run, samples, training, config, kept)
    _save(run, samples, training, config, kept)
    return loss


def _save(run: Run, samples: Samples, training: Training, config: TrainConfig, kept: Kept | None) -> None:
    """The checkpoint to go on from, the model in DeepSDF's layout, the loss so far, and a look at a few shapes."""
    save_training(run.out, training, config, samples.names)
    save_course(run.out / "losses.png", training.losses, COURSE, "steps", f"mean loss of {COURSE} steps")
    others = kept.others if kept else {}
    codes = torch.stack([*training.codes.detach(), *others.values()])
    model = Model(run.out.name, training.decoder, codes, (*samples.names, *others))
    save_experiment(run.out, model.decoder, model.codes, model.shapes)
    training.decoder.eval()
    camera = poster_view(128).to(run.device)
    shown = range(0, len(samples.names), max(len(samples.names) // PREVIEWED, 1))
    with torch.no_grad():
        save_png(run.out / "preview.png", side_by_side([View.of(render(model.field(n), camera)).shaded for n in shown]))
