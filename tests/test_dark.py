"""Masks of what stands before something dark."""

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from distrace.data.dark import dark_masks


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
