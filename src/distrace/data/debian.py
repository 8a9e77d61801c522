"""Catalogues of the meshes in Debian's packages, which apt-get fetches: unpacked once, and listed in a table."""

import csv
import io
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from distrace.data.archive import unpack_deb
from distrace.errors import error_context
from distrace.files import save_text

STAMP = "unpacked-from.txt"
DOCUMENTS = "usr/share/doc"
COLUMNS = ("category", "name", "creator", "licence", "debian_package", "path")


@dataclass(frozen=True)
class MeshEntry:
    category: str
    name: str
    creator: str
    licence: str  # SPDX
    package: str
    path: Path  # relative to the catalogue's folder


def catalogue_package(
    package: str, catalogue: Callable[[Path, Path], list[MeshEntry]], out: Path, deb: Path | None = None
) -> list[MeshEntry]:
    """Returns the meshes of a package, unpacked under `out` and listed in out/shapes.csv; fetched if `deb` is None.

    Raises `ValueError` if `out` cannot be written, apt-get cannot fetch, or `deb` is not that package.
    """
    with error_context(f"{out} cannot be written to; choose another --out"):
        out.mkdir(parents=True, exist_ok=True)
    meshes = catalogue(deb or fetch(package, out), out)
    write_catalogue(meshes, out / "shapes.csv")
    return meshes


def write_catalogue(meshes: Sequence[MeshEntry], path: Path) -> None:
    """Writes the meshes as CSV in UTF-8, a row each. Raises `ValueError` if `path` cannot be written."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows((m.category, m.name, m.creator, m.licence, m.package, m.path.as_posix()) for m in meshes)
    with error_context(f"{path} cannot be written; choose another --out"):
        save_text(path, table.getvalue())


def catalogue_summary(meshes: Sequence[MeshEntry]) -> str:
    """Returns the counts by category and licence."""
    categories = _counted(mesh.category for mesh in meshes)
    licences = _counted(mesh.licence for mesh in meshes)
    return f"{len(meshes)} meshes ({categories}; {licences})"


def by_hand(package: str) -> str:
    """Returns what to do where a package cannot be fetched."""
    return f"download the .deb by hand from https://packages.debian.org/{package} and pass --from FILE.deb"


def fetch(package: str, folder: Path) -> Path:
    """Returns the .deb in `folder`, downloaded by apt-get if it is not there. Raises `ValueError` if that fails."""
    pattern = f"{package}_*.deb"
    present = sorted(folder.glob(pattern))
    if present:
        return present[-1]
    # apt-get writes under the final name from the first byte: an interrupted file must not look whole.
    with (
        error_context(f"apt-get cannot download {package}; {by_hand(package)}"),
        TemporaryDirectory(dir=folder) as partial,
    ):
        command = ["apt-get", "download", package]
        done = subprocess.run(command, cwd=partial, stdin=subprocess.DEVNULL, capture_output=True, text=True)
        found = list(Path(partial).glob(pattern))
        if done.returncode or not found:
            raise ValueError(done.stderr.strip().rpartition("\n")[2])
        return found[0].replace(folder / found[0].name)


def unpacked(
    package: str,
    deb: Path,
    folder: Path,
    arrange: Callable[[Path, Path], None],
    keeping: str = "",
    below: str = "",  # the only folder of the package that is unpacked, for `arrange`
) -> Path:
    """Returns the package's folder under `folder`: what `arrange` takes there from the .deb, and `copyright`.

    A second call unpacks nothing: a stamp, written last, names the .deb and what was kept of it. Raises `ValueError`
    if `deb` is missing or broken, or if something else has the folder's name.
    """
    if not deb.is_file():
        raise ValueError(f"there is no file {deb}; {by_hand(package)}")
    home = folder / package
    source = f"{deb.name} {deb.stat().st_size} {keeping}".rstrip() + "\n"
    stamp = home / STAMP
    if stamp.is_file() and stamp.read_text() == source:
        return home
    if home.exists() and not stamp.is_file():
        raise ValueError(f"{home} exists and is not an unpacked catalogue; move it or choose another --out")
    partial = folder / f".{package}.partial"
    _remove(partial)
    content = partial / "package"
    unpack_deb(deb, content, below=(below, DOCUMENTS) if below else ())
    arrange(content / below, partial)
    for licences in content.glob(f"{DOCUMENTS}/*/copyright"):
        licences.replace(partial / "copyright")
    shutil.rmtree(content)
    (partial / STAMP).write_text(source)
    _remove(home)
    return partial.replace(home)


def _remove(path: Path) -> None:
    """Removes a folder with all that is in it; of a link only the link."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)


def _counted(words: Iterable[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in Counter(words).most_common())
