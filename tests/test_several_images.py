"""Several depth images of one scene, with the poses of their cameras."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_scan import HEIGHT, RADIUS, on_ball, room

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.data.scan import Scan
from distrace.data.scan_inputs import ScanOptions, load_scan
from distrace.errors import DoubtfulResult
from distrace.files import save_arrays
from distrace.rays import meet_sphere

Write = Callable[..., ScanOptions]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    """Writes a scene as 0.png, 1.png … in millimetres, poses as 0.txt …, intrinsics as K.txt, and the first mask."""

    def written(azimuths: tuple[float, ...] = (0.0, 70.0), drift: float = 0.0) -> ScanOptions:
        for number, azimuth in enumerate(azimuths):
            scene, mask = room(azimuth=azimuth)
            pose = scene.camera.T_world_camera.clone()
            pose[0, 3] += drift * number
            millimetres = torch.where(scene.seen, scene.depth * 1000, 0.0).round().numpy().astype(np.uint16)
            Image.fromarray(millimetres).save(tmp_path / f"{number}.png")
            np.savetxt(tmp_path / f"{number}.txt", pose.numpy())
            if not number:
                Image.fromarray(mask.numpy()).save(tmp_path / "mask.png")
                np.savetxt(tmp_path / "K.txt", scene.camera.intrinsics.numpy())
        poses = tuple(tmp_path / f"{number}.txt" for number in range(len(azimuths)))
        return ScanOptions(intrinsics=str(tmp_path / "K.txt"), mask=tmp_path / "mask.png", poses=poses)

    return written


def images(folder: Path, count: int = 2) -> list[Path]:
    return [folder / f"{number}.png" for number in range(count)]


def turn_seen(scan: Scan) -> float:
    """The range of the points' azimuths about the ball, in degrees."""
    angles = torch.atan2(scan.points[:, 0], scan.points[:, 2])
    return math.degrees(float(angles.quantile(0.98) - angles.quantile(0.02)))


def test_a_further_image_shows_more_of_the_object(write: Write, tmp_path: Path) -> None:
    options = write()
    both = load_scan(images(tmp_path), options)
    first = load_scan(images(tmp_path, 1), ScanOptions(None, options.intrinsics, options.mask, None, options.poses[:1]))
    assert on_ball(first) == 1, "in the world of the poses"
    assert on_ball(both) > 0.99
    assert turn_seen(both) > turn_seen(first) + 10
    assert len(both.views) == 2
    assert float(both.ups[0] @ torch.tensor([0.0, 1.0, 0.0])) > math.cos(math.radians(2))
    ending = both.free_until.isfinite()
    ends = both.free[ending].at(both.free_until[ending])
    assert (ends.norm(dim=-1) > RADIUS - 0.01).all()
    assert not meet_sphere(both.free[~ending], RADIUS - 0.02).meets.any(), "the floor beside the ball hides none of it"


def test_drift_of_the_poses_is_noise(write: Write, tmp_path: Path) -> None:
    exact = load_scan(images(tmp_path), write(azimuths=(0.0, 10.0)))
    drifted = load_scan(images(tmp_path), write(azimuths=(0.0, 10.0), drift=0.02))
    assert len(drifted.points) > 0.9 * len(exact.points)
    assert exact.noise < 0.003 < drifted.noise < 0.02


def test_observations_without_a_mask_are_further_images(tmp_path: Path) -> None:
    for number, azimuth in enumerate((0.0, 70.0)):
        scene, mask = room(azimuth=azimuth)
        camera = scene.camera
        arrays = {"depth": scene.depth, "intrinsics": camera.intrinsics, "T_world_camera": camera.T_world_camera}
        save_arrays(tmp_path / f"{number}.npz", arrays if number else {**arrays, "mask": mask})
    assert on_ball(load_scan([tmp_path / "0.npz", tmp_path / "1.npz"])) > 0.99


def test_an_image_that_looks_elsewhere_is_left_out(write: Write, tmp_path: Path) -> None:
    options = write(azimuths=(0.0, 0.0))
    away = np.loadtxt(tmp_path / "1.txt")
    away[0, 3] += 9.0
    np.savetxt(tmp_path / "1.txt", away)
    with pytest.warns(DoubtfulResult, match=r"1\.png shows hardly a point near the object of the first image"):
        assert len(load_scan(images(tmp_path), options).views) == 1


def test_poses_that_contradict_the_first_image_are_refused(write: Write, tmp_path: Path) -> None:
    options = write(azimuths=(0.0, 0.0))
    nearer = np.loadtxt(tmp_path / "1.txt")
    nearer[:3, 3] -= 0.4 * nearer[:3, 2]
    np.savetxt(tmp_path / "1.txt", nearer)
    with pytest.raises(
        ValueError, match=r"1\.png: 100% of its points where the first image shows the object lie before"
    ):
        load_scan(images(tmp_path), options)


@pytest.mark.parametrize(
    ("pose", "sentence"),
    [
        ("2 0 0 0  0 2 0 0  0 0 2 0  0 0 0 1", r"1\.txt: the upper left of T_world_camera is no rotation \(off by 3\)"),
        ("1 0 0 0  0 1 0 0  0 0 1 0  5 6 7 1", r"1\.txt: the last row .* is the matrix transposed\?"),
        ("nan 0 0 0  0 1 0 0  0 0 1 0  0 0 0 1", r"1\.txt: .* not finite"),
        ("1 0 0  0 1 0  0 0 1", r"1\.txt cannot be read as a pose: give the 4 × 4 matrix"),
        ("hello", r"1\.txt cannot be read as a pose"),
        (None, r"1\.txt does not exist"),
    ],
)
def test_bad_poses_are_refused(write: Write, tmp_path: Path, pose: str | None, sentence: str) -> None:
    options = write()
    (tmp_path / "1.txt").unlink()
    if pose is not None:
        (tmp_path / "1.txt").write_text(pose)
    with pytest.raises(ValueError, match=sentence):
        load_scan(images(tmp_path), options)


def test_each_depth_image_needs_a_pose(write: Write, tmp_path: Path) -> None:
    options = write()
    with pytest.raises(ValueError, match="2 depth images were given without --poses"):
        load_scan(images(tmp_path), ScanOptions(intrinsics=options.intrinsics))
    with pytest.raises(ValueError, match="--poses names 2 files for 3 depth images"):
        load_scan([*images(tmp_path), tmp_path / "1.png"], options)
    scene, _ = room()
    here = Camera(scene.camera.intrinsics, torch.eye(4), HEIGHT, HEIGHT)
    view = View(here, scene.depth)
    arrays = {"depth": view.depth, "intrinsics": here.intrinsics, "T_world_camera": here.T_world_camera}
    save_arrays(tmp_path / "view.npz", arrays)
    with pytest.raises(ValueError, match=r"--poses was given for .*view\.npz, and is a depth image's alone"):
        load_scan([tmp_path / "view.npz"], ScanOptions(poses=options.poses))
