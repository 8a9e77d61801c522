"""The placement network: its grids, where guesses lie, and what is said of a damaged file."""

from dataclasses import replace
from pathlib import Path

import pytest
import roma
import torch

import distrace as dt
from distrace.checkpoints.model import bundled_models
from distrace.data.observation import View
from distrace.data.scan import Scan, scan_of_points, scan_of_view
from distrace.data.up import Up
from distrace.fitting.fit_scan import ScanFitConfig, fit_scan
from distrace.fitting.placement_network import (
    CELLS,
    PLACEMENT_FILE,
    SLICES,
    TURN_BINS,
    GridFrame,
    PlacementGuess,
    grids_of,
    guess_placement,
    load_placement_network,
)
from distrace.fitting.rounds import Round
from distrace.fitting.solver import charbonnier
from distrace.pose import Similarity
from distrace.rays import Rays

UP = torch.tensor([0.0, 1.0, 0.0])
PLACE = Similarity(
    roma.rotvec_to_rotmat(torch.tensor([0.0, 0.7, 0.0])), torch.tensor([0.2, -0.1, 0.3]), torch.tensor(0.5)
)


def level_frame() -> GridFrame:
    ahead = torch.tensor([[0.3, -0.4, -1.0]])
    return GridFrame.facing(UP[None], ahead, torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([2.0]))


def test_a_frame_is_upright_and_faces_the_viewer() -> None:
    frame = level_frame()
    torch.testing.assert_close(frame.axes[0].T @ frame.axes[0], torch.eye(3))
    assert torch.linalg.det(frame.axes[0]) > 0
    torch.testing.assert_close(frame.axes[0, :, 1], UP)
    assert frame.axes[0, :, 2] @ torch.tensor([0.3, 0.0, -1.0]) < 0
    torch.testing.assert_close(frame.points(frame.centre[:, None]), torch.zeros(1, 1, 3))


