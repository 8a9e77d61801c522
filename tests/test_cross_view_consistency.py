"""Cross-view consistency: pixels beside a ball that look like it in one view only."""

import pytest
import torch
from photographed import ball
from test_fit_photos import ring

from distrace.photos.visual_hull import consistent_silhouettes

SIZE = 48
CAMERAS = ring(size=SIZE)


@pytest.fixture(scope="module")
def masks() -> list[torch.Tensor]:
    return [ball(camera, 0.4) for camera in CAMERAS]


def test_pixels_that_one_view_alone_has_are_ruled_out_and_the_object_is_kept(masks: list[torch.Tensor]) -> None:
    likely = list(masks)
    likely[3] = likely[3].clone()
    likely[3][:8, :8] = True  # a neighbour of the same colour
    shown = consistent_silhouettes(CAMERAS, likely)
    assert not shown[3][:8, :8].any()
    assert all((mask & ~possible).sum() == 0 for mask, possible in zip(masks, shown, strict=True))


def test_an_object_that_one_view_lacks_is_kept(masks: list[torch.Tensor]) -> None:
    likely = list(masks)
    likely[3] = torch.zeros_like(likely[3])
    shown = consistent_silhouettes(CAMERAS, likely)
    assert all((mask & ~possible).sum() == 0 for mask, possible in zip(masks, shown, strict=True))


def test_empty_masks_have_empty_silhouettes() -> None:
    shown = consistent_silhouettes(CAMERAS, [torch.zeros(SIZE, SIZE).bool()] * len(CAMERAS))
    assert not torch.stack(shown).any()
