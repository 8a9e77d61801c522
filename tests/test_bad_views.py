"""Observations that make no sense end in one sentence, which says what was given; odd ones that do make sense work."""

from pathlib import Path

import numpy as np
import pytest
import torch

from distrace.camera import Camera
from distrace.data import arrays as reading
from distrace.data.observation import load_view, read_view, save_view
from distrace.rays import meet_sphere

CAMERA = Camera.orbit(30, 20, 2.5, height=32, width=40, focal_px=40.0)
Arrays = dict[str, np.ndarray]


def ball(camera: Camera = CAMERA) -> Arrays:
    """All that can be seen of a sphere of radius 0.6."""
    rays, bounds = camera.rays(), meet_sphere(camera.rays(), 0.6)
    normal = torch.where(bounds.meets[..., None], rays.at(bounds.near) / 0.6, 0.0)
    tensors = {"depth": camera.depth(bounds.near), "mask": bounds.meets, "normal": normal}
    tensors |= {"intrinsics": camera.intrinsics, "T_world_camera": camera.T_world_camera}
    return {name: tensor.numpy() for name, tensor in tensors.items()}


BALL = ball()
DEPTH, MASK, NORMAL, POSE = (BALL[name] for name in ("depth", "mask", "normal", "T_world_camera"))
SEEN = int(MASK.sum())
FLIP = np.diag([1, -1, -1, 1]).astype(np.float32)
WALL = np.where(MASK, DEPTH, 9.0)


def stored(folder: Path, only: tuple[str, ...], changed: Arrays) -> Path:
    """The ball's arrays but for some; `only` names those of depth, mask and normal that are given."""
    kept = {name: BALL[name] for name in (*only, "intrinsics", "T_world_camera")}
    np.savez(folder / "view.npz", **(kept | changed))
    return folder / "view.npz"


def with_value(array: np.ndarray, value: object, at: tuple = (0, 0)) -> np.ndarray:
    changed = array.copy()
    changed[at] = value
    return changed


def matrix(**entries: float) -> np.ndarray:
    """The ball's intrinsics with other entries."""
    places = {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}
    changed = BALL["intrinsics"].copy()
    for name, value in entries.items():
        changed[places[name]] = value
    return changed


def at(x: float, y: float, z: float) -> np.ndarray:
    return np.concatenate([POSE[:, :3], [[x], [y], [z], [1]]], axis=1)


DEPTHS = [
    (-DEPTH, r"negative wherever .* -2\.\d+; .* change its sign"),
    (DEPTH * 1000, r"points lie 2.04e\+03 from .*, and the camera 2.5, .* depth \(20\d\d in the median\)"),
    (DEPTH * 0.001, r"points lie 2.5 from .* need scaling"),
    (DEPTH.astype(np.complex64), "depth holds complex64; numbers are needed"),
    (DEPTH > 0, "depth holds bool"),
    (np.stack([DEPTH] * 3, -1), r"depth has shape \[32, 40, 3\]; an image \[height, width\]"),
    (np.where(MASK, 1e300, 0), "shows nothing"),
    (np.full((32, 40), -1.0), "shows nothing"),
    (WALL, "a background needs a mask"),
]
CAMERAS = [
    ({"intrinsics": matrix() / [[40], [32], [1]]}, "focal length of 1 pixels sees 174°"),
    ({"intrinsics": matrix(fx=0.5, fy=0.5, cx=0.5, cy=0.5)}, "focal length of 0.5 pixels sees 177°"),
    ({"intrinsics": matrix(fx=400)}, "400 and 40 pixels"),
    ({"intrinsics": matrix() * [[4], [4], [1]]}, "for an image of 128 × 160 pixels, and this is an image of 32 × 40"),
    ({"intrinsics": matrix(cx=400)}, "look at the principal point"),
    ({"intrinsics": matrix().T.copy()}, "last row of intrinsics"),
    ({"intrinsics": matrix(fx=np.inf)}, "not finite"),
    ({"intrinsics": matrix().astype("U9")}, "intrinsics holds <U9"),
    ({"intrinsics": np.stack([matrix()] * 2), "T_world_camera": np.stack([POSE] * 2)}, "2 cameras are described"),
    ({"T_world_camera": with_value(POSE, np.nan)}, "not finite"),
    ({"T_world_camera": np.linalg.inv(POSE)}, "seems to be the inverse, T_camera_world"),
    ({"T_world_camera": POSE @ FLIP}, "OpenGL's axes: it maps"),
    ({"T_world_camera": FLIP @ np.linalg.inv(POSE)}, "inverse in OpenGL's axes"),
    ({"T_world_camera": np.eye(4)}, "the camera 0, but the shape"),
    ({"T_world_camera": at(90, 0, 0)}, "the camera 90"),
]
EMPTY = np.zeros_like(MASK)
MASKS = [
    (EMPTY, f"marks no pixel as object, but {SEEN} have a depth"),
    (~MASK, f"of which 0 have a depth, as have {SEEN}"),
    (with_value(~MASK, True, (16, 20)), "of which 1 have a depth"),
    (MASK[:, :-1], r"mask has shape \[32, 39\]; beside this depth it must be \[32, 40\]"),
    (MASK.T, r"mask has shape \[40, 32\]"),
    (with_value(MASK.astype(float), np.nan), "mask holds the values 0, 1, nan"),
    (np.arange(32 * 40).reshape(32, 40), "mask holds the values 0, 1, 2, 3, …"),
    (np.where(MASK, 2, 1), "mask holds the values 1, 2; only"),
    (MASK.astype("U5"), "mask holds <U5"),
]
NORMALS = [
    (0 * NORMAL, "normal is zero or not finite at every pixel"),
    (np.nan * NORMAL, "normal is zero or not finite at every pixel"),
    (-NORMAL, "points away from the camera at 100% of the pixels"),
    (NORMAL @ POSE[:3, :3], "points away from the camera at .* of the world, not of the camera"),
    ((127 * (NORMAL + 1)).astype(np.uint8), "normal holds uint8, as pictures do"),
    (np.moveaxis(NORMAL, -1, 0), r"normal has shape \[3, 32, 40\]; .* \[32, 40, 3\]"),
]


