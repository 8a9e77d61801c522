"""Training sets and losses compared: small networks trained on a class and on more and more variants."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median

import torch

from distrace.checkpoints.model import Model
from distrace.fields.decoder import NetworkSpecs
from distrace.training.batches import load_samples
from distrace.training.config import TrainConfig
from distrace.training.trainer import faster_in_bfloat16, start_training, train
from experiments.datasets.splits import on_side
from experiments.tables.completion import held_out_results, training_results

CPU = torch.device("cpu")
SPECS = NetworkSpecs((256,) * 8, code_length=128)
COMPARED = 10  # training shapes


@dataclass(frozen=True)
class Choice:
    """The files of samples to train on, and how."""

    name: str
    learnt: Callable[[str], bool]  # by variant: "" (the shape itself), "mirrored", "warped1" …
    config: TrainConfig = TrainConfig()
    other_classes: bool = False  # train on their samples, too
    same_visits: bool = False  # take more steps, so that each shape is visited as often


@dataclass(frozen=True)
class ChoiceRow:
    """Chamfer distances of training shapes, and of held-out ones fitted to all of their distances."""

    choice: str
    codes: int
    steps: int
    train_mean: float
    held_out_median: float
    held_out_mean: float


CHOICES = [
    Choice("the shapes alone", lambda variant: not variant),
    Choice("and mirrored", lambda variant: not variant.startswith("warped")),
    Choice("and warped twice", lambda variant: variant not in ("warped3", "warped4")),
    Choice("and warped four times", lambda variant: True),
    Choice("… variants sampled as often as shapes", lambda variant: True, TrainConfig(variant_weight=1.0)),
    Choice(
        "… wrong signs and large errors counted more", lambda variant: True, TrainConfig(wrong_sign=4.0, large=0.01)
    ),
    Choice("… codes held ten times tighter", lambda variant: True, TrainConfig(code_penalty=1e-3)),
    Choice("… with other classes", lambda variant: True, other_classes=True),
    Choice(
        "… with other classes, each shape visited as often", lambda variant: True, other_classes=True, same_visits=True
    ),
]


def choices_with(others: Sequence[Path]) -> list[Choice]:
    """Returns the choices that the given folders allow."""
    return [choice for choice in CHOICES if others or not choice.other_classes]


def choice_rows(
    samples: Path, split: str, meshes: Path, steps: int, resolution: int, others: Sequence[Path] = ()
) -> Iterator[ChoiceRow]:
    """Yields each choice, trained for the same steps; `others` are folders of samples of other classes.

    Raises `ValueError` for missing samples or meshes.
    """
    training = on_side("train", split)
    held_out = on_side("test", split)
    bfloat16 = faster_in_bfloat16(SPECS, CPU)
    other_paths = [path for folder in others for path in sorted(folder.glob("*.npz"))]
    for choice in choices_with(others):
        paths = [
            path
            for shape in training
            for path in sorted(samples.glob(f"{shape.name}.npz")) + sorted(samples.glob(f"{shape.name}~*.npz"))
            if choice.learnt(path.stem.partition("~")[2])
        ]
        if not paths:
            raise ValueError(f"{samples} holds no samples of {split}; `distrace sample --split {split}` makes them")
        all_paths = paths + other_paths if choice.other_classes else paths
        total_steps = steps * len(all_paths) // len(paths) if choice.same_visits else steps
        model = _trained(all_paths, replace(choice.config, steps=total_steps, bfloat16=bfloat16))
        learnt = [shape for shape in training if shape.name in model.shapes]
        compared = learnt[:: max(len(learnt) // COMPARED, 1)]
        trained = [result.chamfer for result in training_results(model, compared, meshes, resolution)]
        unseen = [result.chamfer for result in held_out_results(model, held_out, meshes, resolution)]
        yield ChoiceRow(choice.name, len(all_paths), total_steps, mean(trained), median(unseen), mean(unseen))


def _trained(paths: list[Path], config: TrainConfig) -> Model:
    loaded = load_samples(paths)
    training = start_training(len(paths), SPECS, config, CPU)
    for _ in train(loaded, training, config):
        pass
    training.decoder.eval().requires_grad_(False)
    return Model("choice", training.decoder, training.codes.detach(), tuple(loaded.names))
