"""Multi-start Levenberg–Marquardt in rounds: all starts in one batch, and the best of a round go on to the next."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf

from torch.nn.functional import pad

from distrace.fitting.scan_residuals import MARGIN, PlacedCode, ScanProblem
from distrace.fitting.solver import Descent, Kernel, SolverConfig, cauchy, descend

Progress = Callable[[int], None]
"""Takes the number of iterations that are done."""


@dataclass(frozen=True)
class Round:
    """Some iterations of several starts, on the same points and rays."""

    starts: int  # the best ones of the round before
    iterations: int
    dimensions: int  # leading coordinates of the code that are free
    points: int
    rays: int
    samples: int  # on each ray, at which its least value is sought
    deviation: float  # of the shape from the observation, in its unit
    kernel: Kernel = cauchy
    margin: float = MARGIN  # deviations that a free ray keeps from the surface


@dataclass(frozen=True)
class Ends:
    """The states at the end of the last round, best first."""

    states: tuple[PlacedCode, ...]
    losses: tuple[float, ...]
    curves: dict[str, list[float]]  # losses of each of these, over all iterations
    evaluations: int  # of the field, by all starts


def run_rounds(
    states: Sequence[PlacedCode],
    rounds: Sequence[Round],
    problem_of: Callable[[Round], ScanProblem],
    solver: SolverConfig,
    progress: Progress | None = None,
) -> Ends:
    """Minimises from each state, whose `start` is its number; `solver` without its number of iterations."""
    curves: list[list[float]] = [[] for _ in states]
    ends = list(states)
    losses: list[float] = []
    evaluations = 0
    done = 0
    for stage in rounds:
        problem = problem_of(stage)
        solver = replace(solver, kernel=stage.kernel)
        begins = [_with_dimensions(state, stage.dimensions) for state in ends[: stage.starts]]
        residuals = problem.residuals(begins)
        descents = [Descent(*each, solver.damping) for each in zip(begins, residuals, strict=True)]
        for iteration in range(stage.iterations):
            going = [descent for descent in descents if not descent.settled]
            if going:
                descend(going, problem.residuals, problem.retract, solver, iteration)
            for descent in descents:
                curves[descent.state.start].append(_loss(descent, solver))
            done += 1
            if progress is not None:
                progress(done)
        descents.sort(key=lambda descent: _loss(descent, solver))
        ends = [descent.state for descent in descents]
        losses = [_loss(descent, solver) for descent in descents]
        evaluations += sum(problem.evaluations.values())
    named = {f"start {state.start + 1}": curves[state.start] for state in ends}
    return Ends(tuple(ends), tuple(losses), named, evaluations)


def _with_dimensions(state: PlacedCode, count: int) -> PlacedCode:
    """Returns a state with more coordinates, which are zero, or fewer."""
    return replace(state, w=pad(state.w, (0, min(count, len(state.base)) - len(state.w))))


def _loss(descent: Descent[PlacedCode], solver: SolverConfig) -> float:
    if not descent.residuals.values.isfinite().all():
        return inf
    return descent.residuals.loss(solver.scale, solver.kernel)
