"""Blurred images of normals: equal at the true camera, and a way to it from where single rays tell nothing."""

from dataclasses import replace

import pytest
import torch
from test_fit_camera import only, shape, turned, view

from distrace.fitting.alignment import Still
from distrace.fitting.blurred import SIZE, Blurred, blurred
from distrace.fitting.fit_camera import APPROACH
from distrace.fitting.solver import minimise
from distrace.pose import pose_error, turned_object


def test_a_blur_keeps_the_sum_and_spreads_it_evenly() -> None:
    image = torch.zeros(1, 21, 21)
    image[0, 10, 10] = 1.0
    found = blurred(image, 1.5)
    assert float(found.sum()) == pytest.approx(1.0, abs=1e-5)
    torch.testing.assert_close(found[0], found[0].T)
    offsets = torch.arange(21.0) - 10
    assert float((found[0].sum(0) * offsets**2).sum()) == pytest.approx(1.5**2, rel=0.05)


def test_at_the_true_camera_little_is_apart() -> None:
    observed = only(view(dtype=torch.float32), "normal")
    images = Blurred.of(Still.of(shape, observed.camera.intrinsics), observed, 2.0)
    assert images.observed.shape == (3, SIZE, SIZE)
    here = images.residuals(observed.camera)
    assert here.values.abs().max() < 0.15 * images.observed.abs().max(), "pooled pixels against their centres"
    assert here.loss(100.0) < 0.05 * images.residuals(turned(observed.camera, 15)).loss(100.0)


def test_from_afar_it_leads_near() -> None:
    observed = only(view(size=48, dtype=torch.float32), "normal")
    images = Blurred.of(Still.of(shape, observed.camera.intrinsics), observed, 2.0)
    start = turned(observed.camera, 35)
    *_, last = minimise(images.residuals, start, lambda camera, x: turned_object(camera, x[:3], x[3:]), APPROACH)
    assert pose_error(start, observed.camera)[0] > 30
    assert pose_error(last.state, observed.camera)[0] < 10, "from 35 degrees, in ten iterations"


def test_what_is_unknown_is_not_compared() -> None:
    observed = only(view(dtype=torch.float32), "normal")
    assert observed.normal is not None
    half = observed.normal.clone()
    half[:, :32] = 0
    images = Blurred.of(Still.of(shape, observed.camera.intrinsics), replace(observed, normal=half), 1.0)
    assert not images.image(observed.camera)[:, :, : SIZE // 2 - 4].any()
    assert images.image(observed.camera).any()


def test_a_view_without_normals_is_refused() -> None:
    observed = only(view(dtype=torch.float32), "depth")
    with pytest.raises(ValueError, match="no normals"):
        Blurred.of(Still.of(shape, observed.camera.intrinsics), observed, 2.0)
