"""DeepSDF's fit, with a decoder whose shapes are spheres: the code is radius and centre."""

import numpy as np
import pytest
import torch
from spheres import Spheres

from distrace.fields.primitives import sphere
from experiments.baselines.deepsdf import SampleFitConfig, fit_samples

TRUE = torch.tensor([0.45, 0.1, -0.15, 0.05])


def test_a_sphere_is_recovered_from_signed_samples() -> None:
    points = torch.from_numpy(np.random.default_rng(0).uniform(-0.8, 0.8, (2000, 3))).float()
    samples = torch.cat([points, sphere(TRUE[0], TRUE[1:])(points)[:, None]], dim=1)
    fit = fit_samples(Spheres(), samples, SampleFitConfig(iterations=300, samples=500))
    torch.testing.assert_close(fit.code, TRUE, atol=0.02, rtol=0)
    (losses,) = fit.losses.values()
    assert len(losses) == 300
    assert losses[-1] == fit.loss < 0.01
    assert fit.evaluations == 300 * 500


def test_a_fit_without_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="no samples were given"):
        fit_samples(Spheres(), torch.empty(0, 4))
