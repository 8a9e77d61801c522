"""Fitting a code by Levenberg–Marquardt, with an untrained decoder whose shapes are bumpy balls."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from math import isfinite

import pytest
import torch
from bumpy import bumpy_balls

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields import precision
from distrace.fields.batch import BatchField
from distrace.fields.decoder import FAR, Decoder
from distrace.fitting.code_jacobian import derivatives
from distrace.fitting.code_residuals import Comparison, Look, Problem
from distrace.fitting.continuation import CodeFitConfig, fitted, stage_of
from distrace.fitting.fit_code import fit_code, fit_points
from distrace.fitting.multistart import Step, stages_of
from distrace.fitting.observations import Seen
from distrace.fitting.point_residuals import PointProblem, misfits
from distrace.fitting.ray_sampling import Pool
from distrace.fitting.retrieval import Hints, first_of
from distrace.fitting.solver import Residuals, SolverConfig, cauchy, minimise
from distrace.losses import Weights
from distrace.prior import Prior
from distrace.render import render

CAMERA = Camera.orbit(30, 20, 2.5, height=40, width=40, focal_px=40.0)
PRIOR = Prior(torch.zeros(4), 0.3 * torch.eye(4) + 0.05)
TRUE = torch.tensor([0.4, -0.3, 0.2, -0.4])
OTHERS = torch.tensor([[0.0, 0.0, 0.0, 0.0], [-0.6, 0.5, 0.1, 0.6], [0.8, 0.6, -0.7, 0.1]])
CONFIG = CodeFitConfig(starts=1, compared=Comparison(weights=Weights(code=1e-6)))


@pytest.fixture(scope="module")
def decoder() -> Decoder:
    return bumpy_balls(0.35)


@pytest.fixture(scope="module")
def view(decoder: Decoder) -> View:
    """What the camera sees of the shape of the true code."""
    buffers = render(decoder.field(TRUE), CAMERA)
    assert 200 < buffers.mask.sum() < 1400, "it is neither small nor all that there is"
    return View(CAMERA, buffers.depth, buffers.mask)


@pytest.fixture
def exact_products(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a processor without products in bfloat16, by which rays that graze are seen otherwise."""
    monkeypatch.setattr(precision, "_multiplies_in_bfloat16", lambda: False)


def last(steps: Iterator[Step]) -> Step:
    *_, step = steps
    return step


def problem_of(decoder: Decoder, view: View, compared: Comparison) -> Problem:
    targets = Pool.of(view).draw(200, 200, torch.Generator().manual_seed(0))
    return Problem(precision.fastest(decoder), PRIOR, Seen.of([targets], compared.weights), compared)


def looked(problem: Problem, w: torch.Tensor, last: Look | None = None) -> Look:
    """The look of a single start."""
    (look,) = problem.look([w], None if last is None else [last])
    return look


def moved(problem: Problem, look: Look, step: torch.Tensor) -> Look:
    (candidate,) = problem.moved([look], [step])
    return candidate


def residuals(problem: Problem, look: Look) -> Residuals:
    (found,) = problem.residuals([look])
    return found


def error(decoder: Decoder, code: torch.Tensor) -> float:
    """How far the surface of a code is from that of the true one, where the camera sees it."""
    with torch.no_grad():
        buffers = render(decoder.field(TRUE), CAMERA)
        return float(decoder.field(code)(buffers.points).abs().mean())


def test_derivatives_are_those_of_finite_differences(decoder: Decoder) -> None:
    exact = Decoder(decoder.specs).double().requires_grad_(False)
    exact.load_state_dict(decoder.state_dict())
    random = torch.Generator().manual_seed(1)
    points = torch.rand(2500, 3, generator=random, dtype=torch.float64) - 0.5
    code, direction = torch.rand(2, 4, generator=random, dtype=torch.float64)
    moved = torch.rand(3, generator=random, dtype=torch.float64)
    values, by_point, by_code = derivatives(exact, points, code)
    torch.testing.assert_close(values, exact.field(code)(points))
    small = 1e-7
    for found, ahead, behind in (
        (by_code @ direction, (points, code + small * direction), (points, code - small * direction)),
        (by_point @ moved, (points + small * moved, code), (points - small * moved, code)),
    ):
        expected = (exact(*ahead) - exact(*behind)) / (2 * small)
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-6)