@pytest.mark.parametrize(
    ("only", "changed", "message"),
    [((), {"depth": depth}, message) for depth, message in DEPTHS]
    + [(only, changed, message) for only in (("depth",), ("depth", "mask")) for changed, message in CAMERAS]
    + [(("depth",), {"mask": mask}, message) for mask, message in MASKS]
    + [(only, {"normal": normal}, message) for only in (("depth",), ("depth", "mask")) for normal, message in NORMALS],
)
def test_what_makes_no_sense_ends_in_one_sentence(
    tmp_path: Path, only: tuple[str, ...], changed: Arrays, message: str
) -> None:
    path = stored(tmp_path, only, changed)
    with pytest.raises(ValueError, match=message) as caught:
        load_view(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("pose", [POSE @ FLIP, at(0, 9, 0)], ids=["looking away", "beside it"])
def test_a_silhouette_that_no_ray_to_the_sphere_can_have_is_refused(tmp_path: Path, pose: np.ndarray) -> None:
    path = stored(tmp_path, ("mask",), {"depth": np.zeros_like(DEPTH), "T_world_camera": pose})
    with pytest.raises(ValueError, match=r"the rays of the object pass .* the unit sphere"):
        load_view(path)
    assert read_view(path).observed.sum() == SEEN, "fine where the pose is what is to be found"


@pytest.mark.parametrize("kept", [0.1, 0.5, 0.9, 0.99])
def test_a_file_cut_off_anywhere_ends_in_one_sentence(tmp_path: Path, kept: float) -> None:
    path = stored(tmp_path, ("depth", "mask", "normal"), {})
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(ValueError, match="is not an observation"):
        load_view(path)


def test_too_many_pixels_are_refused_before_they_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "MAX_PIXELS", 1000)
    with pytest.raises(ValueError, match=r"depth has shape \[32, 40\]; .* of 1 to 1,000 pixels"):
        load_view(stored(tmp_path, ("depth",), {}))


