"""Fits side by side: each is answered as it would be alone."""

import time
from collections.abc import Iterator

import pytest
import torch

from distrace import quickest
from distrace.checkpoint import load_model
from distrace.fitting.side_by_side import Fields, Groups
from distrace.fitting.starts import Step
from distrace.rounded import CHUNK

MODEL = load_model("sofas")


@pytest.fixture(autouse=True)
def rounded_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a processor that has them, whatever this one is."""
    monkeypatch.setattr(quickest, "_multiplies_in_bfloat16", lambda: True)


def points_of(fit: int, question: int) -> torch.Tensor:
    count = [3, 40, 2 * CHUNK + 1][(fit + question) % 3]
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(10 * fit + question)) - 0.5


def asking(fields: Fields, fit: int, questions: int) -> Iterator[Step]:
    """A fit that only asks, without derivatives, and gives the sum of what it is told as its loss."""
    field, total = fields.field(MODEL.codes[fit]), 0.0
    for question in range(questions):
        with torch.no_grad():
            total += float(field(points_of(fit, question)).double().sum())
        assert torch.is_grad_enabled(), "what another fit asks is no matter of this one"
        yield Step(fit, question, total, {}, MODEL.codes[fit], 1.0)


def test_each_is_answered_as_if_it_were_alone() -> None:
    fields = Fields(MODEL.decoder)
    together = fields.side_by_side([asking(fields, fit, fit + 1) for fit in range(4)])
    for fit, steps in enumerate(together):
        alone = list(asking(fields, fit, fit + 1))
        assert [step.loss for step in steps] == [step.loss for step in alone]
    assert fields.hub is None


def test_their_time_is_shared_out() -> None:
    fields = Fields(MODEL.decoder)
    began = time.perf_counter()
    steps = [step for steps in fields.side_by_side([asking(fields, fit, 3) for fit in range(2)]) for step in steps]
    taken = time.perf_counter() - began
    assert len({step.seconds for step in steps}) == 1
    assert taken / 2 < sum(step.seconds for step in steps) <= taken


def test_what_one_raises_is_raised() -> None:
    fields = Fields(MODEL.decoder)

    def failing() -> Iterator[Step]:
        yield from asking(fields, 0, 1)
        raise ValueError("no further")

    with pytest.raises(ValueError, match="no further"):
        fields.side_by_side([asking(fields, 1, 5), failing()])
    assert fields.hub is None
    assert len(list(asking(fields, 0, 2))) == 2, "the fields answer one alone again"


def test_a_group_runs_when_its_first_is_wanted() -> None:
    begun = []

    def fit(number: int) -> Iterator[Step]:
        begun.append(number)
        yield from asking(fields, number, 1)

    fields = Fields(MODEL.decoder)
    groups = Groups(fields, fit, [range(2), range(2, 5)])
    steps = groups.steps(1)
    assert not begun
    assert [step.start for step in steps] == [1]
    assert begun == [0, 1]
    assert [step.start for step in groups.steps(0)] == [0]
    assert begun == [0, 1]
    list(groups.steps(4))
    assert begun == [0, 1, 2, 3, 4]


def test_what_runs_in_vain_is_charged_too() -> None:
    fields = Fields(MODEL.decoder)
    groups = Groups(fields, lambda number: asking(fields, number, 2), [range(3)])
    wanted = list(groups.steps(0))
    unwanted = [step for number in (1, 2) for step in groups.done[number]]
    charged = groups.charge(wanted[-1])
    assert charged.seconds == pytest.approx(sum(step.seconds for step in unwanted))
    assert charged.loss == wanted[-1].loss
    list(groups.steps(1)), list(groups.steps(2))
    assert groups.charge(wanted[-1]).seconds == 0