def test_residuals_change_as_their_jacobian_says(decoder: Decoder, view: View) -> None:
    """Each on rays that are compared before and after: of those by the field at the same point, exactly."""
    problem = problem_of(decoder, view, CONFIG.compared)
    random = torch.Generator().manual_seed(2)
    w, step = torch.randn(4, generator=random), 1e-3 * torch.randn(4, generator=random)
    before, after = looked(problem, w), looked(problem, w + step)
    one, other = residuals(problem, before), residuals(problem, after)
    rows, others = (look.compared.nonzero()[:, 0].tolist() for look in (before, after))
    both = [row for row in rows if row in others and before.hit[row] == after.hit[row]]
    assert len(both) > 150
    change = other.values[[others.index(row) for row in both]] - one.values[[rows.index(row) for row in both]]
    expected = one.jacobian[[rows.index(row) for row in both]] @ step
    assert (change - expected).abs().median() < 0.05 * expected.abs().median()
    assert one.jacobian.shape == (len(rows) + 4, 4), "the prior's rows are the last"


def test_rays_that_are_left_out_would_change_no_step(decoder: Decoder, view: View) -> None:
    """Rays of the background that come near, but not too near, and rays of the object that meet it."""
    problem = problem_of(decoder, view.sparse(20), replace(CONFIG.compared, margin=0.04))
    look = moved(problem, looked(problem, torch.zeros(4)), torch.tensor([0.3, -0.2, 0.1, 0.2]))
    more = replace(look, compared=look.watched)
    some, every = residuals(problem, look), residuals(problem, more)
    assert len(some.values) + 10 < len(every.values), "they were differentiated in vain"
    assert some.loss(problem.scale) == pytest.approx(every.loss(problem.scale))
    (step, _), (other, _) = (each.step(problem.scale, 0.1, cauchy, even=True) for each in (some, every))
    torch.testing.assert_close(step, other)


def test_an_observed_shape_lacks_nothing(decoder: Decoder, view: View) -> None:
    problem = problem_of(decoder, view, Comparison(margin=0.0))
    look = looked(problem, torch.linalg.solve(PRIOR.basis, TRUE - PRIOR.mean))
    terms = problem.terms(look, residuals(problem, look))
    assert terms["depth"] < 0.01, "ten times the mean error"
    assert terms["missing"] + terms["extra"] < 1e-3
    assert problem.evaluations[0] > 1000


def test_the_shape_of_another_code_is_found_in_a_few_steps(decoder: Decoder, view: View) -> None:
    steps = list(fit_code(decoder, [view.sparse(100)], PRIOR, CONFIG))
    assert error(decoder, PRIOR.mean) > 0.03
    assert error(decoder, steps[-1].code) < 2e-3
    torch.testing.assert_close(steps[-1].code, TRUE, atol=0.03, rtol=0)
    assert [step.iteration for step in steps[:-1]] == list(range(1, len(steps)))
    assert steps[-1].iteration in (CONFIG.iterations, CONFIG.iterations + CONFIG.sharpening), "the better of both ends"
    assert len(steps) <= CONFIG.total
    assert set(steps[-1].terms) - {"outline"} == {"depth", "missing", "extra", "code"}
    assert steps[-1].loss == pytest.approx(sum(steps[-1].terms.values()))
    assert steps[-1].loss - steps[-1].terms.get("outline", 0.0) < 0.1 * steps[0].loss, "the first has no outline term"
    assert all(step.evaluations > 0 and step.seconds > 0 for step in steps)


