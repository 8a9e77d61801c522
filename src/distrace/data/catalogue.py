"""A catalogue of meshes: what each is, who made it, and under which licence; as a table beside the unpacked files."""

import csv
import io
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from distrace.data.debian import fetch
from distrace.errors import explained
from distrace.files import save_text

COLUMNS = ("category", "name", "creator", "licence", "debian_package", "path")


@dataclass(frozen=True)
class Mesh:
    category: str
    name: str
    creator: str
    licence: str  # SPDX
    package: str
    path: Path  # relative to the catalogue's folder


def listed(
    package: str, catalogue: Callable[[Path, Path], list[Mesh]], out: Path, deb: Path | None = None
) -> list[Mesh]:
    """The meshes of a Debian package, unpacked under `out` and listed in out/shapes.csv; fetched if `deb` is None.

    Raises ValueError if `out` cannot be written, apt-get cannot fetch, or `deb` is not that package.
    """
    with explained(f"{out} cannot be written to; choose another --out"):
        out.mkdir(parents=True, exist_ok=True)
    meshes = catalogue(deb or fetch(package, out), out)
    write_catalogue(meshes, out / "shapes.csv")
    return meshes


def write_catalogue(meshes: Sequence[Mesh], path: Path) -> None:
    """The meshes as a table in UTF-8 CSV, one row each; ValueError if `path` cannot be written."""
    rows = ((m.category, m.name, m.creator, m.licence, m.package, m.path.as_posix()) for m in meshes)
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows((COLUMNS, *rows))
    with explained(f"{path} cannot be written; choose another --out"):
        save_text(path, table.getvalue())


def summary(meshes: Sequence[Mesh]) -> str:
    """Counts by category and licence."""
    categories = _counted(mesh.category for mesh in meshes)
    licences = _counted(mesh.licence for mesh in meshes)
    return f"{len(meshes)} meshes ({categories}; {licences})"


def _counted(words: Iterable[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in Counter(words).most_common())
