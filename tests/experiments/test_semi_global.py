"""Classical stereo on photographs of a painted ball."""

import sys

import numpy as np
import pytest
import torch
from photographed import striped_ball
from test_fit_photos import ring

from distrace.data.photograph import Photograph
from experiments.baselines.semi_global import Rectified, stereo_points

FINER = 1.5  # stripes than those that patches are compared on


def test_points_of_a_painted_ball_lie_on_it() -> None:
    pytest.importorskip("cv2")
    views = striped_ball(ring(24, 120), FINER)
    points = stereo_points(views)
    off = np.abs(np.linalg.norm(points, axis=1) - 0.5)
    assert len(points) > 2000
    assert np.median(off) < 0.01
    assert np.quantile(off, 0.95) < 0.05


def test_rectified_views_see_the_origin_in_their_middle_columns_and_same_rows() -> None:
    pytest.importorskip("cv2")
    first, second = striped_ball(ring(24, 60)[:2], FINER)
    pair = Rectified.of(first, second)
    middle, _ = pair.camera.project(torch.zeros(3, dtype=torch.float64))
    assert middle.tolist() == pytest.approx([60.0, 60.0])
    for image in pair.images:
        rows, columns = np.nonzero(image.mean(-1) > 20)
        assert (rows.min() + rows.max()) / 2 == pytest.approx(59.5, abs=2)
        assert (columns.min() + columns.max()) / 2 == pytest.approx(59.5, abs=2)


def test_images_without_anything_end_in_a_sentence() -> None:
    pytest.importorskip("cv2")
    blank = [Photograph(str(k), camera, torch.full((40, 40, 3), 0.5)) for k, camera in enumerate(ring(6, 40))]
    with pytest.raises(ValueError, match="no three pairs of the 6 views agree on a point"):
        stereo_points(blank)


def test_without_opencv_the_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(ValueError, match=r"stereo needs OpenCV, which is not installed; `pip install 'distrace\[clips"):
        stereo_points(striped_ball(ring(2, 20), FINER))
