"""What disturbed depths look like: how far off, how many, and where they are missing."""

import numpy as np
import pytest
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.data.solid import Solid
from experiments.datasets.noise import NOISES, SIZE, STEP, noisy
from experiments.datasets.solids import observe

CAMERA = Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=96, width=96)


@pytest.fixture(scope="module")
def view() -> View:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.7)
    return observe(Solid(ball, ball), CAMERA)


@pytest.mark.parametrize("noise", NOISES)
def test_background_stays_background_and_a_seed_gives_the_same_again(view: View, noise: str) -> None:
    first, second = noisy(view, noise, 3), noisy(view, noise, 3)
    assert torch.equal(first.depth, second.depth)
    assert not first.seen[~view.seen].any()
    assert first.mask is view.mask
    if noise not in ("0%", "quantised"):
        assert not torch.equal(noisy(view, noise, 4).depth, first.depth)


def test_a_share_is_the_deviation_in_diameters_of_the_sphere(view: View) -> None:
    off = (noisy(view, "3%", 0).depth - view.depth)[view.seen]
    assert off.std().item() == pytest.approx(0.03 * SIZE, rel=0.05)
    assert torch.equal(noisy(view, "0%", 0).depth, view.depth)


def test_quantised_depths_are_off_by_half_a_step_at_most(view: View) -> None:
    quantised = noisy(view, "quantised", 0).depth[view.seen]
    assert (quantised - view.depth[view.seen]).abs().max() <= STEP * SIZE / 2 + 1e-6
    assert len(quantised.unique()) < 30


def test_a_tenth_are_outliers(view: View) -> None:
    off = (noisy(view, "outliers", 0).depth - view.depth)[view.seen].abs()
    assert (off > 0).float().mean().item() == pytest.approx(0.1, abs=0.02)
    assert off.max() > 0.3


def test_holes_are_where_the_ball_grazes_and_in_spots(view: View) -> None:
    hidden = view.seen & ~noisy(view, "holes", 0).seen
    assert view.normal is not None
    cosine = -(view.normal * CAMERA.rays().directions).sum(-1)
    assert hidden[view.seen & (cosine < 0.3)].all()
    assert 0.1 < hidden.sum() / view.seen.sum() < 0.6
    with pytest.raises(ValueError, match="need a view with normals"):
        noisy(view.without("normal"), "holes", 0)


def test_another_word_is_named(view: View) -> None:
    with pytest.raises(ValueError, match=r"there is no noise 'fog'; give one of 0%, 1%.*4%"):
        noisy(view, "fog", 0)
    assert np.isfinite(noisy(view, "4%", 0).depth[view.seen].numpy()).all()
