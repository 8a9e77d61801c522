"""Image files as tensors."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from distrace.data.pictures import picture_size, read_mask, read_picture

LEVELS = np.random.default_rng(1).integers(0, 256, (5, 7, 4), np.uint8)


def stored(folder: Path, levels: np.ndarray, name: str = "a.png") -> Path:
    Image.fromarray(levels).save(folder / name)
    return folder / name


def deep_colour(levels: np.ndarray) -> bytes:
    """A PNG of 16 bits per colour, which Pillow does not write."""
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in levels)
    header = struct.pack(">IIBBBBB", levels.shape[1], levels.shape[0], 16, 2, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    body = b"".join(struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


def test_colours_are_as_stored_and_alpha_is_a_mask(tmp_path: Path) -> None:
    image, mask = read_picture(stored(tmp_path, LEVELS))
    assert image.dtype == torch.float32
    assert torch.equal(image, torch.from_numpy(LEVELS[..., :3].astype(np.float32) / 255))
    assert mask is not None
    assert torch.equal(mask, torch.from_numpy(LEVELS[..., 3] > 127))
    assert read_picture(stored(tmp_path, LEVELS[..., :3]))[1] is None


def test_grey_is_three_equal_colours_in_eight_bits_and_in_sixteen(tmp_path: Path) -> None:
    for levels, full in ((LEVELS[..., 0], 255), (LEVELS[..., 0].astype(np.uint16) * 257, 65535)):
        image, _ = read_picture(stored(tmp_path, levels))
        expected = torch.from_numpy(levels.astype(np.float32) / full)
        assert torch.equal(image, expected[..., None].expand(-1, -1, 3))


def test_deep_colours_keep_their_upper_eight_bits(tmp_path: Path) -> None:
    levels = np.minimum(LEVELS[..., :3].astype(np.uint32) * 257 + 96, 65535)
    (tmp_path / "deep.png").write_bytes(deep_colour(levels))
    image, _ = read_picture(tmp_path / "deep.png")
    torch.testing.assert_close(image, torch.from_numpy(levels / 65535).float(), atol=1 / 255, rtol=0)


def test_a_palette_and_a_bitmap_are_read_as_colours(tmp_path: Path) -> None:
    flat = np.where(LEVELS[..., :1] > 100, np.uint8([200, 10, 60]), np.uint8([0, 0, 90]))
    Image.fromarray(flat).quantize(2).save(tmp_path / "palette.png")
    assert torch.equal((read_picture(tmp_path / "palette.png")[0] * 255).round().byte(), torch.from_numpy(flat))
    assert torch.equal(read_mask(stored(tmp_path, LEVELS[..., 0] > 90)), torch.from_numpy(LEVELS[..., 0] > 90))


def test_pictures_and_masks_have_the_levels_of_their_files(tmp_path: Path) -> None:
    mask = LEVELS[..., 3] > 60
    image = torch.from_numpy(LEVELS[..., :3].astype(np.float32) / 255)
    assert torch.equal(read_picture(stored(tmp_path, LEVELS[..., :3]))[0], image)
    grey = stored(tmp_path, mask.astype(np.uint8) * 255, "m.png")
    assert torch.equal(read_mask(grey), torch.from_numpy(mask))
    assert picture_size(grey) == (5, 7)


def test_exif_leaves_the_image_as_it_is_stored(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by a quarter
    Image.fromarray(LEVELS[..., :3]).save(tmp_path / "turned.jpg", exif=exif)
    assert read_picture(tmp_path / "turned.jpg")[0].shape == (5, 7, 3)
    assert picture_size(tmp_path / "turned.jpg") == (5, 7)


def test_a_mask_of_ones_in_255_is_told_and_an_empty_one_is_one(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a\.png is nowhere brighter than 1 of 255"):
        read_mask(stored(tmp_path, (LEVELS[..., 0] > 60).astype(np.uint8)))
    assert not read_mask(stored(tmp_path, np.zeros((4, 4), np.uint8))).any()


SHAPE = np.hypot(*(np.mgrid[:12, :16] - 7.0)) < 4


def coloured(mask: np.ndarray, *colour: int, background: int = 0) -> np.ndarray:
    return np.where(mask[..., None], np.uint8(colour), np.uint8(background)).astype(np.uint8)


MASKS = {
    "white": coloured(SHAPE, 255, 255, 255),
    "a label of VOC": coloured(SHAPE, 128, 0, 0),
    "a dark label": coloured(SHAPE, 0, 64, 0),
    "one pure channel": coloured(SHAPE, 0, 0, 255),
    "alpha alone, black": coloured(SHAPE, 0, 0, 0, 255),
    "alpha alone, white": np.dstack([np.full((*SHAPE.shape, 3), 255, np.uint8), SHAPE * np.uint8(255)]),
    "alpha of 0 and 1": np.dstack([coloured(SHAPE, 255, 255, 255), SHAPE.astype(np.uint8)]),
    "alpha of 0 and 1, black": np.dstack([np.zeros((*SHAPE.shape, 3), np.uint8), SHAPE.astype(np.uint8)]),
    "opaque, in a label's colour": np.dstack([coloured(SHAPE, 128, 0, 0), np.full(SHAPE.shape, 255, np.uint8)]),
    "opaque, alpha of 1": np.dstack([coloured(SHAPE, 255, 255, 255), np.ones(SHAPE.shape, np.uint8)]),
    "grey and alpha": np.dstack([SHAPE * np.uint8(255), SHAPE * np.uint8(255)]),
}


@pytest.mark.parametrize("name", MASKS)
def test_a_mask_may_be_in_any_colour_or_in_alpha(tmp_path: Path, name: str) -> None:
    assert torch.equal(read_mask(stored(tmp_path, MASKS[name])), torch.from_numpy(SHAPE))


def test_a_mask_may_be_a_palette_of_labels(tmp_path: Path) -> None:
    labels = Image.fromarray(SHAPE.astype(np.uint8), mode="P")
    labels.putpalette([0, 0, 0, 128, 0, 0])
    labels.save(tmp_path / "labels.png")
    assert torch.equal(read_mask(tmp_path / "labels.png"), torch.from_numpy(SHAPE))


def test_a_mask_in_a_label_s_colour_may_be_a_jpeg(tmp_path: Path) -> None:
    path = stored(tmp_path, coloured(SHAPE, 200, 0, 0), "a.jpg")
    assert (read_mask(path).numpy() != SHAPE).sum() <= 6, "pixels of the outline"


def test_the_alpha_of_a_photograph_may_be_0_and_1(tmp_path: Path) -> None:
    rgba = np.dstack([np.full((*SHAPE.shape, 3), 90, np.uint8), SHAPE.astype(np.uint8)])
    _, mask = read_picture(stored(tmp_path, rgba))
    assert mask is not None
    assert torch.equal(mask, torch.from_numpy(SHAPE))


def test_a_pointer_of_git_lfs_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n")
    with pytest.raises(ValueError, match=r"a\.png cannot be read as a PNG or JPEG image \(it is a Git LFS pointer"):
        read_picture(tmp_path / "a.png")


def test_what_is_no_image_is_told_in_one_sentence(tmp_path: Path) -> None:
    whole = stored(tmp_path, np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)).read_bytes()
    for content in (b"", b"no image", whole[:2000], whole[:20]):
        (tmp_path / "bad.png").write_bytes(content)
        with pytest.raises(ValueError, match=r"bad\.png cannot be read as a PNG or JPEG image") as caught:
            read_picture(tmp_path / "bad.png")
        assert "\n" not in str(caught.value)
