"""Observed views: their file, what Embree sees of a mesh, and everything that can be wrong with an observation."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from distrace.camera import Camera
from distrace.data.observation import View, load_view, save_view
from distrace.data.solid import Solid
from distrace.rays import meet_sphere
from experiments.datasets.solids import observe

CAMERA = Camera.orbit(30, 20, 2.5, height=32, width=40, focal_px=40.0)


def seen_of(mesh: trimesh.Trimesh, camera: Camera = CAMERA) -> View:
    return observe(Solid(mesh, mesh), camera)


def arrays(**changed: object) -> dict:
    """A flat wall of 3 × 4 pixels, two and a half in front of the camera."""
    camera = Camera.orbit(0, 0, 2.5, height=3, width=4, focal_px=4.0)
    whole = {
        "depth": np.full((3, 4), 2.5, np.float32),
        "intrinsics": camera.intrinsics.numpy(),
        "T_world_camera": camera.T_world_camera.numpy(),
    }
    return {name: value for name, value in (whole | changed).items() if value is not None}


def stored(folder: Path, **changed: object) -> Path:
    np.savez(folder / "view.npz", **arrays(**changed))
    return folder / "view.npz"


def refused(path: Path, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        load_view(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_view_is_read_as_it_was_written(tmp_path: Path) -> None:
    view = seen_of(trimesh.creation.box((0.5, 0.6, 0.7)))
    save_view(tmp_path / "view.npz", view)
    loaded = load_view(tmp_path / "view.npz")
    pairs = [(view.depth, loaded.depth), (view.mask, loaded.mask), (view.normal, loaded.normal)]
    pairs += [(view.camera.intrinsics, loaded.camera.intrinsics)]
    pairs += [(view.camera.T_world_camera, loaded.camera.T_world_camera)]
    assert all(torch.equal(written, read) for written, read in pairs)
    assert (loaded.camera.height, loaded.camera.width) == (32, 40)


def test_what_is_not_known_stays_unknown(tmp_path: Path) -> None:
    save_view(tmp_path / "view.npz", View(CAMERA, torch.full((32, 40), 2.5)))
    loaded = load_view(tmp_path / "view.npz")
    assert loaded.mask is None
    assert loaded.normal is None


def test_a_sphere_is_seen_at_its_closed_form_depth() -> None:
    view = seen_of(trimesh.creation.icosphere(subdivisions=4, radius=0.7))
    assert view.mask is not None
    assert view.normal is not None
    near = meet_sphere(CAMERA.rays(), 0.7).near
    expected = CAMERA.depth(near)
    assert (view.mask != torch.isfinite(expected)).float().mean() < 0.01, "its facets lie a little inside the sphere"
    assert torch.equal(view.mask, view.seen)
    points = CAMERA.rays().at(near)
    facing = -(CAMERA.rays().directions * points / 0.7).sum(-1)
    clear = view.mask & (facing > 0.3)
    assert clear.sum() > 100
    torch.testing.assert_close(view.depth[clear], expected[clear], atol=4e-3, rtol=0)
    torch.testing.assert_close(view.normal[clear], points[clear] / 0.7, atol=0.08, rtol=0)
    assert not view.normal[~view.mask].any()


def test_depth_is_along_the_axis_so_a_wall_has_one_depth_and_its_points_lie_on_it() -> None:
    camera = Camera.orbit(0, 0, 2.5, height=32, width=40, focal_px=60.0)
    view = seen_of(trimesh.creation.box((1, 1, 1)), camera)
    torch.testing.assert_close(view.depth[view.seen], torch.full_like(view.depth[view.seen], 2.0), atol=1e-5, rtol=0)
    torch.testing.assert_close(view.points()[:, 2], torch.full_like(view.points()[:, 2], 0.5), atol=1e-5, rtol=0)
    assert int(view.seen.sum()) == 30 * 30, "pixels whose centres are within 60 / 2.0 / 2 of the middle"


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_no_depth_is_zero_nan_or_infinite(tmp_path: Path, nothing: float) -> None:
    depth = np.full((3, 4), 2.5, np.float32)
    depth[1, 2] = nothing
    view = load_view(stored(tmp_path, depth=depth))
    assert view.depth[1, 2] == torch.inf
    assert int(view.seen.sum()) == 11
    assert len(view.points()) == 11


def test_depth_may_be_integers_or_doubles(tmp_path: Path) -> None:
    for dtype in (np.uint16, np.float64):
        view = load_view(stored(tmp_path, depth=np.full((3, 4), 2, dtype)))
        assert torch.equal(view.depth, torch.full((3, 4), 2.0))


def test_a_sparse_view_keeps_exactly_so_many_of_the_depths_and_all_of_the_mask() -> None:
    view = seen_of(trimesh.creation.icosphere(subdivisions=2, radius=0.7))
    few = view.sparse(20, seed=3)
    assert int(few.seen.sum()) == 20
    assert torch.equal(few.depth[few.seen], view.depth[few.seen])
    assert few.mask is view.mask
    assert torch.equal(view.sparse(20, seed=3).depth, few.depth)
    assert not torch.equal(view.sparse(20, seed=4).depth, few.depth)
    assert torch.equal(view.sparse(10**6).depth, view.depth)


@pytest.mark.parametrize("name", ["depth", "intrinsics", "T_world_camera"])
def test_a_missing_key_is_named(tmp_path: Path, name: str) -> None:
    refused(stored(tmp_path, **{name: None}), f"no key '{name}'")


SCALED = arrays()["T_world_camera"] * np.array([[2, 2, 2, 1]] * 3 + [[1, 1, 1, 1]], np.float32)
MIRRORED = arrays()["T_world_camera"] * np.array([-1, 1, 1, 1], np.float32)
SINGULAR = np.array([[4, 4, 2], [4, 4, 1.5], [0, 0, 1]], np.float32)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"depth": np.ones((3, 4, 2), np.float32)}, r"depth has shape \[3, 4, 2\]"),
        ({"depth": np.float32(2.5)}, r"depth has shape \[\]"),
        ({"depth": np.ones((0, 4), np.float32)}, r"depth has shape \[0, 4\]"),
        ({"depth": np.array([["a", "b"]])}, "depth holds <U1"),
        ({"mask": np.ones((4, 3), bool)}, r"mask has shape \[4, 3\]; beside this depth it must be \[3, 4\]"),
        ({"normal": np.ones((3, 4), np.float32)}, r"normal has shape \[3, 4\]; .* \[3, 4, 3\]"),
        ({"intrinsics": np.eye(4, dtype=np.float32)}, "intrinsics are"),
        ({"T_world_camera": np.eye(4, dtype=np.float32)[:3]}, "T_world_camera is"),
        ({"intrinsics": np.zeros((3, 3), np.float32)}, "no camera"),
        ({"intrinsics": np.diag([0, 4, 1]).astype(np.float32)}, "focal"),
        ({"intrinsics": SINGULAR}, "no camera"),
        ({"intrinsics": np.full((3, 3), np.nan, np.float32)}, "not finite"),
        ({"T_world_camera": SCALED}, "no rotation"),
        ({"T_world_camera": MIRRORED}, "no rotation"),
        ({"T_world_camera": arrays()["T_world_camera"].T.copy()}, "last row"),
        ({"depth": np.full((3, 4), 2500.0, np.float32)}, "units of the unit sphere"),
        ({"depth": np.zeros((3, 4), np.float32)}, "shows nothing"),
        ({"depth": np.zeros((3, 4), np.float32), "mask": np.zeros((3, 4), bool)}, "shows nothing"),
    ],
)
def test_what_makes_no_sense_ends_in_one_sentence(tmp_path: Path, changed: dict, message: str) -> None:
    refused(stored(tmp_path, **changed), message)


@pytest.mark.parametrize("content", [b"no observation\n", b"", b"PK\x03\x04 cut off", None])
def test_a_file_of_another_kind_ends_in_one_sentence(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "view.npz"
    if content is not None:
        path.write_bytes(content)
    refused(path, "is not an observation" if path.exists() else "does not exist")


def test_a_folder_or_a_lone_array_is_no_observation(tmp_path: Path) -> None:
    refused(tmp_path, "is not an observation")
    np.save(tmp_path / "depth.npy", np.ones((3, 4)))
    refused(tmp_path / "depth.npy", "is not an observation")


class Trap:
    """Leaves a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple:
        return Path.touch, (self.path,)


def test_a_pickle_within_is_never_opened(tmp_path: Path) -> None:
    sprung = tmp_path / "sprung"
    path = stored(tmp_path, depth=np.array([[Trap(sprung)]], dtype=object))
    refused(path, "is not an observation")
    assert not sprung.exists()
    with np.load(path, allow_pickle=True) as archive:
        archive["depth"]
    assert sprung.exists(), "the trap works"


def test_a_mask_alone_is_an_observation(tmp_path: Path) -> None:
    view = load_view(stored(tmp_path, depth=np.zeros((3, 4)), mask=np.eye(3, 4, dtype=np.uint8)))
    assert view.mask is not None
    assert view.mask.dtype == torch.bool
    assert int(view.mask.sum()) == 3
    assert not view.seen.any()
