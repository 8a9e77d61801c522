"""Fitting a code where the placement is known, with an untrained decoder whose shapes are bumpy balls."""

from dataclasses import replace

import pytest
import torch
from bumpy import bumpy_balls

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fields.decoder import Decoder
from distrace.fitting.code_jacobian import derivatives
from distrace.fitting.completing import NORMAL_OFFSET, fit_of, observed_of, signed_samples
from distrace.fitting.fit import Step
from distrace.fitting.fit_code import CodeFitConfig, fit_code, fit_observed, fit_points, plausible_codes
from distrace.fitting.observed import Observed
from distrace.fitting.starts import Hints, nearest_codes
from distrace.prior import Prior
from distrace.render import render

CAMERA = Camera.orbit(30, 20, 2.5, height=40, width=40, focal_px=40.0)
PRIOR = Prior(torch.zeros(4), 0.3 * torch.eye(4) + 0.05)
TRUE = torch.tensor([0.4, -0.3, 0.2, -0.4])
OTHERS = torch.tensor([[0.0, 0.0, 0.0, 0.0], [-0.6, 0.5, 0.1, 0.6], [0.8, 0.6, -0.7, 0.1]])
CONFIG = CodeFitConfig(starts=1)


@pytest.fixture(scope="module")
def decoder() -> Decoder:
    return bumpy_balls(0.35)


@pytest.fixture(scope="module")
def view(decoder: Decoder) -> View:
    """The shape of the true code."""
    buffers = render(decoder.field(TRUE), CAMERA)
    assert 200 < buffers.mask.sum() < 1400, "it is neither small nor all that there is"
    return View(CAMERA, buffers.depth, buffers.mask)


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


def test_the_shape_of_another_code_is_found_in_a_few_iterations(decoder: Decoder, view: View) -> None:
    done: list[int] = []
    fit = fit_code(decoder, [view.sparse(100)], PRIOR, CONFIG, done.append)
    assert error(decoder, PRIOR.mean) > 0.03
    assert error(decoder, fit.code) < 2e-3
    torch.testing.assert_close(fit.code, TRUE, atol=0.03, rtol=0)
    assert done == list(range(1, CONFIG.total + 1))
    (losses,) = fit.losses.values()
    assert len(losses) == CONFIG.iterations
    assert losses[-1] == fit.loss < losses[0] / 2
    assert fit.evaluations > 1000
    assert fit.seconds > 0


@pytest.mark.parametrize("iterations", [1, 2])
def test_a_single_iteration_moves_the_code(iterations: int, decoder: Decoder, view: View) -> None:
    fit = fit_code(decoder, [view], PRIOR, replace(CONFIG, iterations=iterations))
    assert error(decoder, fit.code) < error(decoder, PRIOR.mean)


def test_without_a_mask_the_depths_tell(decoder: Decoder, view: View) -> None:
    fit = fit_code(decoder, [replace(view, mask=None)], PRIOR, CONFIG)
    assert error(decoder, fit.code) < 2e-3


def test_a_silhouette_alone_tells_much(decoder: Decoder, view: View) -> None:
    fit = fit_code(decoder, [view.without("depth")], PRIOR, CONFIG)
    with torch.no_grad():
        wrong, mean = ((render(decoder.field(code), CAMERA).mask ^ view.mask).sum() for code in (fit.code, PRIOR.mean))
    assert wrong < 0.2 * mean


def test_two_views_tell_more(decoder: Decoder, view: View) -> None:
    camera = Camera.orbit(150, -10, 2.5, height=40, width=40, focal_px=40.0)
    buffers = render(decoder.field(TRUE), camera)
    views = [view.sparse(20), View(camera, buffers.depth, buffers.mask).sparse(20)]
    fit = fit_code(decoder, views, PRIOR, CONFIG)
    torch.testing.assert_close(fit.code, TRUE, atol=0.03, rtol=0)


def test_the_best_starts_go_on_and_the_best_end_comes_first(decoder: Decoder, view: View) -> None:
    config = replace(CONFIG, starts=4, finalists=2)
    fit = fit_code(decoder, [view.sparse(50)], replace(PRIOR, codes=tuple(OTHERS)), config)
    assert len(fit.losses) == 2
    ends = [losses[-1] for losses in fit.losses.values()]
    assert fit.loss == ends[0] <= ends[1]
    assert error(decoder, fit.code) < 2e-3


def test_a_seed_makes_a_fit_reproducible(decoder: Decoder, view: View) -> None:
    config = replace(CONFIG, iterations=4, points=20)
    fits = [fit_code(decoder, [view], PRIOR, replace(config, seed=seed)) for seed in (0, 0, 1)]
    assert torch.equal(fits[0].code, fits[1].code)
    assert not torch.equal(fits[0].code, fits[2].code)


def test_noise_of_the_depths_leaves_more_to_the_prior(decoder: Decoder) -> None:
    camera = CAMERA.resized(3)
    buffers = render(decoder.field(TRUE), camera)
    exact = View(camera, buffers.depth, buffers.mask)
    random = torch.Generator().manual_seed(0)
    noisy = replace(exact, depth=exact.depth + 0.05 * torch.randn(exact.depth.shape, generator=random))
    noises = [Observed.of_views(decoder, [each], PRIOR).noise for each in (noisy, exact, noisy.sparse(100))]
    assert noises[0] > 0.01 > 0.005 > noises[1]
    assert noises[2] == 0, "few depths do not tell"
    observed = Observed.of_views(decoder, [noisy], PRIOR)
    trusted = fit_observed(decoder, replace(observed, noise=0.0), PRIOR, CONFIG, None)
    fit = fit_observed(decoder, observed, PRIOR, CONFIG, None)
    assert error(decoder, fit.code) < error(decoder, trusted.code)


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"starts": 0}, {"finalists": -3}])
def test_a_fit_of_no_iterations_or_no_starts_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong.values()))}.*at least 1"):
        CodeFitConfig(**wrong)


