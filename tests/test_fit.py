"""Fitting a code, with a decoder whose shapes are spheres: the code is radius and centre."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
from spheres import Spheres
from torch import Tensor

from distrace import losses
from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fitting.fit import FitConfig, Step, fit_shape, view_terms
from distrace.fitting.ray_sampling import OUTLINE, Pool, Targets
from distrace.prior import LEAST_DEVIATION, Prior, prior_of
from distrace.rays import Rays, meet_sphere
from distrace.render import render

CAMERA = Camera.orbit(30, 20, 2.5, height=40, width=40, focal_px=40.0)
TRUE = torch.tensor([0.45, 0.1, -0.15, 0.05])
PRIOR = Prior(torch.tensor([0.3, 0.0, 0.0, 0.0]), torch.diag(torch.tensor([0.1, 0.1, 0.1, 0.1])))
CONFIG = FitConfig(iterations=120, learning_rate=0.1, starts=1, mask_rays=200)


def view_of(code: Tensor, camera: Camera = CAMERA, *, mask: bool = True, normal: bool = False) -> View:
    """Depth, mask and normals of a sphere in closed form."""
    rays = camera.rays()
    bounds = meet_sphere(Rays(rays.origins - code[1:], rays.directions), float(code[0]))
    normals = torch.where(bounds.meets[..., None], (rays.at(bounds.near) - code[1:]) / code[0], 0.0)
    return View(camera, camera.depth(bounds.near), bounds.meets if mask else None, normals if normal else None)


def last(steps: Iterator[Step]) -> Step:
    *_, step = steps
    return step


def everything(view: View) -> Targets:
    return Pool.of(view).draw(10**6, 10**6, torch.Generator().manual_seed(0))


def test_a_sphere_is_recovered_from_a_hundred_depths_and_its_silhouette() -> None:
    view = view_of(TRUE).sparse(100)
    step = last(fit_shape(Spheres(), [view], PRIOR, replace(CONFIG, iterations=80)))
    torch.testing.assert_close(step.code, TRUE, atol=0.01, rtol=0)
    assert step.loss < 0.05
    assert step.evaluations > 0


@pytest.mark.slow
def test_two_views_recover_it_too_and_normals_help() -> None:
    other = Camera.orbit(120, -10, 2.5, height=40, width=40, focal_px=40.0)
    views = [view_of(TRUE, normal=True).sparse(30), view_of(TRUE, other, normal=True).sparse(30)]
    step = last(fit_shape(Spheres(), views, PRIOR, CONFIG))
    assert set(step.terms) == {"depth", "missing", "extra", "normal", "code"}
    torch.testing.assert_close(step.code, TRUE, atol=0.01, rtol=0)


@pytest.mark.slow
def test_the_silhouette_tells_what_a_depth_leaves_open() -> None:
    """One depth fits spheres of every radius; only the mask knows which.

    Beside a single depth the mean over all silhouette rays is small, hence the weight.
    """
    config = replace(CONFIG, weights=losses.Weights(mask=100.0))
    whole = view_of(TRUE)
    depth = torch.full_like(whole.depth, torch.inf)
    middle = divmod(int(whole.depth.argmin()), 40)
    depth[middle] = whole.depth[middle]
    with_mask = replace(whole, depth=depth)
    without = replace(with_mask, mask=None)
    guess = last(fit_shape(Spheres(), [without], PRIOR, config))
    assert guess.terms["depth"] < 0.02, "it explains the depth"
    assert abs(guess.code[0] - TRUE[0]) > 0.04, "but is wrong"
    fitted = last(fit_shape(Spheres(), [with_mask], PRIOR, config))
    torch.testing.assert_close(fitted.code, TRUE, atol=0.01, rtol=0)


@pytest.mark.slow
def test_from_where_nothing_is_hit_the_clearance_leads_back() -> None:
    aside = torch.tensor([0.15, -0.45, -0.3, 0.3])
    prior = Prior(aside, torch.diag(torch.tensor([0.1, 0.3, 0.3, 0.3])))
    true = torch.tensor([0.25, 0.4, 0.3, -0.2])
    view = view_of(true)
    assert not (render(Spheres().field(aside), CAMERA).mask & view.mask).any(), "the images do not overlap"
    steps = list(fit_shape(Spheres(), [view], prior, replace(CONFIG, iterations=200)))
    assert steps[0].terms["depth"] == 0
    assert steps[0].terms["missing"] > 0
    torch.testing.assert_close(steps[-1].code, true, atol=0.02, rtol=0)


def test_the_same_seed_gives_the_same_steps() -> None:
    view = view_of(TRUE).sparse(30)
    config = replace(CONFIG, iterations=6, starts=2, trial=3, depth_rays=20)
    one, again, other = (list(fit_shape(Spheres(), [view], PRIOR, replace(config, seed=seed))) for seed in (0, 0, 1))
    assert [step.loss for step in one] == [step.loss for step in again]
    assert all(torch.equal(a.code, b.code) for a, b in zip(one, again))
    assert [step.loss for step in one] != [step.loss for step in other]


def test_every_start_is_tried_and_the_best_goes_on() -> None:
    steps = list(fit_shape(Spheres(), [view_of(TRUE)], PRIOR, replace(CONFIG, iterations=12, starts=3, trial=4)))
    assert [(step.start, step.iteration) for step in steps[:12]] == [(s, i) for s in range(3) for i in range(1, 5)]
    best = min(range(3), key=lambda start: sum(step.loss for step in steps[:12] if step.start == start))
    assert [(step.start, step.iteration) for step in steps[12:]] == [(best, i) for i in range(5, 13)]
    first = {step.start: step.code for step in steps if step.iteration == 1}
    assert (first[0] - PRIOR.mean).abs().max() < 0.011, "the first start is the mean shape, one step on"
    assert not torch.equal(first[1], first[2])


@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_a_fit_shorter_than_its_trials_still_ends_with_the_best_start(iterations: int) -> None:
    config = replace(CONFIG, iterations=iterations, starts=3, trial=25)
    steps = list(fit_shape(Spheres(), [view_of(TRUE)], PRIOR, config))
    assert steps[-1].iteration == iterations
    assert max(step.iteration for step in steps) == iterations
    tried = {step.start: step.loss for step in steps[:-1] if step.iteration == iterations - 1}
    if iterations == 2:
        assert steps[-1].start == min(tried, key=lambda start: tried[start])


@pytest.mark.parametrize("wrong", [{"iterations": 0}, {"starts": 0}, {"iterations": -3}])
def test_a_fit_of_no_iterations_or_no_starts_is_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(wrong.values()))}.*at least 1"):
        FitConfig(**wrong)


def test_a_fit_without_views_is_refused() -> None:
    with pytest.raises(ValueError, match="no view was given"):
        next(fit_shape(Spheres(), [], PRIOR))


def test_a_view_from_inside_the_mean_shape_is_refused() -> None:
    inside = Camera.orbit(30, 20, 0.2, height=8, width=8, focal_px=4.0)
    with pytest.raises(ValueError, match=r"the camera at \[0.094, 0.068, 0.163\] is inside the mean shape"):
        next(fit_shape(Spheres(), [view_of(TRUE), View(inside, torch.full((8, 8), 0.3))], PRIOR, CONFIG))


@pytest.mark.slow
def test_normals_alone_tell_where_a_sphere_is() -> None:
    view = view_of(TRUE, mask=False, normal=True)
    known = replace(view, depth=torch.full_like(view.depth, torch.inf))
    assert everything(known).is_object.all()
    step = last(fit_shape(Spheres(), [known], PRIOR, CONFIG))
    assert step.terms["normal"] < 0.01
    assert step.terms["missing"] < 1e-3


@pytest.mark.parametrize("mask", [True, False])
def test_odd_views_end_with_a_code(mask: bool) -> None:
    """One pixel, and one that overlaps with no rendering: it is seen where the mean shape is not."""
    pixel = view_of(TRUE, CAMERA.cropped(20, 20, 1, 1), mask=mask)
    beside = view_of(torch.tensor([0.1, 0.6, 0.0, -0.3]), mask=mask)
    for view in (pixel, beside):
        step = last(fit_shape(Spheres(), [view], PRIOR, replace(CONFIG, iterations=5)))
        assert step.code.isfinite().all()
        assert not torch.equal(step.code, PRIOR.mean)


def test_a_perfect_rendering_lacks_nothing() -> None:
    view = view_of(TRUE, normal=True)
    terms = view_terms(Spheres().field(TRUE), [everything(view)], replace(CONFIG, margin=0.0))
    values = {name: float(term) for name, term in terms.items()}
    assert set(values) == {"depth", "missing", "extra", "normal"}
    assert values["depth"] < 1e-3, "ten times the mean error"
    assert values["missing"] == 0
    assert values["extra"] < 1e-5
    assert values["normal"] < 1e-3


def test_each_loss_is_what_a_wrong_rendering_lacks() -> None:
    """A sphere too small by a tenth: every depth too far, object rays missed by up to that, no ray hit in excess."""
    view = view_of(TRUE, normal=True)
    small = TRUE - torch.tensor([0.1, 0, 0, 0])
    buffers = render(Spheres().field(small), CAMERA)
    expected = view_of(small).depth
    both = torch.isfinite(expected)
    difference = (expected[both] - view.depth[both]).abs().mean()
    assert losses.depth_loss(buffers, view.depth) == pytest.approx(float(difference), rel=1e-3)
    missing, extra = losses.silhouette_loss(buffers, view.mask, 0.0)
    rays = CAMERA.rays()
    offset = TRUE[1:] - rays.origins
    beside = (offset - (offset * rays.directions).sum(-1, keepdim=True) * rays.directions).norm(dim=-1)
    lacking = (beside - small[0])[view.mask & ~both]
    assert missing == pytest.approx(float(lacking.sum() / view.mask.numel()), rel=1e-3)
    assert extra == 0
    large = render(Spheres().field(TRUE + torch.tensor([0.1, 0, 0, 0])), CAMERA)
    missing, extra = losses.silhouette_loss(large, view.mask, 0.01)
    excess = float((large.mask & ~view.mask).float().mean())
    assert missing == 0
    assert 0.99 * excess < extra / 0.01 < 1.5 * excess, "what is hit lacks all of the margin, what is near it a part"


def test_losses_of_rays_without_anything_known_are_zero() -> None:
    buffers = render(Spheres().field(TRUE), CAMERA)
    assert losses.depth_loss(buffers, torch.full((40, 40), torch.inf)) == 0
    assert losses.normal_loss(buffers, torch.zeros(40, 40, 3)) == 0


def test_targets_are_drawn_only_where_the_view_knows_something() -> None:
    view = view_of(TRUE, normal=True).sparse(50)
    assert view.mask is not None
    pool = Pool.of(view)
    targets = pool.draw(30, 100, torch.Generator().manual_seed(1))
    assert len(targets.pixels) == 130
    column, row = (targets.pixels - 0.5).long().T
    assert torch.equal(targets.pixels - 0.5, torch.stack([column, row], dim=1).float()), "centres of pixels"
    assert min(column.min(), row.min()) >= 0
    assert max(column.max(), row.max()) < 40
    assert torch.isfinite(targets.depth[:30]).all()
    assert len({(int(x), int(y)) for x, y in targets.pixels[:30]}) == 30, "none twice"
    assert torch.equal(targets.depth, view.depth[row, column])
    assert torch.equal(targets.is_object, view.mask[row, column])
    assert torch.equal(targets.normal, view.normal[row, column])
    assert meet_sphere(CAMERA.rays(targets.pixels)).meets.all()


def test_half_of_the_silhouette_rays_lie_along_the_outline() -> None:
    view = view_of(TRUE)
    targets = Pool.of(view).draw(0, 100, torch.Generator().manual_seed(1))
    inner = view.mask.nonzero().float()
    outer = (~view.mask).nonzero().float()
    at = (targets.pixels[:50] - 0.5).flip(1)
    reach = 2**0.5 * (OUTLINE // 2) + 1e-3
    assert torch.cdist(at, inner).amin(1).max() <= reach
    assert torch.cdist(at, outer).amin(1).max() <= reach
    assert torch.cdist((targets.pixels[50:] - 0.5).flip(1), inner).amin(1).max() > reach, "the others are anywhere"


def test_without_a_mask_only_depths_are_drawn_and_a_few_are_all_taken() -> None:
    view = view_of(TRUE, mask=False).sparse(7)
    targets = Pool.of(view).draw(1000, 500, torch.Generator().manual_seed(1))
    assert len(targets.pixels) == 7
    assert targets.is_object.all()
    assert targets.normal is None


def test_the_prior_has_the_mean_and_the_covariance_of_the_codes_and_a_little_in_every_direction() -> None:
    random = torch.Generator().manual_seed(0)
    codes = torch.randn(50, 4, generator=random) @ torch.randn(4, 4, generator=random) + 3
    prior, covariance = prior_of(codes), torch.cov(codes.T)
    torch.testing.assert_close(prior.mean, codes.mean(0))
    least = LEAST_DEVIATION * torch.linalg.eigvalsh(covariance).sqrt().mean()
    expected = covariance + least**2 * torch.eye(4)
    torch.testing.assert_close(prior.basis @ prior.basis.T, expected, atol=1e-4, rtol=1e-4)
    assert torch.equal(prior.code(torch.zeros(4)), prior.mean)


def test_codes_that_are_all_the_same_leave_deepsdfs_prior_about_them() -> None:
    prior = prior_of(torch.full((3, 4), 0.2))
    torch.testing.assert_close(prior.basis, 0.1 * torch.eye(4))
    torch.testing.assert_close(prior.coordinates(torch.full((4,), 0.2)), torch.zeros(4))


def test_directions_in_which_no_code_varies_stay_open_and_one_code_has_the_prior_of_deepsdf() -> None:
    codes = torch.zeros(5, 4)
    codes[:, 1] = torch.arange(5.0)
    basis = prior_of(codes).basis
    variances = (basis @ basis.T).diagonal()
    assert variances[1] > 2.5
    assert (variances[[0, 2, 3]] > 1e-3).all()
    assert (variances[[0, 2, 3]] < 0.1).all()
    alone = prior_of(codes[:1])
    assert torch.equal(alone.basis, 0.1 * torch.eye(4))
    assert torch.equal(alone.mean, torch.zeros(4))
