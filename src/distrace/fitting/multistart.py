"""Fitting from several starts, because a loss has many valleys: all are tried, the best go on to their ends."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from math import inf
from statistics import fmean
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
    kept: int = 1  # starts that go on after the choice
    more: int = 0  # further starts, where several go on, one after the other, …
    hops: int = 0  # … and after these so many that begin at the best end, …
    doubtful: float = 0.0  # … while that one's verdict is above this
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.iterations, self.starts, self.kept) < 1:
            given = f"{self.iterations} iterations and {self.starts} starts, {self.kept} of them kept,"
            raise ValueError(f"{given} were asked for; each must be at least 1")

    @property
    def tried(self) -> int:
        """Iterations of each start before the choice; the best has at least one left to go on."""
        return min(self.trial, self.iterations - 1) if self.starts > 1 else 0

    @property
    def going_on(self) -> int:
        """How many starts there are after the choice."""
        return min(self.kept, self.starts) if self.tried else 1

    @property
    def apart(self) -> int:
        """Starts, at most, that do not begin at another's end."""
        return self.starts + (self.more if self.going_on > 1 else 0)

    @property
    def most(self) -> int:
        """Starts, at most."""
        return self.apart + (self.hops if self.going_on > 1 else 0)

    @property
    def total(self) -> int:
        """Steps, at most; where several starts go on, the best one's last is given again."""
        tried, ends = self.tried * self.starts, (self.iterations - self.tried) * self.going_on
        return tried + ends + (self.most - self.starts) * self.iterations + (self.going_on > 1)

    def __str__(self) -> str:
        tried = f", after {self.tried} of each of {self.starts}" if self.going_on < self.starts else ""
        more = f", of up to {self.most - self.starts} more while none fits" if self.most > self.starts else ""
        return f"{self.iterations} of {self.going_on} {'start' if self.going_on == 1 else 'starts'}{tried}{more}"


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
    verdict: float = inf  # how much it contradicts what was seen, where a judge was asked

    @property
    def name(self) -> str:
        """Of what it is a step."""
        return f"start {self.start + 1}"


def stages_of(iterations: int, count: int) -> list[tuple[int, int]]:
    """The numbers of stages, and how many of the iterations each has; those that would have none are left out."""
    ends = [iterations * stage // count for stage in range(count + 1)]
    return [(stage, end - begin) for stage, (begin, end) in enumerate(pairwise(ends)) if end > begin]


Stepped = TypeVar("Stepped", bound=Step)
Judge = Callable[[Stepped], Stepped]
"""From a last step to one with a verdict, and with the time and the evaluations that this took."""
Comparison = Callable[[Sequence[Sequence[Stepped]]], Sequence[Stepped]]
"""The same for the last steps of several trials, which may be judged by each other."""


def unjudged(step: Stepped) -> Stepped:
    """Its own loss tells, and costs nothing."""
    return replace(step, seconds=0.0, evaluations=0, verdict=step.loss)


def by_last_loss(trials: Sequence[Sequence[Stepped]]) -> list[Stepped]:
    return [unjudged(trial[-1]) for trial in trials]


def by_recent_losses(trials: Sequence[Sequence[Stepped]]) -> list[Stepped]:
    """By the means of their last losses."""
    return [replace(unjudged(trial[-1]), verdict=fmean(step.loss for step in trial[-RECENT:])) for trial in trials]


def best_of(
    starts: Starts,
    run: Callable[[int], Iterator[Stepped]],
    compare: Comparison[Stepped] = by_recent_losses,
    judge: Judge[Stepped] = unjudged,
    hop: Callable[[int, Stepped], Iterator[Stepped]] | None = None,
) -> Iterator[Stepped]:
    """The steps of all trials, then those of the starts whose verdicts are the least; the last step is the result.

    Of several that go on the judge tells which is best, and whether others are tried and, after these, some that hop
    from it: its step is given again, with what judging took.
    """
    runs = [run(start) for start in range(starts.starts)]
    if not starts.tried:
        yield from runs[0]
        return
    tried: list[list[Stepped]] = []
    for going in runs:
        tried.append([])
        for step in islice(going, starts.tried):
            yield step
            tried[-1].append(step)
    compared = compare(tried)
    order = sorted(range(len(tried)), key=lambda start: compared[start].verdict)[: starts.kept]
    if len(order) == 1:
        going = runs[order[0]]
        yield charged(next(going, None) or unjudged(tried[order[0]][-1]), compared)  # it may have settled
        yield from going
        return
    ends = [tried[start][-1] for start in order]
    for k, start in enumerate(order):
        for ends[k] in runs[start]:
            yield ends[k]
    verdicts = [judge(end) for end in ends]
    for start in range(starts.starts, starts.most):
        best = _best(verdicts)
        if best.verdict <= starts.doubtful:
            break
        end = best
        for end in hop(start, best) if hop and start >= starts.apart else run(start):
            yield end
        verdicts.append(judge(end))
    yield decided(verdicts, compared)


def decided(ends: Sequence[Stepped], compared: Sequence[Stepped] = ()) -> Stepped:
    """The best of judged ends, with what judging them, and all that was compared before, took."""
    return charged(replace(_best(ends), seconds=0.0, evaluations=0), [*compared, *ends])


def _best(judged: Sequence[Stepped]) -> Stepped:
    return min(judged, key=lambda step: step.verdict)


def charged(step: Stepped, others: Sequence[Stepped]) -> Stepped:
    """With what others took, too."""
    seconds, evaluations = (sum(getattr(each, spent) for each in others) for spent in ("seconds", "evaluations"))
    return replace(step, seconds=step.seconds + seconds, evaluations=step.evaluations + evaluations)
