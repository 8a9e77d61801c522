"""Reads clouds of points in PCD files, as the Point Cloud Library writes them: ASCII, binary and compressed."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

TYPES = {"F": "f", "I": "i", "U": "u"}
MAX_HEADER = 4096  # bytes


def load_pcd(path: Path) -> dict[str, Float[np.ndarray, "n"]]:
    """Returns the columns of a cloud by their names, of those that hold one number each: `x`, `y`, `z` and others.

    Raises `ValueError` for a file that is no PCD, or that ends early.
    """
    content = path.read_bytes()
    end = content.find(b"DATA ", 0, MAX_HEADER)
    if end < 0:
        raise ValueError("it has no line DATA, as PCD files do")
    lines = content[:end].decode("ascii", "replace").splitlines()
    header = {words[0]: words[1:] for words in map(str.split, lines) if words}
    fields = header["FIELDS"]
    counts = [int(count) for count in header.get("COUNT", ["1"] * len(fields))]
    kinds = [f"<{TYPES[kind]}{size}" for kind, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    columns = np.dtype([(f"{k}", kind, (count,)) for k, (kind, count) in enumerate(zip(kinds, counts, strict=True))])
    points = int(header["POINTS"][0])
    body_at = content.index(b"\n", end) + 1
    encoding = content[end:body_at].split()[1]
    body = content[body_at:]
    if encoding == b"ascii":
        table = np.array(body.split(), dtype=np.float64).reshape(points, sum(counts))
        starts = np.cumsum([0, *counts])
        parts = [table[:, start : start + 1] for start in starts[:-1]]
    elif encoding == b"binary":
        rows = np.frombuffer(body, columns, points)
        parts = [rows[f"{k}"] for k in range(len(fields))]
    elif encoding == b"binary_compressed":
        packed, unpacked = np.frombuffer(body, "<u4", 2).tolist()
        flat = decompress_lzf(body[8 : 8 + packed], unpacked)
        parts = []
        for kind, count in zip(kinds, counts, strict=True):
            length = points * count * np.dtype(kind).itemsize
            parts.append(np.frombuffer(flat[:length], kind).reshape(points, count))
            flat = flat[length:]
    else:
        raise ValueError(f"its points are stored as {encoding.decode('ascii', 'replace')}")
    named = zip(fields, counts, parts, strict=True)
    return {name: part[:, 0].astype(np.float64) for name, count, part in named if count == 1}


def decompress_lzf(packed: bytes, length: int) -> bytes:
    """Returns the content of LZF-compressed bytes. Raises `ValueError` where it has not the expected length."""
    found = bytearray()
    at = 0
    while at < len(packed) and len(found) < length:
        control = packed[at]
        at += 1
        if control < 32:  # so many literal bytes and one
            found += packed[at : at + control + 1]
            at += control + 1
            continue
        count = control >> 5
        if count == 7:
            count += packed[at]
            at += 1
        back = len(found) - ((control & 31) << 8) - packed[at] - 1
        at += 1
        if back < 0:
            raise ValueError("its compressed points are damaged")
        count += 2
        copied = found[back : back + count]
        while len(copied) < count:  # it overlaps what it appends, so it repeats
            copied = copied + copied
        found += copied[:count]
    if len(found) != length:
        raise ValueError(f"its compressed points end after {len(found)} of {length} bytes")
    return bytes(found)