@pytest.mark.usefixtures("exact_products")
def test_continuing_from_the_last_hits_finds_what_a_whole_march_finds(decoder: Decoder, view: View) -> None:
    problem = problem_of(decoder, view, CONFIG.compared)
    w = torch.tensor([0.5, -0.2, 0.3, 0.1])
    start = looked(problem, torch.zeros(4))
    before = problem.evaluations[0]
    continued = moved(problem, start, w)
    between = problem.evaluations[0]
    anew = looked(problem, w)
    assert (continued.hit == anew.hit).float().mean() > 0.99
    both = continued.hit & anew.hit & continued.compared & anew.compared
    known = both & problem.seen.known
    torch.testing.assert_close(continued.distance[known], anew.distance[known], atol=1e-2, rtol=0)
    (one, other), along = (look.distance[both & ~known] for look in (continued, anew)), problem.seen.rays[both & ~known]
    sdf = decoder.field(PRIOR.code(w))
    assert (sdf(along.at(one)) < sdf(along.at(other)) + 3e-3).all(), "what is least on a ray is no less than it is anew"
    assert between - before < problem.evaluations[0] - between, "at fewer evaluations"


@pytest.mark.usefixtures("exact_products")
def test_rays_are_looked_along_again_where_the_scale_is_another(decoder: Decoder, view: View) -> None:
    problem = problem_of(decoder, view, CONFIG.compared)
    first = looked(problem, torch.zeros(4))
    asked = problem.evaluations[0]
    there = moved(problem, first, torch.tensor([0.5, -0.2, 0.3, 0.1]))
    before = problem.evaluations[0]
    assert looked(problem, there.w, there) is there
    assert problem.evaluations[0] == before
    problem.scale /= 2
    again, anew = looked(problem, there.w, there), looked(problem, there.w)
    assert (again.hit == anew.hit).float().mean() > 0.99
    assert before < problem.evaluations[0] < before + 2 * asked


def test_the_best_end_is_brought_to_the_outline() -> None:
    """Of a silhouette alone: a few rays through pixels tell roughly where it is, rays between them exactly."""
    decoder = bumpy_balls(0.4)  # all of it is in the unit sphere: its outline is that of its surface
    camera = Camera.orbit(30, 20, 2.5, height=160, width=160, focal_px=160.0)
    buffers = render(decoder.field(TRUE / 2), camera)
    silhouette = View(camera, torch.full_like(buffers.depth, torch.inf), buffers.mask)
    config = replace(CONFIG, mask_rays=60)
    coarse, sharp = (list(fit_code(decoder, [silhouette], PRIOR, replace(config, sharpening=k))) for k in (0, 6))
    assert [step.loss for step in sharp[: len(coarse)]] == [step.loss for step in coarse]
    assert len(coarse) + 7 == len(sharp) <= replace(config, sharpening=6).total
    assert "outline" in sharp[-2].terms
    masks = [render(decoder.field(steps[-1].code), camera).mask for steps in (coarse, sharp)]
    before, after = (int((mask ^ buffers.mask).sum()) for mask in masks)
    assert after < 0.2 * before, "pixels that are wrong"


def test_several_ends_are_brought_to_the_outline_where_depths_are_few(decoder: Decoder, view: View) -> None:
    config = replace(CONFIG, iterations=3, starts=3, trial=1, more=1, hops=1, doubtful=-1.0)
    few = view.sparse(50)
    one, several = (list(fit_code(decoder, [few], PRIOR, replace(config, sharpened=k))) for k in (1, 3))
    ends = {step.start: step.verdict for step in one if isfinite(step.verdict) and step.iteration == 3}
    assert set(ends) == set(range(5)), "every start's end is judged where it ends, hops' too"
    outlined = [step.start for step in several if "outline" in step.terms and not isfinite(step.verdict)]
    assert list(dict.fromkeys(outlined)) == sorted(ends, key=lambda start: ends[start])[:3]
    assert several[-1].verdict == min(step.verdict for step in several) <= one[-1].verdict
    assert len(several) == len(one) + 2 * config.sharpening <= replace(config, sharpened=3).total
    dense = [step.start for step in fit_code(decoder, [view], PRIOR, config) if "outline" in step.terms]
    assert len(set(dense)) == 1, "of many depths the best one"


