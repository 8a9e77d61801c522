"""Scenes of a sensor, and the table of placements."""

import math

import pytest
import roma
import torch
import trimesh

from distrace.data.scan import scan_of_view
from distrace.data.solid import Solid, normalised
from distrace.data.up import Up
from distrace.pose import Similarity
from experiments.datasets.sensor import sensed
from experiments.tables.placement import (
    Placed,
    PlacedTrial,
    by_extent,
    placement_error,
    placement_rows,
    placement_trials,
    turn_about_y,
    verdict_rows,
)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_scene_shows_its_object_where_it_says(hidden: bool) -> None:
    mesh = normalised(trimesh.creation.box((1.0, 0.6, 0.8)))
    scene = sensed(Solid(mesh, mesh), 3, hidden)
    scan = scan_of_view(scene.view, scene.mask, Up.along("y"))
    beyond = scene.place.to_object(scan.points).abs() - torch.tensor(mesh.extents).float() / 2
    on_surface = beyond.amax(-1).abs() < 0.05
    assert on_surface.float().mean() > 0.85, "the rest of the mask is wrong"
    assert float(scan.ups[0] @ torch.tensor([0.0, 1.0, 0.0])) > math.cos(math.radians(4)), "by the floor"
    assert 0.2 < float(scene.place.scale) < 0.8


def test_the_same_seed_is_the_same_scene() -> None:
    mesh = normalised(trimesh.creation.box((1.0, 0.6, 0.8)))
    first, again, other = (sensed(Solid(mesh, mesh), seed, True) for seed in (5, 5, 6))
    assert first.view.depth.equal(again.view.depth)
    assert first.mask.equal(again.mask)
    assert not first.view.depth.equal(other.view.depth)


def test_errors_are_those_of_the_nearest_equal_turn() -> None:
    true = Similarity(roma.random_rotmat(), torch.tensor([1.0, 2.0, 3.0]), torch.tensor(0.5))
    found = Similarity(
        true.rotation @ turn_about_y(183), true.translation + torch.tensor([0.03, 0, 0]), true.scale * 1.1
    )
    degrees, size, centre = placement_error(found, true, [turn_about_y(0), turn_about_y(180)])
    assert degrees == pytest.approx(3, abs=0.05)
    assert size == pytest.approx(10, abs=0.01)
    assert centre == pytest.approx(3, abs=0.01)
    assert placement_error(found, true, [turn_about_y(0)])[0] == pytest.approx(177, abs=0.05)


def test_an_object_that_fills_half_of_the_sphere_is_as_large_as_it_is() -> None:
    true = Similarity(roma.random_rotmat(), torch.tensor([1.0, 2.0, 3.0]), torch.tensor(0.5))
    mesh = normalised(trimesh.creation.box((1.0, 0.6, 0.8)))
    half = mesh.copy().apply_scale(0.5).apply_translation((0.1, 0.0, 0.0))
    shift = true.turned(torch.tensor([0.1, 0.0, 0.0]))
    latent = Similarity(true.rotation, true.translation - shift, true.scale * 2)
    found = by_extent(half, latent)
    assert max(placement_error(found, true, [turn_about_y(0)])[1:]) < 0.01
    assert placement_error(latent, true, [turn_about_y(0)])[1] == pytest.approx(100)


def result(shape: str, told: bool, chamfer: float, degrees: float, verdict: str) -> Placed:
    return Placed(
        PlacedTrial("sofas", shape, 0, told), degrees, 1.0, 1.0, chamfer, verdict, 1.0, 0.0, 1.0, 0.0, 5.0, 100
    )


def test_rows_tell_shares_and_ratios() -> None:
    results = [result(f"invented-{k}", False, 2.0 + k, 1.0 if k else 90.0, "trusted") for k in range(4)]
    results += [result(f"invented-{k}", True, 1.0, 0.0, "trusted") for k in range(4)]
    results.append(result("real", False, 100.0, 50.0, "failed"))
    invented, real = placement_rows(results)
    assert (invented["n"], invented["placed"], invented["chamfer_to_told_median"]) == (4, 0.75, 3.5)
    assert (real["n"], real["placed"], real["chamfer_to_told_median"]) == (1, 0.0, None)
    failed, trusted = verdict_rows(results)
    assert failed["within twice the usual error"] == 0
    assert trusted["within twice the usual error"] == 1


def test_trials_are_of_held_out_and_of_invented_shapes() -> None:
    trials = placement_trials(["sofas", "planes"], 2, 3, told=True)
    assert len(trials) == len(set(trials)) == 2 * 2 * 5
    assert sum(trial.told for trial in trials) == 10
