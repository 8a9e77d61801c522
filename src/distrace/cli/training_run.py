"""The steps of `train`: how many fit into the time, their log, and the files that are saved on the way."""

import math
from dataclasses import replace
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
from distrace.training.checkpointing import save_training
from distrace.training.config import TrainConfig
from distrace.training.fine_tuning import Distillation
from distrace.training.losses import STEPS_PER_LOSS
from distrace.training.trainer import Training, start_training
from distrace.training.trainer import train as run_training

TRIAL_STEPS = 20  # timed to choose the steps for --minutes
PREVIEWED = 5  # shapes


def timed(
    minutes: float,
    samples: Samples,
    specs: NetworkSpecs,
    config: TrainConfig,
    distillation: Distillation | None,
    device: torch.device,
) -> TrainConfig:
    """Returns the configuration with the steps that fit into the time, by the median of a few trial steps."""
    trial = start_training(len(samples.names), specs, config, device)
    steps = run_training(samples, trial, replace(config, steps=TRIAL_STEPS), distillation)
    seconds = median_high(step.seconds for step in steps)
    return replace(config, steps=max(int(minutes * 60 / seconds), TRIAL_STEPS))


def train_to_end(
    run: Run,
    samples: Samples,
    training: Training,
    config: TrainConfig,
    distillation: Distillation | None,
    saving: Every,
    log: Log,
) -> float:
    """Trains to the last step, logs losses and saves checkpoints; returns the mean loss of the last steps."""
    loss = training.losses[-1] if training.losses else math.nan
    with progress("training", config.steps) as bar, MetricsLog(run.out, training.step, log) as metrics:
        for step in run_training(samples, training, config, distillation):
            if not math.isfinite(step.loss):
                raise ValueError(
                    f"the training has diverged at step {step.step}; {run.out} has the last checkpoint; lower"
                    " --learning-rate or --wrong-sign, or look for wrong samples"
                )
            loss = step.loss if math.isnan(loss) else 0.98 * loss + 0.02 * step.loss
            bar.advance(f"loss {loss:.5f}", to=step.step)
            if is_due(step.step, config.steps):
                rate = float(training.optimiser.param_groups[0]["lr"])
                metrics.write(step.step, {"loss": training.losses[-1], "learning_rate": rate})
            if saving.passed():
                _save(run, samples, training, config, distillation)
    _save(run, samples, training, config, distillation)
    return loss


def _save(
    run: Run, samples: Samples, training: Training, config: TrainConfig, distillation: Distillation | None
) -> None:
    """Writes the checkpoint, the model in DeepSDF's layout, the loss history, and previews of a few shapes."""
    save_training(run.out, training, config, samples.names)
    with run.optional("losses.png"):
        plot_history(
            run.out / "losses.png", training.losses, STEPS_PER_LOSS, "steps", f"mean loss of {STEPS_PER_LOSS} steps"
        )
    others = distillation.others if distillation else {}
    codes = torch.stack([*training.codes.detach(), *others.values()])
    model = Model(run.out.name, training.decoder, codes, (*samples.names, *others))
    save_experiment(run.out, model.decoder, model.codes, model.shapes)
    training.decoder.eval()
    camera = Orbit(size=128).camera().to(run.device)
    numbers = range(0, len(samples.names), max(len(samples.names) // PREVIEWED, 1))
    with torch.no_grad():
        pictures = [clay_picture(render(model.field(number), camera)) for number in numbers]
    save_png(run.out / "preview.png", side_by_side(pictures))