def test_without_a_mask_the_depths_tell(decoder: Decoder, view: View) -> None:
    step = last(fit_code(decoder, [replace(view, mask=None)], PRIOR, CONFIG))
    assert error(decoder, step.code) < 2e-3
    assert step.terms["missing"] == step.terms["extra"] == 0


def test_a_silhouette_alone_tells_much(decoder: Decoder, view: View) -> None:
    silhouette = replace(view, depth=torch.full_like(view.depth, torch.inf))
    step = last(fit_code(decoder, [silhouette], PRIOR, CONFIG))
    with torch.no_grad():
        wrong, mean = ((render(decoder.field(code), CAMERA).mask ^ view.mask).sum() for code in (step.code, PRIOR.mean))
    assert wrong < 0.2 * mean
    assert step.terms["depth"] == 0


def test_two_views_tell_more(decoder: Decoder, view: View) -> None:
    camera = Camera.orbit(150, -10, 2.5, height=40, width=40, focal_px=40.0)
    buffers = render(decoder.field(TRUE), camera)
    views = [view.sparse(20), View(camera, buffers.depth, buffers.mask).sparse(20)]
    step = last(fit_code(decoder, views, PRIOR, CONFIG))
    torch.testing.assert_close(step.code, TRUE, atol=0.03, rtol=0)


def test_the_best_of_several_starts_goes_on(decoder: Decoder, view: View) -> None:
    config = replace(CONFIG, iterations=7, starts=3, trial=2, kept=1, sharpening=0)
    steps = list(fit_code(decoder, [view], PRIOR, config))
    assert [(step.start, step.iteration) for step in steps[:6]] == [(s, i) for s in range(3) for i in (1, 2)]
    best = min(steps[1:6:2], key=lambda step: step.loss).start
    assert {step.start for step in steps[6:]} == {best}
    assert steps[-1].iteration == 7
    assert len(steps) <= config.total
    again = list(fit_code(decoder, [view], PRIOR, config))
    assert [step.loss for step in steps] == [step.loss for step in again], "the same seed gives the same steps"


def test_the_end_that_contradicts_the_view_least_is_the_result(decoder: Decoder, view: View) -> None:
    steps = list(fit_code(decoder, [view], PRIOR, replace(CONFIG, iterations=3, starts=3, trial=1)))
    ends = {step.start: step for step in steps}
    errors = {start: error(decoder, step.code) for start, step in ends.items()}
    assert steps[-1].start == min(errors, key=lambda start: errors[start])
    assert steps[-1].evaluations > 0, "judging asks the field, and that is counted"
    assert isfinite(steps[-1].verdict)
    assert steps[-1].verdict == min(step.verdict for step in steps)


def test_a_doubtful_fit_goes_on_from_its_best_end_where_depths_are_few(decoder: Decoder, view: View) -> None:
    config = replace(CONFIG, iterations=2, starts=2, trial=1, kept=2, more=1, hops=2, doubtful=-1.0, sharpening=0)
    few = view.sparse(50)
    steps = list(fit_code(decoder, [few], PRIOR, config))
    assert {step.start for step in steps} == set(range(5))
    best = last(fit_code(decoder, [few], PRIOR, replace(config, hops=0)))
    assert steps[-1].verdict <= best.verdict
    enough = fit_code(decoder, [few], PRIOR, replace(config, doubtful=best.verdict))
    assert {step.start for step in enough} == set(range(max(best.start + 1, 2))), "an end fits: none hops from it"
    assert {step.start for step in fit_code(decoder, [view], PRIOR, config)} == {0, 1, 2}, "depths tell what is near"

    def begun(hop: float) -> float:
        """How far from the best end the first hop's first step ends."""
        steps = fit_code(decoder, [few], PRIOR, replace(config, hop=hop))
        return next(float((step.code - best.code).norm()) for step in steps if step.start == 3)

    assert begun(0.0) < 0.5 * begun(5.0)


