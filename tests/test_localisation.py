"""The initial placement of a painted bumpy ball, before its shape is known."""

from dataclasses import replace

import pytest
import torch
from bumpy import bumpy_balls
from test_fit_photos import COMPARED, GREY, PRIOR, TRUE, photographs, ring

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF, placed
from distrace.photos.initialisation import locate
from distrace.photos.photo_set import PhotoSet
from distrace.pose import Similarity

SHIFTED = Similarity(torch.eye(3), torch.tensor([0.15, -0.1, 0.12]), torch.tensor(0.9))


@pytest.fixture(scope="module")
def views() -> list[Photograph]:
    return photographs(bumpy_balls(0.4), ring(), SHIFTED)


def found(views: list[Photograph], *others: SDF) -> Similarity:
    typical = [bumpy_balls(0.4).field(TRUE), *others]
    return locate(PhotoSet(bumpy_balls(0.4), views, PRIOR, COMPARED), typical, Similarity.identity())


@pytest.mark.parametrize("masked", [False, True])
def test_a_shifted_and_scaled_object_is_located(views: list[Photograph], masked: bool) -> None:
    if masked:
        views = [replace(view, mask=((view.image - GREY).abs().amax(-1) > 0.02)) for view in views]
    there = found(views)
    assert (there.translation - SHIFTED.translation).norm() < 0.08  # a pixel is 0.04
    assert float(there.scale) == pytest.approx(0.9, abs=0.05 if masked else 0.1), "without masks it is too small"


def test_one_shape_that_is_not_typical_is_outvoted(views: list[Photograph]) -> None:
    lost = placed(bumpy_balls(0.4).field(TRUE), torch.diag(torch.tensor([0.3, 0.3, 0.3, 1.0])))
    some = views[::2]
    there = found(some)
    again = found(some, bumpy_balls(0.4).field(TRUE), lost)
    assert float(again.scale) == pytest.approx(float(there.scale), abs=0.01)
    assert float(found(some, lost, lost).scale) > 2 * float(there.scale), "the median counts"


def test_without_an_object_the_placement_stays(views: list[Photograph]) -> None:
    some = views[::3]
    blank = [replace(view, image=GREY.expand_as(view.image)) for view in some]
    assert found(blank).scale == 1
    assert found([replace(view, mask=torch.zeros(view.image.shape[:2]).bool()) for view in some]).scale == 1
