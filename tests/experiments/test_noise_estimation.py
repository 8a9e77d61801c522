"""How noisy depths are: told within a sixth from the view alone, and nothing where there is nothing to tell."""

import math

import pytest
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.observation import View, observe
from distrace.data.solid import Solid
from distrace.fitting.noise_estimation import LEAST, expected, noise_of
from experiments.datasets.noise import SIZE, noisy

CAMERA = Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=256, width=256)


@pytest.fixture(scope="module", params=["ball", "box"])
def view(request: pytest.FixtureRequest) -> View:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.7)
    shape = ball if request.param == "ball" else trimesh.creation.box((1.2, 0.7, 0.5))
    return observe(Solid(shape, shape), CAMERA)


@pytest.mark.parametrize("share", [1, 10])
@pytest.mark.parametrize("percent", [1.5, 3, 5])
def test_gaussian_noise_is_told_from_all_depths_and_from_a_tenth(view: View, percent: float, share: int) -> None:
    some = noisy(view, f"{percent}%", 1).sparse(int(view.seen.sum()) // share, 1)
    assert noise_of(some) == pytest.approx(percent / 100 * SIZE, rel=0.17)


@pytest.mark.parametrize("noise", ["0%", "0.3%", "outliers", "holes"])
def test_exact_depths_have_none_and_a_tenth_of_wrong_ones_makes_none(view: View, noise: str) -> None:
    assert noise_of(noisy(view, noise, 1)) == 0.0


@pytest.mark.parametrize("count", [0, 1, LEAST - 1, LEAST, 200])
def test_few_depths_tell_nothing(view: View, count: int) -> None:
    assert noise_of(noisy(view, "5%", 1).sparse(count)) == 0.0, "neighbours are too far apart"


@pytest.mark.parametrize("most", [0.02, 0.1, 10.0])
def test_expected_deviations_are_those_of_draws(most: float) -> None:
    noise = torch.tensor([0.0, 0.01, 0.06, 0.3], dtype=torch.float64)
    random = torch.Generator().manual_seed(0)
    draws = torch.randn(200_000, 1, generator=random, dtype=torch.float64) * noise
    torch.testing.assert_close(expected(noise, most), draws.abs().clamp_max(most).mean(0), rtol=0.01, atol=0)
    assert expected(noise, 1e9)[1] == pytest.approx(0.01 * math.sqrt(2 / math.pi))