@pytest.mark.parametrize("iterations", [1, 2, 4])
def test_a_fit_of_few_iterations_ends_with_the_best_start(decoder: Decoder, view: View, iterations: int) -> None:
    steps = list(
        fit_code(decoder, [view], PRIOR, replace(CONFIG, iterations=iterations, starts=2, trial=9, sharpening=0))
    )
    assert steps[-1].iteration == iterations
    stages = stages_of(iterations, CONFIG.stages)
    assert sum(length for _, length in stages) == iterations
    assert stages[-1][0] == CONFIG.stages - 1, "the robust one is never left out"


def test_the_solver_lowers_its_loss(decoder: Decoder, view: View) -> None:
    problem = problem_of(decoder, view, CONFIG.compared)
    start, solver = looked(problem, torch.zeros(4)), SolverConfig(8, scale=0.1)
    steps = list(minimise(partial(residuals, problem), start, partial(moved, problem), solver))
    losses = [step.loss for step in steps]
    assert losses == sorted(losses, reverse=True)
    assert losses[-1] < 0.01 * residuals(problem, start).loss(0.1)


@pytest.fixture(params=[False, True], ids=["float32", "bfloat16"])
def either_precision(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> bool:
    """On a processor without and with products in bfloat16, whatever this one is."""
    monkeypatch.setattr(precision, "_multiplies_in_bfloat16", lambda: request.param)
    return request.param


STARTS = [torch.zeros(4), torch.tensor([0.5, -0.2, 0.3, 0.1]), torch.tensor([-0.8, 0.4, 0.0, 0.6])]


@pytest.mark.usefixtures("either_precision")
def test_rays_of_several_starts_are_looked_along_as_those_of_each_alone(decoder: Decoder, view: View) -> None:
    compared = CONFIG.compared
    together, steps = problem_of(decoder, view.sparse(50), compared), [0.1 * w + 0.05 for w in STARTS]
    looks = together.look(STARTS)
    candidates = together.moved(looks[1:], steps[1:])
    for start, w in enumerate(STARTS):
        problem = problem_of(decoder, view.sparse(50), compared)
        alone = looked(problem, w)
        pairs = [(looks[start], alone)]
        if start:
            pairs.append((candidates[start - 1], moved(problem, alone, steps[start])))
        for look, other in pairs:
            assert look.start == start
            assert torch.equal(look.w, other.w)
            for one, same in ((look.hit, other.hit), (look.compared, other.compared), (look.watched, other.watched)):
                assert (one == same).float().mean() > 0.995
            assert ((look.distance - other.distance).abs() < 1e-4).float().mean() > 0.99
        assert together.evaluations[start] == pytest.approx(problem.evaluations[0], rel=0.01)


@pytest.mark.usefixtures("either_precision")
def test_starts_that_are_fitted_together_end_where_each_ends_alone(decoder: Decoder, view: View) -> None:
    config, few = replace(CONFIG, iterations=6, stages=3), view.sparse(100)

    def problem(_: torch.Generator, share: float) -> Problem:
        return problem_of(decoder, few, config.compared)

    together = fitted(problem, PRIOR, config, STARTS, first=2)
    for start, (w, steps) in enumerate(zip(STARTS, together, strict=True)):
        (alone,) = fitted(problem, PRIOR, config, [w], first=start + 2)
        assert [(step.start, step.iteration) for step in steps] == [(start + 2, k) for k in range(1, 7)]
        torch.testing.assert_close(steps[0].code, alone[0].code, atol=2e-3, rtol=0)
        torch.testing.assert_close(steps[-1].code, alone[-1].code, atol=2e-2, rtol=0)
        assert steps[-1].loss == pytest.approx(alone[-1].loss, rel=0.1)
        assert [step.evaluations for step in steps] == pytest.approx([step.evaluations for step in alone], rel=0.05)


def test_points_of_several_starts_are_fitted_as_those_of_each_alone(decoder: Decoder) -> None:
    config = replace(CONFIG, iterations=6, stages=3)

    def problem(random: torch.Generator, share: float) -> PointProblem:
        return PointProblem(decoder, PRIOR, told(decoder), 300, random, config.compared.weights)

    for w, steps in zip(STARTS, fitted(problem, PRIOR, config, STARTS), strict=True):
        (alone,) = fitted(problem, PRIOR, config, [w])
        torch.testing.assert_close(steps[-1].code, alone[-1].code, atol=1e-3, rtol=0)
        assert [step.evaluations for step in steps] == [step.evaluations for step in alone]


@dataclass
class Settling:
    """A problem whose starts settle after as many steps as they say."""

    evaluations: Counter[int] = field(default_factory=Counter)
    prior: Prior = PRIOR

    def look(self, w: list[torch.Tensor], last: object) -> list["Settling.At"]:
        return [Settling.At(k, each) for k, each in enumerate(w)]

    def moved(self, at: list["Settling.At"], steps: list[torch.Tensor]) -> list["Settling.At"]:
        return [Settling.At(each.start, each.w - 1) for each in at]

    def residuals(self, at: list["Settling.At"]) -> list[Residuals]:
        self.evaluations.update({each.start: 1 for each in at})
        return [Residuals(each.w.clamp_min(0), torch.eye(4), torch.ones(4)) for each in at]

    def terms(self, at: "Settling.At", found: Residuals) -> dict[str, float]:
        return {"left": float(at.w[0])}

    @dataclass
    class At:
        start: int
        w: torch.Tensor


def test_a_start_that_has_settled_takes_no_further_part() -> None:
    problem = Settling()
    w = [torch.full((4,), steps) for steps in (5.0, 1.0, 3.0)]
    steps, descents = stage_of(problem, w, None, SolverConfig(9, settled=0.0), [0.1] * 3, [(7, 2), (8, 0), (9, 1)])
    assert [len(each) for each in steps] == [6, 2, 4], "the one that changes nothing is a start's last"
    assert [step.iteration for step in steps[2]] == [2, 3, 4, 5]
    assert [step.start for step in steps[0]] == [7] * 6
    assert problem.evaluations == {0: 7, 1: 3, 2: 5}
    assert [sum(step.evaluations for step in each) for each in steps] == [7, 3, 5]
    assert all(descent.settled for descent in descents)
    assert all(step.seconds > 0 for each in steps for step in each)


def test_no_view_and_nonsense_are_refused(decoder: Decoder) -> None:
    with pytest.raises(ValueError, match="no view was given"):
        next(fit_code(decoder, [], PRIOR))
    for wrong in ({"iterations": 0}, {"starts": -1}, {"stages": 0}, {"sharpened": 0}, {"sharpening": -2}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong.values()))}.*at least 1"):
            CodeFitConfig(**wrong)


