"""PCD files: all three encodings, and what is wrong with one."""

from pathlib import Path

import numpy as np
import pytest

from distrace.data.cloud import load_cloud, read_points
from distrace.data.pcd import decompress_lzf, load_pcd

RANDOM = np.random.default_rng(0)
POINTS = RANDOM.normal(size=(50, 3)).astype(np.float32)


def header(encoding: str, fields: str = "x y z", types: str = "F F F", sizes: str = "4 4 4", counts: str = "") -> bytes:
    counted = f"COUNT {counts}\n" if counts else ""
    text = f"# .PCD v0.7\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n{counted}WIDTH 50\nHEIGHT 1\n"
    return f"{text}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS 50\nDATA {encoding}\n".encode()


def literal_lzf(content: bytes) -> bytes:
    """LZF that compresses nothing: runs of at most 32 literal bytes."""
    runs = [content[start : start + 32] for start in range(0, len(content), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_all_encodings_give_the_same_points(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "cloud.pcd"
    if encoding == "ascii":
        body = "\n".join(" ".join(map(repr, map(float, point))) for point in POINTS).encode()
    elif encoding == "binary":
        body = POINTS.tobytes()
    else:
        columns = POINTS.T.tobytes()
        packed = literal_lzf(columns)
        body = np.array([len(packed), len(columns)], "<u4").tobytes() + packed
    path.write_bytes(header(encoding) + body)
    np.testing.assert_array_equal(read_points(path), POINTS)


def test_a_cloud_in_the_unit_sphere_may_be_a_pcd(tmp_path: Path) -> None:
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header("binary") + (POINTS / 2).tobytes())
    np.testing.assert_array_equal(load_cloud(path).points.numpy(), POINTS / 2)


def test_other_fields_lie_between_the_coordinates(tmp_path: Path) -> None:
    kind = np.dtype([("normal", "<f4", 3), ("x", "<f8"), ("label", "u1"), ("y", "<f8"), ("z", "<f8")])
    rows = np.zeros(50, kind)
    rows["x"], rows["y"], rows["z"] = POINTS.T
    path = tmp_path / "cloud.pcd"
    path.write_bytes(header("binary", "normal x label y z", "F F U F F", "4 8 1 8 8", "3 1 1 1 1") + rows.tobytes())
    assert set(load_pcd(path)) == {"x", "y", "z", "label"}
    np.testing.assert_array_equal(read_points(path), POINTS)


def test_lzf_copies_what_it_has_just_appended() -> None:
    assert decompress_lzf(bytes([0, ord("a"), 0b0110_0000, 0, 1, ord("b"), ord("c")]), 8) == b"aaaaaabc"
    assert decompress_lzf(bytes([1, ord("a"), ord("b"), 0b1110_0000, 3, 1]), 14) == b"ab" * 7


@pytest.mark.parametrize("packed", [bytes([0b0010_0000, 9]), bytes([0, 65])])
def test_damaged_lzf_is_refused(packed: bytes) -> None:
    with pytest.raises(ValueError, match=r"damaged|end after"):
        decompress_lzf(packed, 8)


@pytest.mark.parametrize(
    "content",
    [b"", b"not a cloud", header("binary") + b"1234", header("ascii") + b"1 2 3", header("strange"), b"DATA ascii\n1"],
)
def test_what_is_no_cloud_ends_in_a_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "bad.pcd"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"bad\.pcd cannot be read as a cloud of points"):
        read_points(path)