SAME: list[tuple[str, Arrays]] = [
    ("depth [1, H, W]", {"depth": DEPTH[None]}),
    ("depth [H, W, 1]", {"depth": DEPTH[..., None]}),
    ("float64", {name: array.astype(float) for name, array in BALL.items()}),
    ("big endian", {"depth": DEPTH.astype(">f4"), "intrinsics": BALL["intrinsics"].astype(">f8")}),
    ("columns first", {"depth": np.asfortranarray(DEPTH), "normal": np.asfortranarray(NORMAL)}),
    ("a batch of one", {name: array[None] for name, array in BALL.items()}),
    ("mask of 0 and 255", {"mask": 255 * MASK.astype(np.uint8)}),
    ("mask of 0.0 and 1.0", {"mask": MASK.astype(np.float16)}),
    ("mask [H, W, 1]", {"mask": MASK[..., None]}),
    ("depth behind the object", {"depth": WALL}),
    ("-1 and NaN where nothing is seen", {"depth": with_value(np.where(MASK, DEPTH, -1.0), np.nan)}),
    ("normals of any length", {"normal": 0.01 * NORMAL}),
    ("no normal outside", {"normal": np.where(MASK[..., None], NORMAL, np.nan)}),
    ("more arrays", {"colour": np.zeros((32, 40, 3)), "notes": np.array([{"a": 1}], dtype=object)}),
]


@pytest.mark.parametrize("changed", [changed for _, changed in SAME], ids=[name for name, _ in SAME])
def test_the_same_in_another_form_is_read_the_same(tmp_path: Path, changed: Arrays) -> None:
    found = load_view(stored(tmp_path, ("depth", "mask", "normal"), changed))
    assert found.mask is not None
    assert found.normal is not None
    assert torch.equal(found.mask, torch.from_numpy(MASK))
    torch.testing.assert_close(found.depth, torch.from_numpy(DEPTH))
    torch.testing.assert_close(found.normal, torch.from_numpy(NORMAL))
    torch.testing.assert_close(found.camera.T_world_camera, CAMERA.T_world_camera)


def test_half_precision_is_enough(tmp_path: Path) -> None:
    found = load_view(stored(tmp_path, ("mask",), {"depth": DEPTH.astype(np.float16)}))
    torch.testing.assert_close(found.depth, torch.from_numpy(DEPTH), rtol=1e-3, atol=0)


@pytest.mark.parametrize(
    "camera",
    [
        CAMERA.cropped(4, 12, 16, 12),
        CAMERA.resized(8).cropped(120, 150, 2, 2),
        CAMERA.resized(4).cropped(60, 75, 1, 1),
        Camera.orbit(30, 20, 0.8, height=9, width=9, focal_px=4.0),
        Camera.orbit(30, 20, 1.2, height=12, width=40, focal_px=6.0),
        Camera.orbit(-150, 70, 400, height=20, width=20, focal_px=6000.0),
    ],
    ids=["a crop", "a far crop", "one pixel", "within the unit sphere", "wide", "far away"],
)
def test_unusual_cameras_are_taken(tmp_path: Path, camera: Camera) -> None:
    found = load_view(stored(tmp_path, (), ball(camera)))
    assert found.mask is not None
    assert found.observed.any()
    assert torch.equal(found.mask, found.seen)


@pytest.mark.parametrize(
    "changed",
    [
        {"mask": MASK & (np.arange(40) < 18)},
        {"mask": np.ones_like(MASK)},
        {"depth": np.where(np.random.default_rng(0).random(MASK.shape) < 0.05, DEPTH, np.inf)},
        {"depth": with_value(DEPTH, 2500.0, (0, slice(0, 9)))},
        {"depth": np.full((32, 40), -1.0)},
        {"intrinsics": matrix(fy=60)},
    ],
    ids=["half a mask", "all of it", "sparse", "a few outliers", "no depth", "oblong pixels"],
)
def test_what_is_odd_but_possible_is_taken(tmp_path: Path, changed: Arrays) -> None:
    assert load_view(stored(tmp_path, ("depth", "mask"), changed)).observed.any()


@pytest.mark.parametrize("name", ["depth", "mask", "normal"])
def test_each_image_alone_is_an_observation(tmp_path: Path, name: str) -> None:
    nothing = {} if name == "depth" else {"depth": np.zeros_like(DEPTH)}
    assert load_view(stored(tmp_path, (name,), nothing)).observed.sum() == SEEN


def test_what_was_read_can_be_written_and_read_again(tmp_path: Path) -> None:
    found = load_view(stored(tmp_path, ("mask", "normal"), {"depth": WALL}))
    save_view(tmp_path / "again.npz", found)
    again = load_view(tmp_path / "again.npz")
    assert torch.equal(again.depth, found.depth)
