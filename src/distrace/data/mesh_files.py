"""Reads meshes and clouds of points from files."""

from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from distrace.data.ac3d import load_ac3d

if TYPE_CHECKING:
    import trimesh

ASCII = bytes(range(128)) + b"?" * 128  # what each byte becomes


def load_soup(path: Path) -> "trimesh.Trimesh":
    """Returns all triangles of a file, as they are."""
    import trimesh

    if path.suffix.lower() == ".ac":  # trimesh does not know AC3D
        corners = load_ac3d(path)
        return trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    mesh = load_geometry(path, force="mesh", skip_materials=True)
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


def load_geometry(path: Path, **options: Any) -> Any:
    """Returns the mesh, scene or cloud of points that trimesh reads from a file, unmerged.

    Bytes of names and comments that are not ASCII become question marks: trimesh takes only UTF-8.
    """
    import trimesh

    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("obj", "off", "stl", "ply", "xyz"):
        return trimesh.load(path, process=False, **options)
    content = path.read_bytes()
    if kind == "xyz" and content and b"\n" not in content.strip():  # trimesh cuts off the end of a single line
        return trimesh.PointCloud(np.loadtxt(BytesIO(content)).reshape(-1)[:3].reshape(1, 3))
    text = len(content)
    if kind == "stl" and text == 84 + 50 * int.from_bytes(content[80:84], "little"):
        text = 0  # binary: trimesh ignores its header
    elif kind == "ply" and b"format ascii" not in content[:1000]:
        text = content.find(b"end_header")
    content = content[:text].translate(ASCII) + content[text:]
    return trimesh.load(BytesIO(content), file_type=kind, process=False, **options)
