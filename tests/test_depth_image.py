"""Depth images and intrinsics in the forms that sensors and other tools have."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from distrace.data.depth_image import load_depth_image, load_intrinsics, load_mask

DEPTH = np.array([[1.0, 1.5, 0.0], [2.0, 0.625, 3.25]], np.float32)  # metres
MATRIX = np.array([[500.0, 0, 1.5], [0, 505.0, 1.0], [0, 0, 1]])


def expected() -> torch.Tensor:
    return torch.where(torch.from_numpy(DEPTH) > 0, torch.from_numpy(DEPTH), torch.inf)


def test_millimetres_become_metres_and_zero_is_none(tmp_path: Path) -> None:
    Image.fromarray((DEPTH * 1000).astype(np.uint16)).save(tmp_path / "depth.png")
    np.save(tmp_path / "counts.npy", (DEPTH * 1000).astype(np.uint16))
    np.save(tmp_path / "metres.npy", DEPTH)
    for name in ("depth.png", "counts.npy", "metres.npy"):
        torch.testing.assert_close(load_depth_image(tmp_path / name), expected())


def test_the_largest_count_is_none_too(tmp_path: Path) -> None:
    Image.fromarray(np.array([[65535, 1000]], np.uint16)).save(tmp_path / "depth.png")
    assert load_depth_image(tmp_path / "depth.png").tolist() == [[np.inf, 1.0]]


def test_an_exr_is_read(tmp_path: Path) -> None:
    exr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
    for channel in ("Z", "Y", "anything"):
        with exr.File({"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}, {channel: DEPTH}) as file:
            file.write(str(tmp_path / f"{channel}.exr"))
        torch.testing.assert_close(load_depth_image(tmp_path / f"{channel}.exr"), expected())


def test_intrinsics_are_numbers_or_a_file(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "k.txt", MATRIX)
    np.save(tmp_path / "k.npy", MATRIX)
    (tmp_path / "k.json").write_text(json.dumps(MATRIX.tolist()))
    (tmp_path / "named.json").write_text(json.dumps({"fx": 500, "fy": 505, "cx": 1.5, "cy": 1}))
    (tmp_path / "inner.json").write_text(json.dumps({"intrinsics": MATRIX.tolist(), "width": 3}))
    given = [
        "500,505,1.5,1",
        *(str(tmp_path / name) for name in ("k.txt", "k.npy", "k.json", "named.json", "inner.json")),
    ]
    for text in given:
        camera = load_intrinsics(text, 2, 3)
        np.testing.assert_allclose(camera.intrinsics.numpy(), MATRIX, rtol=1e-6)
        assert torch.equal(camera.T_world_camera, torch.eye(4))


@pytest.mark.parametrize("text", ["", "1,2,3", "500,a,1,1", "missing.txt", "0,0,1,1", "nan,500,1,1"])
def test_other_intrinsics_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=f"--intrinsics {text}"):
        load_intrinsics(text, 2, 3)


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("missing.png", "does not exist"),
        ("empty.png", "cannot be read as a depth image: give a 16-bit PNG"),
        ("text.npy", "cannot be read as a depth image: give a 16-bit PNG"),
        ("picture.png", "cannot be read as a depth image: give a 16-bit PNG"),
        ("nothing.png", "no pixel has a depth"),
        ("far.npy", "are they in millimetres"),
        ("text.exr", "cannot be read as a depth image: give a 16-bit PNG"),
    ],
)
def test_what_is_no_depth_image_ends_in_a_sentence(tmp_path: Path, name: str, sentence: str) -> None:
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "text.npy").write_text("hello")
    (tmp_path / "text.exr").write_text("hello")
    Image.new("RGB", (4, 4)).save(tmp_path / "picture.png")
    Image.fromarray(np.zeros((4, 4), np.uint16)).save(tmp_path / "nothing.png")
    np.save(tmp_path / "far.npy", DEPTH * 1000)
    with pytest.raises(ValueError, match=rf"{name}.*{sentence}"):
        load_depth_image(tmp_path / name)


def test_a_mask_is_where_a_picture_is_not_black(tmp_path: Path) -> None:
    Image.fromarray(np.array([[0, 255, 255], [0, 0, 255]], np.uint8)).save(tmp_path / "mask.png")
    assert load_mask(tmp_path / "mask.png", 2, 3).tolist() == [[False, True, True], [False, False, True]]
    with pytest.raises(ValueError, match=r"mask\.png.*\[4, 3\]"):
        load_mask(tmp_path / "mask.png", 4, 3)
    Image.new("L", (3, 2)).save(tmp_path / "black.png")
    with pytest.raises(ValueError, match="marks no pixel"):
        load_mask(tmp_path / "black.png", 2, 3)
