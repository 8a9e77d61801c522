"""A ball, and what a camera sees of it, as fixtures."""

from typing import Any

import pytest
import torch

from distrace.camera import Camera
from distrace.fields.primitives import sphere
from distrace.render import Buffers, render

BALL = sphere(0.7)


def camera_and_buffers(height: int, width: int) -> tuple[Any, Any]:
    """Returns the fixtures `camera` and `seen` of a test module; the second is the ball rendered by the first."""

    @pytest.fixture(scope="module")
    def camera() -> Camera:
        return Camera.orbit(30, 20, 4.0, height=height, width=width)

    @pytest.fixture(scope="module")
    def seen(camera: Camera) -> Buffers:
        with torch.no_grad():
            return render(BALL, camera)

    return camera, seen