def hints_of(seen: View) -> Hints:
    random = torch.Generator().manual_seed(0)
    return Hints.of(Seen.of([Pool.of(seen).draw(100, 300, random)], Weights()), random)


def test_a_view_contradicts_its_own_shape_least(decoder: Decoder, view: View) -> None:
    hints = hints_of(view)
    own, *others = hints.contradicted(decoder, torch.stack([TRUE, *OTHERS])).tolist()
    assert own < 0.002
    assert min(others) > 10 * own


def test_a_surface_that_is_elsewhere_and_free_space_that_is_not_contradict(decoder: Decoder) -> None:
    middle = torch.zeros(5, 3)
    assert float(decoder.field(TRUE)(middle).max()) < -0.1, "the middle is deep inside"
    surface, free = (Hints(middle, torch.full((5,), distance)) for distance in (0.0, torch.inf))
    assert surface.contradicted(decoder, TRUE[None]) == pytest.approx(0.1)
    assert free.contradicted(decoder, TRUE[None]) == pytest.approx(0.3)
    assert Hints(middle, torch.full((5,), -0.5)).contradicted(decoder, TRUE[None]) == 0, "decoders say no more than 0.1"
    outside = Hints(middle + 3.0, torch.full((5,), torch.inf))
    assert outside.contradicted(decoder, TRUE[None]) == 0


