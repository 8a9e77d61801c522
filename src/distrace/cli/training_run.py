"""The steps of `train`: how many fit into the time, their log, and the files that are saved on the way."""

import math
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from statistics import median_high

import torch

from distrace.antialiasing import clay_picture
from distrace.checkpoints.model import Model, save_experiment
from distrace.cli.common import Every, Orbit
from distrace.cli.console import Run, progress
from distrace.cli.metrics_log import Log, MetricsLog, is_due
from distrace.fields.decoder import NetworkSpecs
from distrace.render import render
from distrace.report.charts import plot_history
from distrace.shading import save_png, side_by_side
from distrace.training.batches import Samples
from distrace.training.checkpointing import gathered, save_training, sharded
from distrace.training.config import TrainConfig
from distrace.training.distributed import Processes
from distrace.training.fine_tuning import Distillation
from distrace.training.losses import STEPS_PER_LOSS
from distrace.training.trainer import Training, TrainingStep, start_training
from distrace.training.trainer import train as run_training

TRIAL_STEPS = 20  # timed to choose the steps for --minutes
PREVIEWED = 5  # shapes


@dataclass(frozen=True)
class TrainingRun:
    """What the steps of a run need, in one of its processes. Only the leader prints, and writes files."""

    run: Run
    samples: Samples
    config: TrainConfig
    distillation: Distillation | None
    processes: Processes

    def timed(self, minutes: float, specs: NetworkSpecs) -> TrainConfig:
        """Returns the configuration with the steps that fit into the time, by the median of a few trial steps."""
        fresh = start_training(len(self.samples.names), specs, self.config, self.run.device)
        steps = self._steps(sharded(fresh, self.processes), replace(self.config, steps=TRIAL_STEPS))
        seconds = median_high(step.seconds for step in steps)
        seconds = self.processes.from_leader(lambda: seconds)
        return replace(self.config, steps=max(int(minutes * 60 / seconds), TRIAL_STEPS))

    def train_to_end(self, training: Training, saving: Every, log: Log) -> float:
        """Trains to the last step, logs losses and saves checkpoints; returns the mean loss of the last steps."""
        loss = training.losses[-1] if training.losses else math.nan
        training = sharded(training, self.processes)
        with progress("training", self.config.steps) as bar, self._metrics(training.step, log) as metrics:
            for step in self._steps(training, self.config):
                if not math.isfinite(step.loss):
                    raise ValueError(
                        f"the training has diverged at step {step.step}; {self.run.out} has the last checkpoint; lower"
                        " --learning-rate or --wrong-sign, or look for wrong samples"
                    )
                loss = step.loss if math.isnan(loss) else 0.98 * loss + 0.02 * step.loss
                bar.advance(f"loss {loss:.5f}", to=step.step)
                if metrics is not None and is_due(step.step, self.config.steps):
                    rate = float(training.optimiser.param_groups[0]["lr"])
                    metrics.write(step.step, {"loss": training.losses[-1], "learning_rate": rate})
                if self.processes.from_leader(saving.passed):
                    self._save(training)
        self._save(training)
        return loss

    def _steps(self, training: Training, config: TrainConfig) -> Iterator[TrainingStep]:
        return run_training(self.samples, training, config, self.distillation, self.processes)

    def _metrics(self, step: int, log: Log) -> AbstractContextManager[MetricsLog | None]:
        return MetricsLog(self.run.out, step, log) if self.processes.leads else nullcontext()

    def _save(self, training: Training) -> None:
        """Writes the checkpoint, the model in DeepSDF's layout, the loss history, and previews of a few shapes."""
        names = self.samples.names
        training = gathered(training, self.processes, len(names))
        if not self.processes.leads:
            return
        out = self.run.out
        save_training(out, training, self.config, names)
        with self.run.optional("losses.png"):
            title = f"mean loss of {STEPS_PER_LOSS} steps"
            plot_history(out / "losses.png", training.losses, STEPS_PER_LOSS, "steps", title)
        others = self.distillation.others if self.distillation else {}
        codes = torch.stack([*training.codes.detach(), *others.values()])
        model = Model(out.name, training.decoder, codes, (*names, *others))
        save_experiment(out, model.decoder, model.codes, model.shapes)
        training.decoder.eval()
        camera = Orbit(size=128).camera().to(self.run.device)
        numbers = range(0, len(names), max(len(names) // PREVIEWED, 1))
        with torch.no_grad():
            pictures = [clay_picture(render(model.field(number), camera)) for number in numbers]
        training.decoder.train()
        save_png(out / "preview.png", side_by_side(pictures))
