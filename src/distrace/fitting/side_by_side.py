"""Fits side by side: what several ask of their fields at a time is answered by one product a layer.

A fit asks for some dozens of points, and a product of so few takes nearly as long as one of hundreds. So each runs in a
greenlet until it asks, and when all have asked all are answered; each ends where it would end alone.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, Generic

import torch
from greenlet import getcurrent, greenlet
from jaxtyping import Float
from torch import Tensor

from distrace.decoder import Decoder
from distrace.field import SDF, chunked
from distrace.fitting.starts import Stepped, charged
from distrace.quickest import quickest
from distrace.rounded import CHUNK, Rounded

Values = Float[Tensor, "_"]
Asked = tuple[Float[Tensor, "length"], Float[Tensor, "_ 3"]]
"""A code, and points to have its shape's values at."""


class Fields:
    """A decoder's, as this machine has them quickest: for one fit, or for several side by side."""

    def __init__(self, decoder: Decoder) -> None:
        self.quick = quickest(decoder)
        self.hub: greenlet | None = None  # where fits that run side by side are answered

    def field(self, code: Float[Tensor, "length"]) -> SDF:
        """Of one shape."""
        if self.hub is None or not isinstance(self.quick, Rounded):
            return self.quick.field(code)

        def evaluate(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
            assert self.hub is not None
            return _switched(self.hub, (code, points.reshape(-1, 3))).reshape(points.shape[:-1])

        return chunked(evaluate, CHUNK)

    def side_by_side(self, fits: Sequence[Iterator[Stepped]]) -> list[list[Stepped]]:
        """All steps of each. The time that these took is shared out among them."""
        began, ends = time.perf_counter(), [list[Stepped]() for _ in fits]
        self.hub = getcurrent()
        try:
            self._answer([greenlet(steps.extend) for steps in ends], fits)
        finally:
            self.hub = None
        share = (time.perf_counter() - began) / max(sum(step.seconds for steps in ends for step in steps), 1e-9)
        return [[replace(step, seconds=step.seconds * share) for step in steps] for steps in ends]

    def _answer(self, running: list[greenlet], fits: Sequence[Iterator[Stepped]]) -> None:
        """Until none asks any more."""
        asked = [(fit, _switched(fit, steps)) for fit, steps in zip(running, fits, strict=True)]
        while asked := [(fit, question) for fit, question in asked if not fit.dead]:
            answers = self._answers([question for _, question in asked])
            asked = [(fit, _switched(fit, answer)) for (fit, _), answer in zip(asked, answers, strict=True)]

    def _answers(self, questions: Sequence[Asked]) -> list[Values]:
        """As many at a time as the cache has room for."""
        assert isinstance(self.quick, Rounded)
        answers: list[Values] = []
        together: list[Asked] = []
        for question in questions:
            if sum(len(points) for _, points in [*together, question]) > CHUNK:
                answers += self._together(together)
                together = []
            together.append(question)
        return answers + self._together(together)

    def _together(self, questions: Sequence[Asked]) -> list[Values]:
        if not questions:
            return []
        counts = [len(points) for _, points in questions]
        shape = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        field = self.quick.fields(torch.stack([code for code, _ in questions])).select(shape)
        return list(field(torch.cat([points for _, points in questions])).split(counts))


class Groups(Generic[Stepped]):
    """Fits by their numbers; those of a group run side by side, once the first of them is wanted."""

    def __init__(self, fields: Fields, fit: Callable[[int], Iterator[Stepped]], groups: Sequence[range]) -> None:
        self.fields, self.fit, self.groups = fields, fit, groups
        self.done: dict[int, list[Stepped]] = {}
        self.wanted: set[int] = set()

    def steps(self, number: int) -> Iterator[Stepped]:
        """Of the fit of this number."""
        if number not in self.done:
            group = next(group for group in self.groups if number in group)
            self.done |= zip(group, self.fields.side_by_side([self.fit(each) for each in group]), strict=True)
        self.wanted.add(number)
        yield from self.done[number]

    def charge(self, step: Stepped) -> Stepped:
        """A step with what only those fits took that ran beside others and were not wanted."""
        unwanted = [each for number, steps in self.done.items() if number not in self.wanted for each in steps]
        return charged(replace(step, seconds=0.0, evaluations=0), unwanted)


def _switched(other: greenlet, value: object) -> Any:
    """What a switch gives back; whether derivatives are recorded is each greenlet's own."""
    recorded = torch.is_grad_enabled()
    try:
        return other.switch(value)
    finally:
        torch.set_grad_enabled(recorded)
