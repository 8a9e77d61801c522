"""Levenberg–Marquardt on problems whose minimum is known."""

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from distrace.fitting.solver import Residuals, Solution, SolverConfig, minimise

MANY = SolverConfig(iterations=100, scale=100.0, settled=0.0)


def problem(values: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Residuals]:
    """The residuals of a function, its Jacobian by autograd."""

    def residuals(x: Tensor) -> Residuals:
        at = values(x)
        jacobian = torch.autograd.functional.jacobian(values, x)
        assert isinstance(jacobian, Tensor)
        return Residuals(at, jacobian, torch.ones_like(at))

    return residuals


def rosenbrock(x: Tensor) -> Tensor:
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def solved(values: Callable[[Tensor], Tensor], start: Tensor, config: SolverConfig = MANY) -> list[Solution[Tensor]]:
    return list(minimise(problem(values), start, torch.add, config))


def test_the_minimum_of_rosenbrock_is_found() -> None:
    steps = solved(rosenbrock, torch.tensor([-1.2, 1.0], dtype=torch.float64))
    torch.testing.assert_close(steps[-1].state, torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0)
    assert steps[-1].loss < 1e-12


def test_a_linear_problem_without_outliers_takes_a_step_or_two() -> None:
    matrix = torch.randn(20, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    truth = torch.arange(5.0, dtype=torch.float64)
    config = SolverConfig(iterations=4, damping=1e-9, scale=1e6, settled=0.0)
    steps = solved(lambda x: matrix @ (x - truth), torch.zeros(5, dtype=torch.float64), config)
    torch.testing.assert_close(steps[1].state, truth, atol=1e-6, rtol=0)


def test_outliers_hardly_count_where_the_scale_is_small() -> None:
    observed = torch.cat([torch.full((40,), 2.0), torch.full((10,), 50.0)]).double()
    start = torch.tensor([6.0], dtype=torch.float64)
    robust = solved(lambda x: x - observed, start, SolverConfig(100, scale=0.1, widest=100.0, settled=0.0))
    squares = solved(lambda x: x - observed, start)
    assert float(robust[-1].state) == pytest.approx(2.0, abs=0.01)
    assert float(squares[-1].state) > 5, "the mean is 11.6"


@pytest.mark.parametrize(("even", "far"), [(True, False), (False, True)])
def test_damped_evenly_what_hardly_anything_tells_of_hardly_moves(even: bool, far: bool) -> None:
    """The second unknown would have to go to 1000 for what is a thousandth of the first one's residual."""
    weak = torch.tensor([1.0, 1e-3], dtype=torch.float64)
    steps = solved(lambda x: weak * x - 1, torch.zeros(2, dtype=torch.float64), SolverConfig(1, 0.1, even, scale=1e3))
    assert float(steps[0].state[0]) == pytest.approx(1 / 1.05 if even else 1 / 1.1, rel=1e-3)
    assert (steps[0].state[1] > 100) == far


def test_the_loss_never_rises_and_damping_recovers_from_steps_too_far() -> None:
    start = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    steps = solved(rosenbrock, start, SolverConfig(100, damping=1e-7, scale=100.0, settled=0.0))
    losses = [step.loss for step in steps]
    assert losses == sorted(losses, reverse=True)
    rejected = [index for index, step in enumerate(steps[:-1]) if not step.accepted]
    assert rejected, "the first steps go too far"
    first = rejected[0]
    assert first == 0 or torch.equal(steps[first].state, steps[first - 1].state), "a step too far is not taken"
    assert any(later.accepted and later.damping < steps[first].damping for later in steps[first:])
    torch.testing.assert_close(steps[-1].state, torch.ones(2, dtype=torch.float64), atol=1e-5, rtol=0)


@dataclass(frozen=True)
class Turn:
    """An angle; the unknown is what is added to it."""

    angle: float


def test_a_state_need_not_be_a_tensor() -> None:
    def residuals(turn: Turn) -> Residuals:
        angle = torch.tensor(turn.angle, dtype=torch.float64)
        values = torch.stack([angle.cos() - 0.6, angle.sin() - 0.8])
        return Residuals(values, torch.stack([-angle.sin(), angle.cos()])[:, None], torch.ones_like(values))

    *_, last = minimise(residuals, Turn(0.1), lambda turn, step: Turn(turn.angle + float(step)), MANY)
    assert torch.tensor(last.state.angle).cos() == pytest.approx(0.6, abs=1e-6)


def test_it_stops_when_settled() -> None:
    start = torch.tensor([-1.2, 1.0], dtype=torch.float64)
    steps = solved(rosenbrock, start, SolverConfig(iterations=500, scale=100.0))
    assert len(steps) < 100
    assert [step.iteration for step in steps] == list(range(1, len(steps) + 1))
    assert len(solved(rosenbrock, start, SolverConfig(iterations=3, scale=100.0))) == 3


def test_an_unknown_without_influence_stays_where_it_is() -> None:
    start = torch.tensor([3.0, 7.0], dtype=torch.float64)
    state = solved(lambda x: x[:1] - 1, start)[-1].state
    assert float(state[0]) == pytest.approx(1.0, abs=1e-6)
    assert state[1] == 7.0


def test_weights_say_how_much_a_residual_counts() -> None:
    def residuals(x: Tensor) -> Residuals:
        return Residuals(x - torch.tensor([0.0, 1.0]).to(x), torch.ones(2, 1).to(x), torch.tensor([1.0, 3.0]).to(x))

    *_, last = minimise(residuals, torch.tensor([5.0], dtype=torch.float64), torch.add, MANY)
    assert float(last.state) == pytest.approx(0.75, abs=1e-3)
    assert last.loss == pytest.approx((0.75**2 + 3 * 0.25**2) / 2, rel=1e-2)


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"scale": 0.0}, {"scale": float("nan")}, {"widest": 0.5}])
def test_a_configuration_that_solves_nothing_is_refused(wrong: dict) -> None:
    name, value = next(iter(wrong.items()))
    with pytest.raises(ValueError, match=f"{name}={value}.*solves nothing"):
        SolverConfig(**wrong)