def test_cells_hold_the_points_that_are_known_and_within_reach() -> None:
    frame = replace(level_frame(), axes=torch.eye(3)[None], centre=torch.zeros(1, 3), radius=torch.ones(1))
    points = torch.tensor([[[0.01, 0.01, 0.01], [0.02, 0.02, 0.02], [0.5, -1.5, 0.5], [9.0, 0.0, 0.0]]])
    known = torch.tensor([[True, True, False, True]])
    nothing = Rays(torch.zeros(1, 1, 3), torch.tensor([[[0.0, 0.0, 1.0]]]))
    grid = grids_of(frame, points, known, nothing, torch.zeros(1, 1), torch.Generator())
    assert grid.shape == (1, 2 * SLICES, CELLS, CELLS)
    torch.testing.assert_close(grid[0, SLICES // 2, CELLS // 2, CELLS // 2], torch.tensor(3.0).log())
    assert grid.count_nonzero() == 1


def test_free_space_ends_before_the_surface() -> None:
    frame = replace(level_frame(), axes=torch.eye(3)[None], centre=torch.zeros(1, 3), radius=torch.ones(1))
    ray = Rays(torch.tensor([[[0.01, 0.01, -3.0]]]), torch.tensor([[[0.0, 0.0, 1.0]]]))
    rays = Rays(ray.origins.expand(1, 200, 3), ray.directions.expand(1, 200, 3))
    points = torch.zeros(1, 0, 3)
    known = torch.zeros(1, 0, dtype=torch.bool)
    grid = grids_of(frame, points, known, rays, torch.full((1, 200), 3.0), torch.Generator())
    depth = grid[0, SLICES:].sum((0, 2))  # along z, where the ray goes; it ends in the middle
    assert (depth[: CELLS // 2 - 1] > 0).all()
    assert depth[CELLS // 2 :].sum() == 0


def test_likely_turns_are_apart_and_the_best_comes_first() -> None:
    turns = torch.full((TURN_BINS,), 1e-3)
    turns[[10, 11, 46]] = torch.tensor([0.2, 0.4, 0.3])
    guess = PlacementGuess(torch.eye(3), turns, torch.zeros(3), torch.tensor(2.0), 0.1, 0.1)
    first, second, third = (roma.rotmat_to_rotvec(place.rotation)[1].rad2deg() for place in guess.places(3))
    assert float(first) == pytest.approx(53.3, abs=0.5)  # between 50 and 55 degrees, by their probabilities
    assert float(second) == pytest.approx(46 * 5 - 360, abs=0.5)
    assert abs(float(third - first)) > 15


@pytest.fixture(scope="module")
def scan() -> Scan:
    """A depth image of a training chair, placed somewhere."""
    sdf = dt.load_model("chairs").field(400)
    camera = dt.Camera.orbit(25, 20, 4.5, height=72, width=72)
    with torch.no_grad():
        buffers = dt.render(sdf, camera)
    pose = camera.T_world_camera.clone()
    pose[:3, :3] = PLACE.rotation @ pose[:3, :3]
    pose[:3, 3] = PLACE.to_world(pose[:3, 3])
    depth = (buffers.depth * PLACE.scale).masked_fill(~buffers.mask, torch.inf)
    return scan_of_view(View(replace(camera, T_world_camera=pose), depth), buffers.mask, Up.along("y"))


def test_the_network_finds_a_chair(scan: Scan) -> None:
    network = load_placement_network("chairs")
    assert network is not None
    guess = guess_placement(network, scan, UP)
    apart = [float(roma.rotmat_geodesic_distance(each.rotation, PLACE.rotation)) for each in guess.places(3)]
    assert min(apart) < 0.2
    assert float(guess.size / PLACE.scale) == pytest.approx(1, abs=0.15)
    assert float((guess.centre - PLACE.translation).norm()) < 0.2 * float(PLACE.scale)


@pytest.mark.slow
def test_a_fit_starts_at_the_guess_and_tells_how_far_it_went(scan: Scan) -> None:
    model = dt.load_model("chairs")
    network = load_placement_network("chairs")
    short = ScanFitConfig(rounds=(Round(3, 2, 8, 60, 40, 4, 0.06, charbonnier),))
    fit = fit_scan(model.decoder, scan, dt.prior_of(model.codes), short, network=network)
    assert float(fit.place.scale / PLACE.scale) == pytest.approx(1, abs=0.15)
    assert fit.verdict.prior_deviation is not None
    told = fit_scan(model.decoder, scan, dt.prior_of(model.codes), short, PLACE, network=network)
    assert told.place is PLACE
    assert told.verdict.prior_deviation is None
    assert fit_scan(model.decoder, scan, dt.prior_of(model.codes), short).verdict.prior_deviation is None


def test_a_guess_moves_with_the_scan(scan: Scan) -> None:
    network = load_placement_network("chairs")
    assert network is not None
    quarter = torch.tensor([0.0, torch.pi / 2, 0.0])  # by which medians of coordinates turn, too
    turn = roma.rotvec_to_rotmat(quarter)
    motion = Similarity(turn, torch.tensor([3.0, 1.0, -2.0]), torch.tensor(4.0))
    rays = Rays(motion.to_world(scan.free.origins), motion.turned(scan.free.directions))
    (view,) = scan.views
    pose = view.camera.T_world_camera.clone()
    pose[:3, 3] = motion.to_world(pose[:3, 3])
    moved = replace(
        scan,
        points=motion.to_world(scan.points),
        free=rays,
        free_until=4.0 * scan.free_until,
        views=(replace(view, camera=replace(view.camera, T_world_camera=pose)),),
    )
    first = guess_placement(network, scan, UP)
    second = guess_placement(network, moved, UP)
    torch.testing.assert_close(second.centre, motion.to_world(first.centre), atol=2e-2, rtol=0)
    torch.testing.assert_close(second.size, 4.0 * first.size, atol=2e-2, rtol=0)
    torch.testing.assert_close(second.turns, first.turns, atol=2e-2, rtol=0)


def test_a_cloud_without_a_viewer_has_a_guess() -> None:
    network = load_placement_network("chairs")
    assert network is not None
    points = torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    guess = guess_placement(network, scan_of_points(points, Up.along("y")), UP)
    assert guess.centre.isfinite().all()
    assert float(guess.turns.sum()) == pytest.approx(1, abs=1e-4)


def test_a_model_without_a_network_has_none_and_a_damaged_one_is_named(tmp_path: Path) -> None:
    assert load_placement_network(tmp_path) is None
    (tmp_path / PLACEMENT_FILE).write_bytes(b"no tensors")
    with pytest.raises(ValueError, match=r"placement\.safetensors is not a safetensors file of a placement network"):
        load_placement_network(tmp_path)


@pytest.mark.parametrize("name", bundled_models())
def test_every_bundled_model_has_a_network(name: str) -> None:
    assert load_placement_network(name) is not None