def test_a_fit_to_nothing_or_from_inside_is_refused(decoder: Decoder) -> None:
    with pytest.raises(ValueError, match="no view was given"):
        fit_code(decoder, [], PRIOR)
    with pytest.raises(ValueError, match="no points were given"):
        fit_points(decoder, torch.empty(0, 4), PRIOR)
    inside = Camera.orbit(30, 20, 0.1, height=8, width=8, focal_px=4.0)
    with pytest.raises(ValueError, match="inside the mean shape"):
        fit_code(decoder, [View(inside, torch.full((8, 8), 0.3))], PRIOR)


# ---- where fits start


def hints_of(decoder: Decoder, view: View) -> Hints:
    random = torch.Generator().manual_seed(0)
    return Hints.of(Observed.of_views(decoder, [view], PRIOR).draw(100, 300, random), random)


def test_points_before_and_beside_a_surface_are_free(decoder: Decoder, view: View) -> None:
    hints = hints_of(decoder, view)
    values = decoder.field(TRUE)(hints.points)
    free = hints.distances.isinf()
    assert 100 < int(free.sum()) <= 400
    assert float(values[free].min()) > -0.01
    assert float(values[~free].abs().max()) < 0.01
    assert float(hints.points.norm(dim=1).max()) < 1.01


def test_hints_are_contradicted_by_other_shapes_and_by_what_is_inside(decoder: Decoder, view: View) -> None:
    hints = hints_of(decoder, view)
    true, *others = hints.contradictions(decoder, torch.stack([TRUE, *OTHERS])).tolist()
    assert true < 1e-3
    assert min(others) > 10 * true
    middle = torch.zeros(5, 3)
    free = Hints(middle, torch.full((5,), torch.inf))
    assert free.contradictions(decoder, TRUE[None]) == pytest.approx(0.3), "three times 0.1, the farthest that counts"
    assert Hints(middle + 3.0, free.distances).contradictions(decoder, TRUE[None]) == 0


def test_the_nearest_codes_come_first_and_are_counted(decoder: Decoder, view: View) -> None:
    hints = hints_of(decoder, view)
    codes, evaluations = nearest_codes(decoder, (*OTHERS, TRUE), hints, 2)
    assert len(codes) == 2
    torch.testing.assert_close(codes[0], TRUE)
    assert evaluations > len(hints.points)
    assert nearest_codes(decoder, (), hints, 2) == ([], 0)


# ---- to points


def distances_around(decoder: Decoder, count: int = 4000) -> torch.Tensor:
    """Points in the unit sphere, and the distances of the true code's shape."""
    points = torch.nn.functional.normalize(torch.randn(count, 3, generator=torch.Generator().manual_seed(3)), dim=-1)
    points *= torch.rand(count, 1, generator=torch.Generator().manual_seed(4)) ** (1 / 3)
    return torch.cat([points, decoder.field(TRUE)(points).detach()[:, None]], dim=1)


def test_a_code_is_found_from_distances_all_around(decoder: Decoder) -> None:
    fit = fit_points(decoder, distances_around(decoder), PRIOR, CONFIG)
    assert error(decoder, fit.code) < 2e-3
    torch.testing.assert_close(fit.code, TRUE, atol=0.03, rtol=0)


def test_normals_of_a_cloud_tell_distances_beside_its_points(decoder: Decoder) -> None:
    normals = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    samples = signed_samples(torch.zeros(2, 3), normals, 0.02)
    torch.testing.assert_close(samples, torch.tensor([[0, 0.02, 0, 0.02], [0.02, 0, 0, 0.02]]))
    model = Model("balls", decoder, OTHERS, ("a", "b", "c"))
    seen = observed_of(model, Cloud(torch.zeros(2, 3), normals), PRIOR).draw(10, 10, torch.Generator())
    assert sorted(seen.distances.tolist()) == pytest.approx([-NORMAL_OFFSET] * 2 + [NORMAL_OFFSET] * 2)


# ---- other shapes that fit


def test_plausible_codes_agree_where_the_shape_is_seen_and_differ_elsewhere(decoder: Decoder, view: View) -> None:
    observed = Observed.of_views(decoder, [view.sparse(100)], PRIOR)
    codes, evaluations = plausible_codes(decoder, observed, PRIOR, 3, CONFIG)
    assert len(codes) == 3
    assert evaluations > 3000
    assert max(error(decoder, code) for code in codes) < 0.01
    silhouette = Observed.of_views(decoder, [view.without("depth")], PRIOR)
    vague, _ = plausible_codes(decoder, silhouette, PRIOR, 3, CONFIG)
    apart = [float(torch.pdist(torch.stack(each)).mean()) for each in (codes, vague)]
    assert apart[1] > 2 * apart[0]


def test_the_curves_of_adam_begin_with_the_start_that_went_on() -> None:
    code = torch.zeros(2)
    steps = [Step(0, 1, 4.0, {}, code, 0.5, 10), Step(1, 1, 3.0, {}, code, 0.5, 10), Step(1, 2, 2.0, {}, code, 0.5, 10)]
    fit = fit_of(steps)
    assert fit.losses == {"start 2": [3.0, 2.0], "start 1": [4.0]}
    assert (fit.loss, fit.evaluations, fit.seconds) == (2.0, 30, 1.5)
