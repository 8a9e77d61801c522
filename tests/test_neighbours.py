"""Pixels beside pixels, against loops over rows and columns, in images of odd sizes and batches of them."""

import math
from itertools import product

import torch
from hypothesis import given
from hypothesis import strategies as st

from distrace.fast.neighbours import SIDES, Grid

f64, cpu = torch.float64, torch.device("cpu")
shapes = st.tuples(st.integers(1, 3), st.integers(1, 11), st.integers(1, 9)).map(torch.Size)
strides = st.sampled_from([1, 2, 4])
Place = tuple[int, int, int]


def places(shape: torch.Size) -> list[Place]:
    """Image, row and column of every pixel, in order."""
    return list(product(*map(range, shape)))


def index(shape: torch.Size, place: Place) -> int:
    image, row, column = place
    return (image * shape[1] + row) * shape[2] + column


def neighbour(shape: torch.Size, place: Place, down: int, right: int) -> int | None:
    """Of the same image; nothing beyond its border."""
    image, row, column = place[0], place[1] + down, place[2] + right
    return index(shape, (image, row, column)) if 0 <= row < shape[1] and 0 <= column < shape[2] else None


def values_of(shape: torch.Size, seed: int = 0) -> torch.Tensor:
    return torch.rand(shape.numel(), generator=torch.Generator().manual_seed(seed), dtype=f64)


@given(shapes, strides)
def test_between_are_the_pixels_of_a_stride_that_the_next_coarser_lacks(shape: torch.Size, stride: int) -> None:
    on_grid = [p for p in places(shape) if p[1] % stride == 0 and p[2] % stride == 0]
    fresh = [p for p in on_grid if p[1] % (2 * stride) or p[2] % (2 * stride)]
    assert Grid(shape).between(stride, True, cpu).tolist() == [index(shape, p) for p in on_grid]
    assert Grid(shape).between(stride, False, cpu).tolist() == [index(shape, p) for p in fresh]


@given(shapes)
def test_every_pixel_is_of_one_stride(shape: torch.Size) -> None:
    grid = Grid(shape)
    strides = [grid.between(8, True, cpu), *(grid.between(stride, False, cpu) for stride in (4, 2, 1))]
    assert sorted(torch.cat(strides).tolist()) == list(range(shape.numel()))


@given(shapes, strides)
def test_parents_are_the_coarser_pixels_around_or_the_last_before_the_border(shape: torch.Size, stride: int) -> None:
    pixels = Grid(shape).between(stride, False, cpu)
    parents, weights = Grid(shape).parents(pixels, stride)
    coarse = 2 * stride
    for pixel, found, weight in zip(pixels.tolist(), parents.tolist(), weights.tolist()):
        image, row, column = places(shape)[pixel]
        top, left = row - row % coarse, column - column % coarse
        bottom = top + coarse if top + coarse < shape[1] else top
        right = left + coarse if left + coarse < shape[2] else left
        around = [(image, top, left), (image, top, right), (image, bottom, left), (image, bottom, right)]
        assert found == [index(shape, place) for place in around]
        y, x = row % coarse / coarse, column % coarse / coarse
        assert weight == [(1 - y) * (1 - x), (1 - y) * x, y * (1 - x), y * x]


@given(shapes, strides)
def test_parents_are_of_the_strides_before(shape: torch.Size, stride: int) -> None:
    grid = Grid(shape)
    pixels = grid.between(stride, False, cpu)
    parents, weights = grid.parents(pixels, stride)
    assert set(parents.flatten().tolist()) <= set(grid.between(2 * stride, True, cpu).tolist())
    torch.testing.assert_close(weights.sum(1), torch.ones(len(pixels)), rtol=0, atol=0)


@given(shapes, strides)
def test_behind_is_through_each_parent_and_twice_as_far_again(shape: torch.Size, stride: int) -> None:
    grid = Grid(shape)
    pixels = grid.between(stride, False, cpu)
    parents, _ = grid.parents(pixels, stride)
    for pixel, around, found in zip(pixels.tolist(), parents.tolist(), grid.behind(pixels, parents).tolist()):
        image, row, column = places(shape)[pixel]
        for parent, behind in zip(around, found):
            _, parent_row, parent_column = places(shape)[parent]
            there = neighbour(shape, (image, row, column), 3 * (parent_row - row), 3 * (parent_column - column))
            assert behind == (-1 if there is None else there)


