"""Fitting from several starts, because a loss has many valleys: all are tried, the best goes on alone."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TypeVar

from jaxtyping import Float
from torch import Tensor

RECENT = 8  # iterations of a trial that are averaged: each may measure its loss on other rays


@dataclass(frozen=True)
class Starts:
    """How many starts, and how many iterations each is given before the choice; all draws follow from the seed."""

    iterations: int = 150
    starts: int = 3
    trial: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        if self.iterations < 1 or self.starts < 1:
            given = f"{self.iterations} iterations and {self.starts} starts"
            raise ValueError(f"{given} were asked for; both must be at least 1")

    @property
    def tried(self) -> int:
        """Iterations of each start before the choice; the best has at least one left to go on."""
        return min(self.trial, self.iterations - 1) if self.starts > 1 else 0

    @property
    def total(self) -> int:
        return self.iterations + self.tried * (self.starts - 1)


@dataclass(frozen=True)
class Step:
    """The code after an iteration, and the loss that it was taken from."""

    start: int
    iteration: int
    loss: float
    terms: dict[str, float]
    code: Float[Tensor, "length"]
    seconds: float
    evaluations: int = 0  # of the field


Stepped = TypeVar("Stepped", bound=Step)


def best_of(starts: Starts, run: Callable[[int], Iterator[Stepped]], recent: int = RECENT) -> Iterator[Stepped]:
    """The steps of all trials, then those of the start whose last losses are the least; the last step is the result."""
    runs = [run(start) for start in range(starts.starts)]
    if not starts.tried:
        yield from runs[0]
        return
    trials: list[list[Stepped]] = []
    for going in runs:
        trials.append([])
        for step in islice(going, starts.tried):
            yield step
            trials[-1].append(step)
    best = min(range(len(trials)), key=lambda start: _mean_loss(trials[start][-recent:]))
    yield next(runs[best], None) or replace(trials[best][-1], seconds=0.0, evaluations=0)  # it may have settled
    yield from runs[best]


def _mean_loss(steps: Sequence[Step]) -> float:
    return sum(step.loss for step in steps) / len(steps)
