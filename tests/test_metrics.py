"""Measures, where the answer is known."""

import math

import numpy as np
import pytest
import torch
import trimesh

from distrace.metrics import POINTS, chamfer, depth_errors, iou, surface_points


def sphere(radius: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=radius)


def spread(area: float) -> float:
    """The mean squared distance to the nearest of so many random points on an area: 1 / (π density)."""
    return area / (math.pi * POINTS)


def test_chamfer_of_two_concentric_spheres_is_the_squared_difference_of_their_radii() -> None:
    """And what the sampling adds: within the surface the nearest point is off by 1 / (π density)."""
    measured = chamfer(sphere(0.5), sphere(0.6))
    gap = 0.1**2
    assert measured.to == pytest.approx(1000 * (gap + 0.5 / 0.6 * spread(4 * math.pi * 0.6**2)), rel=0.01)
    assert measured.from_ == pytest.approx(1000 * (gap + 0.6 / 0.5 * spread(4 * math.pi * 0.5**2)), rel=0.01)
    assert measured.sum == measured.to + measured.from_


def test_chamfer_of_a_surface_with_itself_is_the_floor_of_the_sampling() -> None:
    floor = 1000 * spread(4 * math.pi * 0.5**2)
    assert chamfer(sphere(0.5), sphere(0.5)).to == pytest.approx(floor, rel=0.1)


def test_chamfer_of_translated_planes_is_the_squared_translation() -> None:
    ticks = np.linspace(-0.5, 0.5, 21)
    plane = np.stack([*np.meshgrid(ticks, ticks), np.zeros((21, 21))], axis=-1).reshape(-1, 3)
    moved = chamfer(plane, plane + np.array([0, 0, 0.2]))
    assert moved.to == pytest.approx(1000 * 0.04)
    assert moved.from_ == pytest.approx(1000 * 0.04)
    assert chamfer(plane, plane).sum == 0


def test_each_direction_is_its_own() -> None:
    """What is missing counts in one direction, what is too much in the other."""
    whole, half = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0]])
    missing = chamfer(half, whole)
    assert (missing.to, missing.from_) == (0, 500)
    surplus = chamfer(whole, half)
    assert (surplus.to, surplus.from_) == (500, 0)


def test_the_measure_of_the_same_meshes_is_the_same_again() -> None:
    first, again, other = (chamfer(sphere(0.5), sphere(0.6), seed=seed) for seed in (1, 1, 2))
    assert first == again != other


def test_points_are_spread_evenly_over_the_area() -> None:
    points = surface_points(trimesh.creation.box([1, 1, 3]), POINTS, seed=0)
    assert points.shape == (POINTS, 3)
    on_ends = np.isclose(np.abs(points[:, 2]), 1.5).mean()
    assert on_ends == pytest.approx(2 / 14, rel=0.05)


@pytest.mark.parametrize(
    "nothing", [np.zeros((0, 3)), np.zeros((5, 2)), np.zeros(3), trimesh.Trimesh()], ids=["empty", "2d", "1d", "mesh"]
)
def test_what_is_no_surface_is_refused(nothing: trimesh.Trimesh | np.ndarray) -> None:
    for pair in ((nothing, np.zeros((4, 3))), (np.zeros((4, 3)), nothing)):
        with pytest.raises(ValueError, match=r"without faces|shape \["):
            chamfer(*pair)


def test_iou_counts_pixels() -> None:
    first = torch.tensor([[True, True, False], [True, False, False]])
    second = torch.tensor([[True, False, True], [True, False, False]])
    assert iou(first, second) == pytest.approx(2 / 4)
    assert iou(first, first) == 1
    assert iou(first, ~first) == 0
    assert iou(first & ~first, first & ~first) == 1


def test_depth_errors_are_taken_where_both_see() -> None:
    depth = torch.tensor([1.0, 2.0, torch.inf, torch.inf, 3.0])
    reference = torch.tensor([1.5, torch.inf, 2.0, torch.inf, 2.75])
    assert depth_errors(depth, reference).tolist() == [0.5, 0.25]
