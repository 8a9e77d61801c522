"""Several starts: which of them goes on, and how many steps that takes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import pytest
import torch

from distrace.fitting.multistart import Starts, Step, best_of, by_last_loss, by_recent_losses, stages_of

Compare = Callable[[Sequence[Sequence[Step]]], Sequence[Step]]


def run(losses: list[list[float]], starts: Starts, compare: Compare = by_recent_losses) -> list[tuple[int, int, float]]:
    """Starts, iterations and losses of the steps, where each start's losses are known before."""

    def going(start: int) -> Iterator[Step]:
        for iteration, loss in enumerate(losses[start], 1):
            yield Step(start, iteration, loss, {}, torch.zeros(2), seconds=1.0, evaluations=10)

    return [(step.start, step.iteration, step.seconds) for step in best_of(starts, going, compare)]


def test_all_are_tried_and_the_best_goes_on() -> None:
    steps = run([[9, 8, 7, 6], [9, 5, 4, 3], [9, 6, 5, 4]], Starts(iterations=4, starts=3, trial=2))
    assert [step[:2] for step in steps] == [(0, 1), (0, 2), (1, 1), (1, 2), (2, 1), (2, 2), (1, 3), (1, 4)]
    assert len(steps) == Starts(iterations=4, starts=3, trial=2).total


@pytest.mark.parametrize(("compare", "best"), [(by_last_loss, 1), (by_recent_losses, 0)])
def test_a_trial_is_judged_by_its_last_loss_or_the_mean_of_recent_ones(compare: Compare, best: int) -> None:
    """The first two of ten are not recent: with them, the first start would be the worse one."""
    steps = run([[99, 99, *7 * [5], 4, 0], [1, 1, *7 * [6], 3, 0]], Starts(iterations=11, starts=2, trial=10), compare)
    assert steps[-1][:2] == (best, 11)


def test_of_several_that_go_on_the_best_in_the_end_is_given_again() -> None:
    starts = Starts(iterations=3, starts=3, trial=1, kept=2)
    steps = run([[4, 3, 1], [9, 1, 0], [5, 4, 2]], starts, by_last_loss)
    assert steps == [*((k, 1, 1.0) for k in range(3)), (0, 2, 1.0), (0, 3, 1.0), (2, 2, 1.0), (2, 3, 1.0), (0, 3, 0.0)]
    assert len(steps) == starts.total


def test_a_judge_may_see_the_ends_differently() -> None:
    starts = Starts(iterations=2, starts=2, trial=1, kept=2)

    def going(start: int) -> Iterator[Step]:
        yield from (Step(start, iteration, float(start), {}, torch.zeros(2), 1.0, 10) for iteration in (1, 2))

    def judge(step: Step) -> Step:
        return replace(step, verdict=-step.loss, seconds=0.5, evaluations=3)

    *_, last = best_of(starts, going, by_last_loss, judge)
    assert (last.start, last.loss, last.seconds, last.evaluations) == (1, 1.0, 1.0, 6)


@pytest.mark.parametrize(("doubtful", "tried", "best"), [(2.0, 2, 1), (1.0, 3, 2), (0.5, 4, 2)])
def test_more_are_tried_while_no_end_is_good_enough(doubtful: float, tried: int, best: int) -> None:
    starts = Starts(iterations=2, starts=2, trial=1, kept=2, more=2, doubtful=doubtful)
    steps = run([[4, 3], [4, 2], [4, 1], [4, 3]], starts, by_last_loss)
    assert {step[0] for step in steps} == set(range(tried))
    assert steps[-1] == (best, 2, 0.0)
    assert len(steps) == 2 * tried + 1 <= starts.total == 9


def test_hops_come_last_and_are_told_which_end_is_the_best_so_far() -> None:
    starts, told = Starts(iterations=2, starts=2, trial=1, kept=2, more=1, hops=2), []
    ends = [4.0, 2.0, 3.0, 1.0, 5.0]

    def going(start: int) -> Iterator[Step]:
        yield from (Step(start, iteration, ends[start], {}, torch.zeros(2), 1.0, 10) for iteration in (1, 2))

    def hop(start: int, best: Step) -> Iterator[Step]:
        told.append((start, best.start))
        return going(start)

    *_, last = best_of(starts, going, by_last_loss, hop=hop)
    assert told == [(3, 1), (4, 3)]
    assert last.start == 3


def test_a_start_that_has_settled_gives_its_last_step_again_which_costs_nothing() -> None:
    assert run([[2, 1], [9, 8]], Starts(iterations=9, starts=2, trial=2))[-1] == (0, 2, 0.0)


def test_a_single_start_is_not_tried() -> None:
    assert run([[3, 2, 1]], Starts(iterations=3, starts=1)) == [(0, 1, 1.0), (0, 2, 1.0), (0, 3, 1.0)]
    assert Starts(iterations=3, starts=1).total == 3
    assert Starts(iterations=1, starts=4, kept=2).total == 1


@pytest.mark.parametrize(
    ("starts", "said"),
    [
        (Starts(iterations=9, starts=1), "9 of 1 start"),
        (Starts(iterations=9, starts=3, trial=2), "9 of 1 start, after 2 of each of 3"),
        (Starts(iterations=9, starts=3, trial=2, kept=2), "9 of 2 starts, after 2 of each of 3"),
        (Starts(iterations=9, starts=3, trial=2, kept=5), "9 of 3 starts"),
        (Starts(iterations=9, starts=3, trial=2, kept=3, more=2), "9 of 3 starts, of up to 2 more while none fits"),
        (Starts(iterations=1, starts=3, kept=3), "1 of 1 start, after 0 of each of 3"),
    ],
)
def test_a_plan_says_what_it_does(starts: Starts, said: str) -> None:
    assert str(starts) == said


def test_stages_share_the_iterations_and_the_last_one_has_some() -> None:
    assert stages_of(16, 4) == [(0, 4), (1, 4), (2, 4), (3, 4)]
    assert stages_of(4, 6) == [(1, 1), (2, 1), (4, 1), (5, 1)]
    assert stages_of(1, 4) == [(3, 1)]
