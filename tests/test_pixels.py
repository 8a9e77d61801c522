"""Rectangles about masks."""

import torch

from distrace.pixels import rectangle_around


def test_a_rectangle_has_its_margins_and_ends_at_the_border() -> None:
    mask = torch.zeros(8, 10, dtype=torch.bool)
    mask[1, 4] = mask[3, 8] = True
    lengths = []

    def margins(length: int) -> tuple[int, int]:
        lengths.append(length)
        return 2, 1

    found = rectangle_around(mask, margins)
    expected = torch.zeros_like(mask)
    expected[0:5, 2:10] = True
    assert found.equal(expected)
    assert lengths == [3, 5], "the height comes first"
