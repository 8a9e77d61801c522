"""The race of the solvers: a curve of each, and the rows of the table."""

from collections.abc import Iterator
from dataclasses import replace

import pytest
import torch
import trimesh
from spheres import Spheres

from distrace.camera import Camera
from distrace.checkpoints.model import Model
from distrace.data.observation import View
from distrace.fitting.fit import Step
from distrace.rays import meet_sphere
from experiments.costs import solvers
from experiments.costs.pages import solvers_page


def steps(losses: list[float]) -> Iterator[Step]:
    for i, loss in enumerate(losses):
        yield Step(0, i + 1, loss, {}, torch.full((4,), loss), 0.5, 10)


def test_a_curve_measures_some_of_the_steps_and_adds_up_what_all_took() -> None:
    curve = solvers.measured(steps([4.0, 3.0, 2.0, 1.0]), 2, lambda code: float(code[0]))
    assert curve.seconds == [1.0, 2.0]
    assert curve.losses == [3.0, 1.0]
    assert curve.evaluations == 40
    assert [curve.reached(loss) for loss in (5.0, 3.0, 2.0, 0.5)] == [1.0, 1.0, 2.0, None]


@pytest.mark.slow
def test_both_solvers_complete_a_shape_and_their_rows_say_how_fast(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solvers, "ADAM", replace(solvers.ADAM, iterations=40, mask_rays=200))
    spread = 0.1 * torch.randn(12, 4, generator=torch.Generator().manual_seed(0))
    codes = spread + torch.tensor([0.5, 0.0, 0.0, 0.0])
    model = Model("spheres", Spheres(), codes, tuple(f"sphere {i}" for i in range(12)))
    camera = Camera.orbit(30, 20, 2.5, height=40, width=40, focal_px=40.0)
    bounds = meet_sphere(camera.rays(), 0.6)
    view = View(camera, camera.depth(bounds.near), bounds.meets).sparse(100)
    measured = list(solvers.compared(model, "ball", 100, view, trimesh.creation.icosphere(4, 0.6), 32))
    adam, lm = (row for row, _ in measured)
    assert (adam.solver, lm.solver, lm.shape, lm.points) == ("adam", "lm", "ball", 100)
    assert adam.ratio == 1.0
    assert lm.reached is not None
    assert lm.ratio == pytest.approx(lm.reached / adam.seconds)
    assert lm.chamfer < 1
    page = solvers_page(measured)
    assert "ball, 100 depths" in page
    assert page.count("<svg") == 1
