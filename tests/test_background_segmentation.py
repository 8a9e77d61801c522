"""Masks of what stands before something dark."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from distrace.camera import Camera
from distrace.data.background_segmentation import dark_masks, masked
from distrace.data.photograph import Photograph
from distrace.data.photographs import Photographs, UnitSphere


def ball(size: int = 160, radius: float = 40.0) -> Tensor:
    """Which pixels a ball in the middle covers."""
    steps = torch.arange(size) - (size - 1) / 2
    return steps.square()[:, None] + steps.square() < radius**2


def photographed(mask: Tensor, cloth: float) -> Tensor:
    """A yellow thing that a lens blurs, on a table of grey cloth that catches light, with noise."""
    image = torch.full((*mask.shape, 3), 0.02)
    image[110:] = cloth
    image[mask] = torch.tensor([0.8, 0.65, 0.4])
    for _ in range(2):
        image = avg_pool2d(image.permute(2, 0, 1)[None], 3, 1, 1, count_include_pad=False)[0].permute(1, 2, 0)
    random = torch.Generator().manual_seed(0)
    return (image + 0.01 * torch.randn(image.shape, generator=random)).clamp(0, 1)


def test_an_outline_is_where_the_image_changes_most() -> None:
    truth = ball()
    for cloth in (0.02, 0.15):
        (found,) = dark_masks([photographed(truth, cloth)])
        assert (found & truth).sum() / (found | truth).sum() > 0.97, cloth
        assert abs(found.sum() / truth.sum() - 1) < 0.02, "neither halo nor cloth"


def test_what_is_thin_stays() -> None:
    truth = ball()
    truth[60:66, 10:90] = True
    (found,) = dark_masks([photographed(truth, 0.02)])
    assert found[60:66, 12:40].float().mean() > 0.9


def test_a_niche_in_shadow_is_object_and_a_window_is_not() -> None:
    truth = ball()
    image = photographed(truth, 0.02)
    image[70:78, 60:80] = image[0:8, 60:80]
    image[84:92, 60:80] = image[0:8, 60:80] + torch.tensor([0.05, 0.04, 0.02])
    (found,) = dark_masks([image])
    assert found[86:90, 62:78].all(), "lighter than the background, though nearer to it than to the object"
    assert not found[72:76, 62:78].any()


def test_an_image_of_nothing_has_nothing_in_it() -> None:
    blank = torch.zeros(160, 160, 3)
    shown, empty = dark_masks([photographed(ball(), 0.02), blank])
    assert shown.any()
    assert not empty.any()


def around() -> Photographs:
    """Four views of the same image, of which the first has a mask: half of what it should be."""
    image = photographed(ball(), 0.02)
    cameras = [Camera.orbit(90 * k, 10, 3.0, height=160, width=160, focal_px=240.0) for k in range(4)]
    views = [Photograph(f"{k}", camera, image) for k, camera in enumerate(cameras)]
    half = ball(radius=20.0)
    unit_sphere = UnitSphere(torch.zeros(3).double(), 1.0)
    return Photographs((replace(views[0], mask=half), *views[1:]), unit_sphere, "ours")


def test_masks_that_are_given_stay_and_so_does_a_unit_sphere_that_was_told() -> None:
    given = around()
    for known in (True, False):
        found = masked(replace(given, sphere_known=known))
        assert torch.equal(found.views[0].known_mask, given.views[0].known_mask)
        assert all(view.known_mask.any() for view in found.views)
        assert (found.unit_sphere.radius == given.unit_sphere.radius) == known


def test_black_images_end_in_one_sentence() -> None:
    given = around()
    black = [replace(view, image=torch.zeros_like(view.image), mask=None) for view in given.views]
    with pytest.raises(ValueError, match=r"all 4 images have one brightness, 0.00: nothing stands out; give masks"):
        masked(replace(given, views=tuple(black)))