@given(shapes, st.integers(1, 3), st.integers(0, 2))
def test_beside_are_the_eight_neighbours_of_the_same_image(shape: torch.Size, reach: int, start: int) -> None:
    values, pixels = values_of(shape), torch.arange(shape.numel())[start::2]
    found = Grid(shape).beside(pixels, values, torch.inf, reach)
    assert found.shape == (8, len(pixels))
    for pixel, beside in zip(pixels.tolist(), found.T.tolist()):
        there = [neighbour(shape, places(shape)[pixel], reach * down, reach * right) for down, right in SIDES]
        assert beside == [math.inf if k is None else values[k].item() for k in there]


def test_sides_are_in_pairs_of_opposites() -> None:
    assert len(set(SIDES)) == 8
    assert [(-y, -x) for y, x in SIDES] == SIDES[::-1]


@given(shapes, st.integers(1, 5))
def test_around_are_pixels_and_their_neighbours_each_once(shape: torch.Size, every: int) -> None:
    pixels = torch.arange(shape.numel())[::every]
    expected = set(pixels.tolist())
    for pixel in pixels.tolist():
        expected |= {neighbour(shape, places(shape)[pixel], down, right) for down, right in SIDES}
    assert Grid(shape).around(pixels).tolist() == sorted(expected - {None})


@given(shapes, st.integers(0, 100))
def test_a_bend_is_the_least_distance_from_a_mean_of_opposite_neighbours(shape: torch.Size, seed: int) -> None:
    """Neighbours that are infinite, or none, have no mean."""
    values = values_of(shape, seed)
    values = values.masked_fill(values > 0.8, torch.inf)
    pixels = torch.isfinite(values).nonzero()[:, 0]
    for pixel, found in zip(pixels.tolist(), Grid(shape).bend(pixels, values).tolist()):
        bends = []
        for down, right in ((-1, -1), (-1, 0), (-1, 1), (0, -1)):
            ends = [neighbour(shape, places(shape)[pixel], sign * down, sign * right) for sign in (1, -1)]
            means = math.inf if None in ends else sum(values[end].item() for end in ends) / 2
            bends.append(abs(values[pixel].item() - means))
        assert found == min(bends) or (math.isinf(min(bends)) and found > 1e300)


@given(shapes, st.floats(-3, 3), st.floats(-3, 3))
def test_a_flat_image_has_no_bends_but_at_its_corners(shape: torch.Size, down: float, right: float) -> None:
    values = torch.tensor([down * row + right * column for _, row, column in places(shape)], dtype=f64)
    bends = Grid(shape).bend(torch.arange(shape.numel()), values)
    for (_, row, column), bend in zip(places(shape), bends.tolist()):
        at_end = row in (0, shape[1] - 1), column in (0, shape[2] - 1)
        assert bend > 1e300 if all(at_end) else bend < 1e-12


def test_no_pixels_have_no_neighbours() -> None:
    grid, nothing, values = Grid(torch.Size([4, 5])), torch.empty(0, dtype=torch.int64), torch.rand(20)
    parents, weights = grid.parents(nothing, 2)
    assert parents.shape == weights.shape == grid.behind(nothing, parents).shape == (0, 4)
    assert grid.beside(nothing, values, 0.0).shape == (8, 0)
    assert grid.around(nothing).shape == grid.bend(nothing, values).shape == (0,)


def test_images_without_batch_axes_are_a_batch_of_one() -> None:
    alone, batch = Grid(torch.Size([5, 7])), Grid(torch.Size([1, 5, 7]))
    pixels = alone.between(2, False, cpu)
    assert pixels.tolist() == batch.between(2, False, cpu).tolist()
    torch.testing.assert_close(alone.parents(pixels, 2), batch.parents(pixels, 2))
