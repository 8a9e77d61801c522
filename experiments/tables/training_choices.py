"""What a class is best learnt from: small networks trained on its shapes and on more and more variants of them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median

import torch

from distrace.checkpoints.model import Model
from distrace.fields.decoder import NetworkSpecs
from distrace.training.batches import load_samples
from distrace.training.config import TrainConfig
from distrace.training.trainer import faster_in_bfloat16, start, train
from experiments.datasets.splits import on_side
from experiments.tables.completion import held_out_results, training_results

CPU = torch.device("cpu")
SPECS = NetworkSpecs((256,) * 8, code_length=128)
SHOWN = 10  # training shapes that are compared


@dataclass(frozen=True)
class Choice:
    """Which files of samples are learnt, and how."""

    name: str
    learnt: Callable[[str], bool]  # of a variant: "" of the shape itself, "mirrored", "warped1" …
    config: TrainConfig = TrainConfig()
    beside: bool = False  # other classes, whose samples are learnt, too
    visits: bool = False  # and as often a shape, by more steps


@dataclass(frozen=True)
class ChoiceRow:
    """Chamfer distances of some training shapes, and of the held-out ones fitted to all of their distances."""

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
    Choice("… variants drawn as often as shapes", lambda variant: True, TrainConfig(variant_weight=1.0)),
    Choice(
        "… wrong signs and large errors counted more", lambda variant: True, TrainConfig(wrong_sign=4.0, large=0.01)
    ),
    Choice("… codes held ten times tighter", lambda variant: True, TrainConfig(code_penalty=1e-3)),
    Choice("… beside other classes", lambda variant: True, beside=True),
    Choice("… beside other classes, each shape seen as often", lambda variant: True, beside=True, visits=True),
]


def choices_with(others: Sequence[Path]) -> list[Choice]:
    """Those that can be tried."""
    return [choice for choice in CHOICES if others or not choice.beside]


def choice_rows(
    samples: Path, split: str, meshes: Path, steps: int, resolution: int, others: Sequence[Path] = ()
) -> Iterator[ChoiceRow]:
    """Each choice with as many steps; `others` are folders of samples of other classes.

    Raises `ValueError` for missing samples or meshes.
    """
    learnt, held_out = (on_side(side, split) for side in ("train", "test"))
    bfloat16 = faster_in_bfloat16(SPECS, CPU)
    company = [path for folder in others for path in sorted(folder.glob("*.npz"))]
    for choice in choices_with(others):
        paths = [
            path
            for shape in learnt
            for path in sorted(samples.glob(f"{shape.name}.npz")) + sorted(samples.glob(f"{shape.name}~*.npz"))
            if choice.learnt(path.stem.partition("~")[2])
        ]
        if not paths:
            raise ValueError(f"{samples} holds no samples of {split}; `distrace sample --split {split}` makes them")
        everything = paths + company if choice.beside else paths
        taken = steps * len(everything) // len(paths) if choice.visits else steps
        model = _trained(everything, replace(choice.config, steps=taken, bfloat16=bfloat16))
        known = [shape for shape in learnt if shape.name in model.shapes]
        shown = known[:: max(len(known) // SHOWN, 1)]
        told = [result.chamfer for result in training_results(model, shown, meshes, resolution)]
        unseen = [result.chamfer for result in held_out_results(model, held_out, meshes, resolution)]
        yield ChoiceRow(choice.name, len(everything), taken, mean(told), median(unseen), mean(unseen))


def _trained(paths: list[Path], config: TrainConfig) -> Model:
    loaded = load_samples(paths)
    training = start(len(paths), SPECS, config, CPU)
    for _ in train(loaded, training, config):
        pass
    training.decoder.eval().requires_grad_(False)
    return Model("choice", training.decoder, training.codes.detach(), tuple(loaded.names))