def test_starts_are_the_mean_the_nearest_codes_and_draws(decoder: Decoder, view: View) -> None:
    prior = replace(PRIOR, codes=(*OTHERS, TRUE))
    first = first_of(decoder, prior, hints_of(view), 2, seed=0)
    mean, nearest = first.coordinates
    torch.testing.assert_close(prior.code(mean), PRIOR.mean)
    torch.testing.assert_close(prior.code(nearest), TRUE)
    some = first_of(decoder, replace(prior, codes=(TRUE,)), hints_of(view), 4, seed=0).coordinates
    assert len(some) == 4
    assert len({tuple(w.tolist()) for w in some}) == 4
    alone = first_of(decoder, prior, hints_of(view), 1, seed=0)
    assert (len(alone.coordinates), alone.evaluations) == (1, 0)
    assert first.evaluations > len(hints_of(view).points)


def test_the_search_for_starts_is_counted(decoder: Decoder, view: View) -> None:
    prior, config = replace(PRIOR, codes=tuple(OTHERS)), replace(CONFIG, iterations=1, starts=2)
    (counted,) = [step.evaluations for step in fit_code(decoder, [view], prior, config)][:1]
    (alone,) = [step.evaluations for step in fit_code(decoder, [view], prior, replace(config, starts=1))][:1]
    assert counted - alone > 3 * 400 / 4, "three codes were asked for a quarter of the hints"


def test_points_before_and_beside_a_surface_are_free(decoder: Decoder, view: View) -> None:
    hints = hints_of(view)
    values = decoder.field(TRUE)(hints.points)
    free = hints.distances.isinf()
    assert 100 < int(free.sum()) <= 400
    assert float(values[free].min()) > -0.01
    assert float(values[~free].abs().max()) < 0.01
    assert float((hints.points - CAMERA.T_world_camera[:3, 3]).norm(dim=1).max()) < 3.6


# ---- to points


def told(decoder: Decoder, count: int = 4000) -> torch.Tensor:
    """Points in the unit sphere, and the distances of the true code's shape."""
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    points *= torch.rand(count, 1, generator=torch.Generator().manual_seed(4)) ** (1 / 3)
    return torch.cat([points, decoder.field(TRUE)(points).detach()[:, None]], dim=1)


def test_points_are_drawn_of_those_that_say_something(decoder: Decoder) -> None:
    samples, random = told(decoder), torch.Generator().manual_seed(0)
    problem = PointProblem(decoder, PRIOR, samples, 200, random, Weights(code=0.0))
    looks = problem.look([torch.zeros(4), PRIOR.coordinates(TRUE), torch.zeros(4)])
    drawn = looks[0].samples
    assert torch.equal(drawn, looks[2].samples), "the same start draws the same points"
    values, distances = decoder.field(PRIOR.mean)(drawn[:, :3]), drawn[:, 3]
    right = (values.abs() > FAR) & (distances.abs() > FAR) & (values.sign() == distances.sign())
    assert len(drawn) == 200
    assert not right.any()
    everywhere = decoder.field(PRIOR.mean)(samples[:, :3])
    assert ((everywhere.abs() > FAR) & (samples[:, 3].abs() > FAR)).float().mean() > 0.4, "most would say nothing"


def test_a_misfit_is_a_mean_that_knows_no_distance_beyond_far(decoder: Decoder) -> None:
    samples = told(decoder)
    field = decoder.fields(torch.stack([TRUE, OTHERS[1]]))
    true, other = misfits(field, samples)
    assert true == pytest.approx(0, abs=1e-6)
    assert other > 0.01
    far = BatchField(TRUE[None], lambda points, shape: torch.full_like(points[:, 0], 5.0), decoder.field)
    assert misfits(far, torch.tensor([[0, 0, 0, 0.03]])) == pytest.approx([FAR - 0.03])


def test_a_code_is_found_from_distances_all_around(decoder: Decoder, view: View) -> None:
    steps = list(fit_points(decoder, told(decoder), PRIOR, replace(CONFIG, iterations=24)))
    assert error(decoder, steps[-1].code) < 2e-3
    assert error(decoder, steps[-1].code) < 0.05 * error(decoder, PRIOR.mean)
