"""Scans: which points are the object's, which space is free, and where up is."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View, save_view
from distrace.data.scan import Scan, canonical_scan, joined, scan_of_points, scan_of_view
from distrace.data.scan_inputs import ScanOptions, load_scan
from distrace.data.up import Up
from distrace.errors import DoubtfulResult
from distrace.files import save_arrays
from distrace.rays import meet_sphere

RADIUS = 0.4
HEIGHT = 96


def room(pitch: float = 25.0, azimuth: float = 0.0) -> tuple[View, torch.Tensor]:
    """A ball on a floor, a wall behind it, and a second, smaller ball beside it; with the mask of the first ball."""
    camera = Camera.orbit(azimuth, pitch, 2.2, height=HEIGHT, width=HEIGHT, focal_px=100.0)
    rays = camera.rays()
    ball = meet_sphere(rays, RADIUS).near
    moved = type(rays)(rays.origins - torch.tensor([0.7, -0.25, 0.0]), rays.directions)
    other = meet_sphere(moved, 0.15).near
    floor = (-RADIUS - rays.origins[..., 1]) / rays.directions[..., 1]
    wall = (-1.5 - rays.origins[..., 2]) / rays.directions[..., 2]
    planes = torch.stack([torch.where(each > 0, each, torch.inf) for each in (floor, wall)]).amin(0)
    nearest = torch.stack([ball, other, planes]).amin(0)
    return View(camera, camera.depth(nearest)), ball <= nearest


def on_ball(scan: Scan) -> float:
    """The share of the points that lie on the larger ball."""
    return float(((scan.points.norm(dim=-1) - RADIUS).abs() < 0.01).float().mean())


def test_a_mask_tells_the_points_and_depths_tell_free_space() -> None:
    scene, mask = room()
    scan = scan_of_view(scene, mask, Up.along("y"))
    assert on_ball(scan) == 1
    assert len(scan.points) == int(mask.sum())
    ending = scan.free_until.isfinite()
    ends = scan.free[ending].at(scan.free_until[ending])
    assert (ends.norm(dim=-1) > RADIUS - 1e-3).all(), "nothing is free within the ball"
    assert (~ending).any(), "the floor and the wall hide nothing of the ball"
    assert not meet_sphere(scan.free[~ending], RADIUS - 0.01).meets.any()
    assert not len(scan.hits.origins)


def test_a_clean_background_is_free_all_along() -> None:
    scene, mask = room()
    scan = scan_of_view(scene.masked(mask), mask, Up.along("y"))
    beside = scan.free_until.isinf()
    assert beside.any()
    assert not meet_sphere(scan.free[beside], RADIUS).meets.any()


def test_a_mask_without_depths_says_where_rays_hit() -> None:
    scene, mask = room()
    holes = torch.zeros_like(mask)
    holes[HEIGHT // 2 - 5 : HEIGHT // 2 + 5] = True
    scan = canonical_scan(View(scene.camera, scene.depth.masked_fill(~mask | holes, torch.inf), mask))
    assert len(scan.hits.origins) == int((mask & holes).sum())
    assert meet_sphere(scan.hits, RADIUS).meets.all()


def test_a_rectangle_leaves_out_the_floor_and_other_things() -> None:
    scene, mask = room()
    rows, columns = mask.any(1).nonzero()[:, 0], mask.any(0).nonzero()[:, 0]
    box = torch.zeros_like(mask)
    box[int(rows[0]) - 4 : int(rows[-1]) + 8, int(columns[0]) - 8 : HEIGHT] = True
    scan = scan_of_view(scene, box, Up.along("y"), isolate=True)
    assert (scene.seen & box & ~mask).sum() > mask.sum() / 2, "much in the rectangle is not the ball"
    assert on_ball(scan) > 0.97
    assert len(scan.points) > 0.8 * int(mask.sum())


def test_nothing_is_below_the_floor() -> None:
    scene, mask = room()
    scan = scan_of_view(scene, mask, Up.along("y"))
    level = scan.free.directions[:, 1].abs() < 0.02
    heights = scan.free.origins[level, 1]
    assert int(level.sum()) > 1000
    assert (heights < -RADIUS).all()
    assert (heights > -1.2 * RADIUS).all()
    nearest = -(scan.free.origins[level] * scan.free.directions[level]).sum(1)
    ahead = scan.free[level].at(nearest)
    assert (ahead[:, [0, 2]].norm(dim=-1) < 2 * RADIUS).float().mean() > 0.9, "they pass under the ball"
    assert scan.free_until[level].isinf().all()


@pytest.mark.parametrize("pitch", [0.0, 25.0, 40.0])
def test_the_floor_tells_up_in_a_cameras_frame(pitch: float) -> None:
    scene, mask = room(pitch)
    here = View(Camera(scene.camera.intrinsics, torch.eye(4), HEIGHT, HEIGHT), scene.depth)
    scan = scan_of_view(here, mask, Up.of_camera(torch.eye(3)))
    true_up = scene.camera.T_world_camera[:3, :3].T @ torch.tensor([0.0, 1.0, 0.0])
    assert len(scan.ups) == 1
    assert float(scan.ups[0] @ true_up) > math.cos(math.radians(2))


def test_without_a_floor_a_camera_may_look_down() -> None:
    scene, mask = room()
    ups = scan_of_view(scene.masked(mask), mask, Up.of_camera(torch.eye(3))).ups
    assert len(ups) == 3
    torch.testing.assert_close(ups[0], torch.tensor([0.0, -1.0, 0.0]))
    torch.testing.assert_close(ups.norm(dim=-1), torch.ones(3))


def test_nothing_is_free_around_a_cloud_and_noise_is_told() -> None:
    points = torch.nn.functional.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    clean = scan_of_points(50 * points, Up.along("unknown"))
    assert not len(clean.free_until)
    assert not len(clean.ups)
    assert clean.radius == pytest.approx(62.5, rel=0.05), "a fifth of the points might be outliers"
    away = torch.randn(4000, 1, generator=torch.Generator().manual_seed(1))
    noisy = scan_of_points(50 * points + 2.0 * away * points, Up.along("z"))
    assert noisy.noise == pytest.approx(2.0, rel=0.25)
    assert clean.noise < 0.3
    assert noisy.ups.tolist() == [[0, 0, 1]]


def test_points_far_from_everything_are_left_out() -> None:
    points = torch.randn(1000, 3, generator=torch.Generator().manual_seed(0))
    points[:5] = torch.tensor([1e4, 0.0, 0.0])
    assert len(scan_of_points(points, Up.along("y")).points) == 995


@pytest.mark.parametrize(
    ("points", "sentence"),
    [(torch.zeros(0, 3), "0 points"), (torch.zeros(5, 3), "5 points"), (torch.ones(50, 3), "one place")],
)
def test_too_few_points_are_refused(points: torch.Tensor, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        scan_of_points(points, Up.along("y"))


def test_files_of_all_kinds_are_read(tmp_path: Path) -> None:
    scene, mask = room()
    camera = scene.camera
    millimetres = torch.where(scene.seen, scene.depth * 1000, 0.0).numpy().astype(np.uint16)
    Image.fromarray(millimetres).save(tmp_path / "depth.png")
    Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
    fx, _, cx, _, fy, cy = camera.intrinsics.reshape(-1)[:6].tolist()
    options = ScanOptions(intrinsics=f"{fx},{fy},{cx},{cy}", mask=tmp_path / "mask.png")
    image = load_scan([tmp_path / "depth.png"], options)
    in_world = image.points @ camera.T_world_camera[:3, :3].T + camera.T_world_camera[:3, 3]
    assert ((in_world.norm(dim=-1) - RADIUS).abs() < 0.01).all()
    arrays = {"depth": scene.depth, "intrinsics": camera.intrinsics, "T_world_camera": camera.T_world_camera}
    save_arrays(tmp_path / "view.npz", {**arrays, "mask": mask})
    assert on_ball(load_scan([tmp_path / "view.npz"])) == 1
    both = load_scan([tmp_path / "view.npz", tmp_path / "view.npz"])
    assert len(both.views) == 2
    assert len(both.points) == 2 * int(mask.sum())
    ball = trimesh.creation.icosphere(subdivisions=3, radius=7.0)
    ball.export(tmp_path / "ball.ply")
    np.savetxt(tmp_path / "ball.xyz", ball.vertices)
    for name in ("ball.ply", "ball.xyz"):
        np.testing.assert_allclose(load_scan([tmp_path / name]).points.norm(dim=-1).numpy(), 7.0, rtol=1e-5)


def test_joined_scans_keep_all_rays() -> None:
    scene, mask = room()
    scan = scan_of_view(scene, mask, Up.along("y"))
    both = joined([scan, scan])
    assert len(both.free_until) == 2 * len(scan.free_until) == len(both.free.origins)


def test_points_that_are_not_finite_are_dropped_with_a_word(tmp_path: Path) -> None:
    points = np.random.default_rng(0).normal(size=(100, 3))
    points[:3] = np.nan
    trimesh.PointCloud(points).export(tmp_path / "nan.ply")
    with pytest.warns(DoubtfulResult, match="3 points that are not finite"):
        assert len(load_scan([tmp_path / "nan.ply"]).points) == 97


def test_a_view_says_that_it_is_canonical(tmp_path: Path) -> None:
    from distrace.data.observation import is_canonical

    scene, mask = room()
    save_view(tmp_path / "view.npz", scene.masked(mask))
    arrays = {"depth": scene.depth, "intrinsics": scene.camera.intrinsics, "T_world_camera": torch.eye(4)}
    save_arrays(tmp_path / "other.npz", arrays)
    (tmp_path / "text.npz").write_text("hello")
    assert is_canonical(tmp_path / "view.npz")
    assert not any(is_canonical(tmp_path / name) for name in ("other.npz", "text.npz", "missing.npz"))


def test_a_silhouette_alone_is_a_canonical_scan() -> None:
    scene, mask = room()
    scan = canonical_scan(View(scene.camera, torch.full_like(scene.depth, torch.inf), mask))
    assert not len(scan.points)
    assert len(scan.hits.origins) == int(mask.sum())
    assert len(canonical_scan(Cloud(torch.randn(30, 3))).points) == 30


def test_a_box_outside_of_the_image_is_refused(tmp_path: Path) -> None:
    scene, _ = room()
    arrays = {"depth": scene.depth, "intrinsics": scene.camera.intrinsics, "T_world_camera": torch.eye(4)}
    save_arrays(tmp_path / "view.npz", arrays)
    with pytest.raises(ValueError, match=r"view\.npz: --box 5 5 200 20 was given.*96 × 96"):
        load_scan([tmp_path / "view.npz"], ScanOptions(box=(5, 5, 200, 20)))
    with pytest.raises(ValueError, match=r"x\.png is a depth image, and needs --intrinsics"):
        load_scan([tmp_path / "x.png"])
    with pytest.raises(ValueError, match="no input was given; give a depth image"):
        load_scan([])
