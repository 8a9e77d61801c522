"""The gradient of outlines against differences of finer images, where Mitsuba is not needed."""

import pytest
import torch

from distrace.camera import Camera
from experiments.costs import boundary_gradients


def test_our_gradients_of_outlines_agree_with_differences_of_finer_images(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(boundary_gradients, "FINER", 4)
    camera = Camera.orbit(30, 20, 4.97, focal_mm=85, height=24, width=24, dtype=torch.float64)
    rows = list(boundary_gradients.boundary_rows(camera, ("distrace",)))
    assert [(row.field, row.parameter) for row in rows] == [
        (shape, parameter) for shape in boundary_gradients.SHAPES for parameter in boundary_gradients.PARAMETERS
    ]
    largest = {shape: max(abs(row.difference) for row in rows if row.field == shape) for shape in ("sphere", "cube")}
    assert all(abs(row.derivative - row.difference) < 0.03 * largest[row.field] for row in rows)
