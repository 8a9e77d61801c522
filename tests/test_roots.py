"""Roots along rays, from guesses good and bad: closed forms in the distance t."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from distrace.fast.roots import Guess, Roots, settle
from distrace.primitives import sphere
from distrace.rays import Rays

f64 = torch.float64
TOLERANCE, REACH, COUNT = 2.5e-4, 1 / 14, 200
Along = Callable[[Tensor, Tensor], Tensor]


class Rows:
    """A field that is f(t; root) along parallel rays, each with its own root; it remembers what it was asked."""

    def __init__(self, f: Along, root: Tensor) -> None:
        self.f, self.asked, self.root = f, [], root
        origins = torch.stack([root, torch.zeros_like(root), torch.zeros_like(root)], dim=-1)
        self.rays = Rays(origins, torch.tensor([0, 0, 1], dtype=f64).expand(len(root), 3))

    def __call__(self, points: Tensor) -> Tensor:
        self.asked.append(points)
        return self.f(points[..., 2], points[..., 0])

    def settle(self, guess: Guess, reach: float = REACH, looks: int = 7) -> Roots:
        return settle(self, self.rays, guess, TOLERANCE, reach, looks)


def uniform(low: float, high: float, seed: int = 0) -> Tensor:
    return low + (high - low) * torch.rand(COUNT, generator=torch.Generator().manual_seed(seed), dtype=f64)


ROOT = uniform(1, 2)
UNKNOWN = torch.full_like(ROOT, torch.nan)


def guess(distance: Tensor, slope: float | Tensor, doubt: float, *ends: Tensor) -> Guess:
    return Guess(distance, torch.as_tensor(slope, dtype=f64).expand(COUNT), torch.full_like(ROOT, doubt), *ends)


def line(slope: float) -> Along:
    return lambda t, root: slope * (t - root)


def cubic(t: Tensor, root: Tensor) -> Tensor:
    return -(t - root) * (0.05 + 400 * (t - root) ** 2)


def flattening(t: Tensor, root: Tensor) -> Tensor:
    return -0.1 * torch.tanh(20 * (t - root))


def test_on_a_line_of_known_slope_one_look_is_enough() -> None:
    rows = Rows(line(-0.8), ROOT)
    roots = rows.settle(guess(ROOT + uniform(-5e-4, 5e-4), -0.8, 0.03))
    assert (roots.evaluations == 1).all()
    torch.testing.assert_close(roots.distance, ROOT, rtol=0, atol=1e-12)


@pytest.mark.parametrize("slope", [-1.0, -0.3])
def test_on_a_line_a_longer_step_is_confirmed_by_a_second_look(slope: float) -> None:
    rows = Rows(line(slope), ROOT)
    roots = rows.settle(guess(ROOT + 0.01, slope, 0.03))
    assert (roots.evaluations == 2).all()
    torch.testing.assert_close(roots.distance, ROOT, rtol=0, atol=1e-12)


def test_a_slope_in_great_doubt_is_confirmed_by_a_second_look() -> None:
    rows = Rows(line(-0.8), ROOT)
    assert (rows.settle(guess(ROOT + 1e-5, -0.8, 0.29)).evaluations == 1).all()
    assert (rows.settle(guess(ROOT + 1e-5, -0.8, 0.31)).evaluations == 2).all()


@given(factor=st.floats(0.5, 2), off=st.floats(-0.02, 0.02), slope=st.floats(-1.2, -0.2))
def test_from_a_wrong_slope_the_root_is_found_within_the_tolerance(factor: float, off: float, slope: float) -> None:
    """The secant through two looks corrects it; the doubt given is the true one."""
    roots = Rows(line(slope), ROOT).settle(guess(ROOT + off, factor * slope, max(factor - 1, 1 / factor - 1)))
    assert (roots.distance - ROOT).abs().max() < TOLERANCE


@given(off=st.floats(1e-6, 0.02), side=st.sampled_from([-1, 1]), slope=st.floats(-1.2, -0.2))
def test_from_an_unknown_slope_the_root_is_found_too(off: float, side: int, slope: float) -> None:
    roots = Rows(line(slope), ROOT).settle(guess(ROOT + side * off, torch.nan, torch.nan))
    assert (roots.distance - ROOT).abs().max() < TOLERANCE


@given(bend=st.floats(-3, 3), off=st.floats(-0.02, 0.02))
def test_on_a_parabola_the_root_is_found_within_the_tolerance(bend: float, off: float) -> None:
    rows = Rows(lambda t, root: -0.8 * (t - root) + bend * (t - root) ** 2, ROOT)
    roots = rows.settle(guess(ROOT + off, -0.8, 0.2))
    assert (roots.distance - ROOT).abs().max() < TOLERANCE
    assert roots.evaluations.max() <= 4


@pytest.mark.parametrize("f", [cubic, flattening, line(-0.1), line(-1.0)])
def test_a_root_between_given_ends_is_always_found(f: Along) -> None:
    """Also where it is entered too flatly to be believed without them."""
    low, high = ROOT - uniform(1e-3, 0.02, 1), ROOT + uniform(1e-3, 0.02, 2)
    start = low + (high - low) * uniform(0.05, 0.95, 3)
    rows = Rows(f, ROOT)
    roots = rows.settle(guess(start, torch.nan, torch.nan, low, f(low, ROOT), high, f(high, ROOT)), reach=1.0)
    assert (roots.distance - ROOT).abs().max() < TOLERANCE
    asked = torch.cat(rows.asked)
    distance = dict(zip(ROOT.tolist(), zip(low.tolist(), high.tolist())))
    assert all(distance[x][0] < t < distance[x][1] for x, _, t in asked.tolist())


@pytest.mark.parametrize("slope", [-0.3, torch.nan])
@pytest.mark.parametrize("clearance", [0.0, 1e-6, 1e-3])
def test_where_a_ray_but_touches_there_is_no_root(slope: float, clearance: float) -> None:
    """Along it f = √(r² + s²) − r + clearance, which comes below every tolerance and never crosses zero."""
    rows = Rows(lambda t, root: (0.25 + (t - root) ** 2).sqrt() - 0.5 + clearance, ROOT)
    roots = rows.settle(guess(ROOT + uniform(-0.02, 0.02), slope, 0.3))
    assert roots.distance.isnan().all()
    assert roots.evaluations.max() <= 7


def test_on_a_flat_slope_a_small_value_is_no_root_without_a_change_of_sign() -> None:
    for slope, found in ((-0.2, True), (-0.1, False)):
        roots = Rows(lambda t, root: torch.full_like(t, 1e-5), ROOT).settle(guess(ROOT, slope, 0.03))
        assert (roots.distance.isfinite() == found).all()


def test_a_root_beyond_reach_is_not_found() -> None:
    rows = Rows(line(-1.0), ROOT)
    near, far = guess(ROOT - 0.9 * REACH, -1.0, 0.03), guess(ROOT - 1.6 * REACH, -1.0, 0.03)
    torch.testing.assert_close(rows.settle(near).distance, ROOT, rtol=0, atol=1e-12)
    assert rows.settle(far).distance.isnan().all()


def test_a_slope_too_flat_throws_no_ray_out_of_its_reach() -> None:
    """A step is half the reach at most; it would be 1.2 times that."""
    roots = Rows(line(-1.0), ROOT).settle(guess(ROOT - 0.6 * REACH, -0.5, 1.0))
    torch.testing.assert_close(roots.distance, ROOT, rtol=0, atol=1e-12)


def test_no_ray_is_looked_at_beyond_its_reach() -> None:
    rows = Rows(lambda t, root: torch.full_like(t, 0.5), ROOT)
    start = ROOT + 0.3
    assert rows.settle(guess(start, -0.5, 0.03)).distance.isnan().all()
    asked = torch.cat(rows.asked)
    assert (asked[:, 2] - asked[:, 0] - 0.3).abs().max() < REACH + 1e-9


@pytest.mark.parametrize("looks", [1, 3, 7])
def test_no_ray_is_looked_at_more_often_than_allowed(looks: int) -> None:
    rows = Rows(lambda t, root: torch.full_like(t, 1e-3), ROOT)
    roots = rows.settle(guess(ROOT, torch.nan, torch.nan), looks=looks)
    assert (roots.evaluations == looks).all()
    assert roots.distance.isnan().all()


def test_looks_are_counted_per_ray() -> None:
    rows = Rows(line(-0.8), ROOT)
    roots = rows.settle(guess(ROOT + torch.where(ROOT < 1.5, 1e-4, 0.02), -0.8, 0.03))
    assert roots.evaluations.sum() == sum(len(points) for points in rows.asked)
    assert (roots.evaluations == torch.where(ROOT < 1.5, 1, 2)).all()


@pytest.mark.parametrize("slope", [-0.8, torch.nan])
def test_a_field_of_nan_has_no_root_and_is_asked_once(slope: float) -> None:
    rows = Rows(lambda t, root: t * torch.nan, ROOT)
    for ends in ((), (ROOT - 0.1, ROOT * 0 + 0.1, ROOT + 0.1, ROOT * 0 - 0.1)):
        roots = rows.settle(guess(ROOT, slope, 0.03, *ends))
        assert roots.distance.isnan().all()
        assert (roots.evaluations == 1).all()


def test_a_guess_of_nan_has_no_root() -> None:
    roots = Rows(line(-0.8), ROOT).settle(guess(ROOT.where(ROOT < 1.5, torch.nan), -0.8, 0.03))
    assert (roots.distance.isnan() == (ROOT >= 1.5)).all()


def test_the_last_samples_are_told() -> None:
    rows = Rows(line(-0.8), ROOT)
    roots = rows.settle(guess(ROOT - 3e-4, -0.8, 0.03))
    torch.testing.assert_close(roots.sample, ROOT - 3e-4, rtol=0, atol=1e-12)
    torch.testing.assert_close(roots.value, torch.full_like(ROOT, 2.4e-4), rtol=0, atol=1e-12)
    torch.testing.assert_close(roots.moved, torch.full_like(ROOT, 3e-4), rtol=0, atol=1e-12)
    torch.testing.assert_close(roots.outside, roots.sample)


def test_without_a_sample_outside_none_is_told() -> None:
    roots = Rows(line(-0.8), ROOT).settle(guess(ROOT + 3e-4, -0.8, 0.03))
    assert roots.outside.isnan().all()


def test_the_slope_told_is_that_through_the_last_two_samples() -> None:
    roots = Rows(line(-0.6), ROOT).settle(guess(ROOT + 0.01, -0.8, 0.3))
    torch.testing.assert_close(roots.slope, torch.full_like(ROOT, -0.6), rtol=0, atol=1e-9)


@given(count=st.integers(1, COUNT))
def test_a_root_does_not_depend_on_the_rays_beside_it(count: int) -> None:
    rows, whole = Rows(cubic, ROOT), guess(ROOT + uniform(-0.02, 0.02), -0.1, 0.3)
    together = rows.settle(whole)
    chosen = torch.arange(count)
    apart = settle(rows, rows.rays[chosen], whole[chosen], TOLERANCE, REACH)
    torch.testing.assert_close(together.distance[:count], apart.distance, rtol=0, atol=1e-12, equal_nan=True)
    assert (together.evaluations[:count] == apart.evaluations).all()


def test_a_guess_is_replaced_where_asked() -> None:
    first, second, where = guess(ROOT, -0.5, 0.1), guess(ROOT + 1, -0.7, 0.2), ROOT < 1.5
    mixed = first.replaced(where, second)
    for name in ("distance", "slope", "doubt"):
        expected = torch.where(where, getattr(second, name), getattr(first, name))
        torch.testing.assert_close(getattr(mixed, name), expected)


def test_no_rays_have_no_roots() -> None:
    nothing = torch.empty(0, dtype=f64)
    rays = Rays(torch.empty(0, 3, dtype=f64), torch.empty(0, 3, dtype=f64))
    assert settle(sphere(0.5), rays, Guess(nothing, nothing, nothing), TOLERANCE, REACH).distance.shape == (0,)
