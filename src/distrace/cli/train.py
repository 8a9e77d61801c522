"""`train`: from samples to a model; an interrupted run continues when run again."""

import math
import warnings
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any

import tyro

from distrace.checkpoints.model import Model
from distrace.cli.common import NONE, Every, Flag, default, opened
from distrace.cli.console import Run, console, start
from distrace.cli.metrics_log import Log, check_log
from distrace.cli.train_colours import train_colours
from distrace.cli.train_samples import sample_files
from distrace.cli.training_run import TrainingRun
from distrace.fields.decoder import NetworkSpecs
from distrace.files import run_lock
from distrace.threads import flushed_denormals
from distrace.training.batches import Samples, load_samples
from distrace.training.checkpointing import load_training, save_training
from distrace.training.colours import ColourTrainConfig
from distrace.training.config import TrainConfig
from distrace.training.distributed import Processes, joined
from distrace.training.fine_tuning import Distillation, oversampled
from distrace.training.mapped_samples import map_samples, open_mapped
from distrace.training.trainer import Training, begin_with, faster_in_bfloat16, start_training

DEEPSDF = {"layers": 8, "width": 512, "code_length": 256}


@dataclass(frozen=True)
class Train:
    """Train a DeepSDF decoder and the codes of its shapes.

    A run that was interrupted continues when run again. It keeps its options, unless others are given. `torchrun
    --nproc-per-node 2 .venv/bin/distrace train …` trains in two processes.
    """

    samples: tyro.conf.Positional[Path]  # a folder of samples, as `sample` makes it, or of meshes
    out: Path = Path("out/model")
    split: Annotated[tuple[Path, ...], NONE] = ()
    """CSV files: train only on their training shapes and variants of these"""
    minutes: Annotated[float | None, default("no limit", "FLOAT")] = None
    """wall-clock time; it sets the number of steps"""
    steps: Annotated[int | None, default(TrainConfig.steps)] = None  # a larger number prolongs a finished run
    wrong_sign: Annotated[float | None, default(TrainConfig.wrong_sign)] = None
    """loss weight of samples whose predicted sign is wrong; raise it when thin parts vanish"""
    large: Annotated[float | None, default(TrainConfig.large)] = None
    """errors above this count by their squares; 0.02 keeps gaps open"""
    dwell: Annotated[int | None, default(TrainConfig.dwell)] = None
    """oversampling factor near places where --begin-with has the wrong sign"""
    keep: Annotated[float | None, default(TrainConfig.keep)] = None
    """loss weight of the distillation term, which keeps --begin-with between its shapes"""
    variant_weight: Annotated[float | None, default(TrainConfig.variant_weight)] = None
    """sampling weight of variants and procedural shapes; the others have 1"""
    learning_rate: Annotated[float | None, default(TrainConfig.learning_rate)] = None  # lower it with --begin-with
    samples_per_step: Annotated[int | None, default(TrainConfig.samples_per_step)] = None
    layers: Annotated[int | None, default(DEEPSDF["layers"])] = None
    width: Annotated[int | None, default(DEEPSDF["width"])] = None
    code_length: Annotated[int | None, default(DEEPSDF["code_length"])] = None
    begin_with: Annotated[str | None, default("none", "MODEL")] = None  # a model to continue training from
    colour: Flag = False
    """train colours for the shapes of --begin-with, which stay as they are, from a folder of textured meshes"""
    seed: Annotated[int | None, default(TrainConfig.seed)] = None
    memory_map: Flag = False  # read samples from the disk when they are drawn; several processes always do
    save_every: float = 60.0  # seconds between checkpoints
    log: Log = "none"  # beside metrics.jsonl, write event files to OUT/tensorboard
    device: str = "cpu"

    def run(self) -> None:
        if self.minutes is not None and not 0 < self.minutes < math.inf:
            raise ValueError(f"--minutes {self.minutes} was given; it must be finite and above 0")
        saving = Every(self.save_every)
        check_log(self.log)
        if self.colour:
            self._colours()
            return
        run = start(self.out, self.device)
        with joined(run.device) as (processes, run.device), flushed_denormals(), ExitStack() as stack:
            processes.from_leader(lambda: stack.enter_context(run_lock(run.out)))
            stack.enter_context(run.noticing())
            if not processes.leads:
                console.quiet = True
                warnings.simplefilter("ignore")
            self._train(run, processes, saving)

    def _colours(self) -> None:
        """Trains colours. Raises `ValueError` without a model, and for options that they do not use."""
        if self.begin_with is None:
            raise ValueError("--colour was given without --begin-with, which names the model to add colours to")
        used = ("samples", "out", "split", "begin_with", "colour", "steps", "seed", "device")
        for field in fields(self):
            if field.name not in used and getattr(self, field.name) != field.default:
                option = field.name.replace("_", "-")
                raise ValueError(f"--{option} was given, which --colour does not use; leave it out")
        run = start(self.out, self.device)
        with run_lock(run.out), flushed_denormals(), run.noticing():
            config = replace(ColourTrainConfig(), **_given(self, "steps", "seed"))
            train_colours(run, self.samples, self.split, self.begin_with, config)

    def _train(self, run: Run, processes: Processes, saving: Every) -> None:
        samples = self._samples(run, processes)
        initial = None if self.begin_with is None else opened(self.begin_with, run.device)
        resumed = load_training(self.out, samples.names, run.device)
        processes.wait()  # until all have read the checkpoint, which the leader is about to write
        config = self._prolonged(*resumed) if resumed else self._fresh()
        distillation = self._distillation(config, initial, samples.names)
        job = TrainingRun(run, samples, config, distillation, processes)
        if resumed:
            training = resumed[0]
            if distillation and distillation.codes.shape != training.codes.shape:
                raise ValueError(
                    f"the run in {self.out} has codes of another length than {self.begin_with}; give another --out"
                )
            console.print(f"continuing from step {training.step} of {config.steps}")
        else:
            training, job = self._initialised(job, initial)
            if processes.leads:
                save_training(self.out, training, job.config, samples.names)  # timed choices stay in a resumed run
        if initial is not None and config.dwell > 1:
            if self.memory_map or processes.size > 1:
                raise ValueError("--dwell needs all samples in memory; train in one process, without --memory-map")
            console.print(f"finding samples whose sign {initial.name} has wrong")
            job = replace(job, samples=oversampled(samples, initial, config.dwell))
        loss = job.train_to_end(training, saving, self.log)
        if processes.leads:
            facts = {"steps": job.config.steps, "loss": loss, "shapes": len(samples.names)}
            run.finish({**facts, "bfloat16": job.config.bfloat16, "losses": training.losses})

    def _samples(self, run: Run, processes: Processes) -> Samples:
        """Returns the samples, in memory or mapped. Raises `ValueError` for more processes than shapes."""
        paths = processes.from_leader(lambda: sample_files(self.samples, self.out, self.split))
        if processes.size > len(paths):
            raise ValueError(
                f"{processes.size} processes were started for {len(paths)} shapes; each needs one at least"
            )
        if processes.size == 1 and not self.memory_map:
            return load_samples(paths).to(run.device)
        if self.dwell is not None and self.dwell > 1:
            raise ValueError("--dwell needs all samples in memory; train in one process, without --memory-map")
        folder = run.out / "mapped-samples"
        processes.from_leader(lambda: map_samples(paths, folder))
        return open_mapped(folder)

    def _specs(self, initial: Model | None) -> NetworkSpecs:
        """Returns a network with weight norm, as DeepSDF's, of the initial model's size if there is one."""
        given = _given(self, *DEEPSDF)
        if initial is None:
            layers, width, code_length = {**DEEPSDF, **given}.values()
            if min(layers, width) < 1:
                raise ValueError(f"--layers {layers} --width {width} were given; a network has at least one of each")
            return NetworkSpecs((width,) * layers, code_length, (layers // 2,), norm_layers=tuple(range(layers)))
        if given:
            sizes = " ".join(f"--{name.replace('_', '-')} {value}" for name, value in given.items())
            raise ValueError(f"{sizes} was given beside --begin-with {initial.name}, whose size the network takes")
        specs = initial.decoder.specs
        if specs.norm_layers and not specs.weight_norm:
            raise ValueError(f"{initial.name} has layer norms, which cannot be trained; omit --begin-with")
        return replace(specs, norm_layers=tuple(range(len(specs.dims))), weight_norm=True)

    def _fresh(self) -> TrainConfig:
        return replace(self._changed(TrainConfig()), **_given(self, "samples_per_step", "seed"))

    def _initialised(self, job: TrainingRun, initial: Model | None) -> tuple[Training, TrainingRun]:
        """Returns a run before its first step, and its job with the choices that a stopwatch made."""
        specs = self._specs(initial)
        device = job.run.device
        bfloat16 = job.processes.from_leader(lambda: faster_in_bfloat16(specs, device))
        job = replace(job, config=replace(job.config, bfloat16=bfloat16))
        names = job.samples.names
        training = start_training(len(names), specs, job.config, device)
        if initial is not None:
            begin_with(training, names, initial)
        if self.minutes is not None:
            job = replace(job, config=job.timed(self.minutes, specs))
        return training, job

    def _distillation(self, config: TrainConfig, initial: Model | None, names: list[str]) -> Distillation | None:
        """Returns the distillation's teacher, if any. Raises `ValueError` for options that lack --begin-with."""
        if initial is not None:
            return Distillation.of(initial, names) if config.keep else None
        if config.dwell > 1 or config.keep:
            raise ValueError(f"the run in {self.out} uses --dwell or --keep; add --begin-with and the model")
        return None

    def _changed(self, config: TrainConfig) -> TrainConfig:
        """Returns the configuration with the given options."""
        given = _given(self, "steps", "wrong_sign", "large", "dwell", "keep", "variant_weight", "learning_rate")
        if self.learning_rate is not None:
            given["code_learning_rate"] = 2 * self.learning_rate
        return replace(config, **given)

    def _prolonged(self, training: Training, config: TrainConfig) -> TrainConfig:
        """Returns a resumed run's configuration. Raises `ValueError` for options that a run cannot change."""
        specs = training.decoder.specs
        has = {"samples_per_step": config.samples_per_step, "seed": config.seed, "code_length": specs.code_length}
        has |= {"layers": len(specs.dims), "width": specs.dims[0]}
        for name, value in _given(self, *has).items():
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


def _given(command: Train, *names: str) -> dict[str, Any]:
    """Returns the options that were given."""
    return {name: getattr(command, name) for name in names if getattr(command, name) is not None}
