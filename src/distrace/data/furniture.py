"""A catalogue of furniture meshes: Debian's package `sweethome3d-furniture`, with creators and licences."""

import csv
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import explained
from .archive import unpack_deb, unpack_zip

PACKAGE = "sweethome3d-furniture"
COLUMNS = ("category", "name", "creator", "licence", "debian_package", "path")
CATEGORIES = {
    "chair": "chair",
    "armchair": "chair",
    "stool": "stool",
    "sofa": "sofa",
    "couch": "sofa",
    "table": "table",
    "desk": "table",
    "bed": "bed",
    "car": "car",
    "truck": "car",
    "bus": "car",
}
# "Desk lamp", "Table fan", "Table tennis bat", "Car model": another word says what they are.
ACCESSORIES = {"lamp", "fan", "bat", "model"}

_PROPERTIES = "PluginFurnitureCatalog.properties"
_STAMP = "unpacked-from.txt"
_BY_HAND = f"download the .deb by hand from https://packages.debian.org/{PACKAGE} and pass --from FILE.deb"
_LICENCE = re.compile(
    r"creativecommons\.org/(?:licenses/(?P<terms>[a-z-]+)/(?P<version>[\d.]+)(?:/(?P<country>[a-z]{2})\b)?"
    r"|(?:choose|publicdomain)/zero)"
)
_AUTHORS = (re.compile(r'downloading ".*" by (.+)'), re.compile(r"<title>.* by (.+?) - \d+ - "))
_HEADER_AUTHOR = re.compile(r"^# 3D models created by ([^,\r\n]+)", re.MULTILINE)


@dataclass(frozen=True)
class Mesh:
    category: str
    name: str
    creator: str
    licence: str  # SPDX
    package: str
    path: Path  # of the .obj, relative to the catalogue's folder


@dataclass(frozen=True)
class _Shelf:
    """One unpacked .sh3f: what its properties say of the whole and of each model."""

    root: Path
    models: list[dict[str, str]]
    licence: str
    creator: str


def prepare(out: Path, deb: Path | None = None) -> list[Mesh]:
    """Every mesh of the package, unpacked under `out` and listed in out/shapes.csv; fetched if `deb` is None.

    Raises ValueError if `out` cannot be written, apt-get cannot fetch, or `deb` is not that package.
    """
    with explained(f"{out} cannot be written to; choose another --out"):
        out.mkdir(parents=True, exist_ok=True)
    meshes = catalogue(deb or fetch(out), out)
    write_catalogue(meshes, out / "shapes.csv")
    return meshes


def fetch(folder: Path) -> Path:
    """The package's .deb in `folder`, by `apt-get download` unless it is there already; else a ValueError."""
    present = sorted(folder.glob(f"{PACKAGE}_*.deb"))
    if present:
        return present[-1]
    sentence = f"apt-get cannot download {PACKAGE}; {_BY_HAND}"
    # apt-get writes under the final name from the first byte: an interrupted file must not look whole.
    with explained(sentence), TemporaryDirectory(dir=folder) as partial:
        downloaded = _download(Path(partial))
        return downloaded.replace(folder / downloaded.name)


def _download(folder: Path) -> Path:
    command = ["apt-get", "download", PACKAGE]
    done = subprocess.run(command, check=False, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    found = list(folder.glob(f"{PACKAGE}_*.deb"))
    if done.returncode or not found:
        raise ValueError(done.stderr.strip().rpartition("\n")[2])
    return found[0]


def catalogue(deb: Path, folder: Path) -> list[Mesh]:
    """Every .obj model of the package's catalogues, unpacked under `folder`; a second call unpacks nothing.

    Raises ValueError if `deb` is missing, broken, or another package.
    """
    shelves = _shelves(_unpacked(deb, folder))
    if not shelves:
        raise ValueError(f"{deb} holds no furniture catalogue (.sh3f); {_BY_HAND}")
    return [_mesh(shelf, model, folder) for shelf in shelves for model in shelf.models if _has_mesh(shelf, model)]


def write_catalogue(meshes: list[Mesh], path: Path) -> None:
    """The meshes as a table in UTF-8 CSV, one row each; ValueError if `path` cannot be written."""
    rows = ((m.category, m.name, m.creator, m.licence, m.package, m.path.as_posix()) for m in meshes)
    sentence = f"{path} cannot be written; choose another --out"
    with explained(sentence), path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows((COLUMNS, *rows))


def summary(meshes: list[Mesh], folder: Path) -> str:
    """Counts by category and licence, and of the models left out because they are not plain .obj files."""
    shelves = _shelves(folder / PACKAGE)
    others = sum(not _has_mesh(shelf, model) for shelf in shelves for model in shelf.models)
    categories = _counted(mesh.category for mesh in meshes)
    licences = _counted(mesh.licence for mesh in meshes)
    return f"{len(meshes)} meshes ({categories}; {licences}), {others} models in other formats left out"


def _counted(words: Iterator[str]) -> str:
    return ", ".join(f"{count} {word}" for word, count in Counter(words).most_common())


def _unpacked(deb: Path, folder: Path) -> Path:
    """The folder of unpacked catalogues; its stamp is written last and names the .deb it came from."""
    if not deb.is_file():
        raise ValueError(f"there is no file {deb}; {_BY_HAND}")
    home, source = folder / PACKAGE, f"{deb.name} {deb.stat().st_size}\n"
    stamp = home / _STAMP
    if stamp.is_file() and stamp.read_text() == source:
        return home
    if home.exists() and not stamp.is_file():
        raise ValueError(f"{home} exists and is not an unpacked catalogue; move it or choose another --out")
    partial = folder / f".{PACKAGE}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    _unpack(deb, partial)
    (partial / _STAMP).write_text(source)
    shutil.rmtree(home, ignore_errors=True)
    return partial.replace(home)


def _unpack(deb: Path, folder: Path) -> None:
    package = folder / "package"
    unpack_deb(deb, package)
    for archive in package.rglob("*.sh3f"):
        unpack_zip(archive, folder / archive.stem)
    for licences in package.glob("usr/share/doc/*/copyright"):
        licences.replace(folder / "copyright")
    shutil.rmtree(package)


def _shelves(home: Path) -> list[_Shelf]:
    return [_shelf(path.parent) for path in sorted(home.glob(f"*/{_PROPERTIES}"))]


def _shelf(root: Path) -> _Shelf:
    content = (root / _PROPERTIES).read_bytes()
    entries = properties(content)
    author = _HEADER_AUTHOR.search(content.decode("latin-1"))
    return _Shelf(root, _models(entries), _licence(root, entries), author[1].strip() if author else "unknown")


def _models(entries: dict[str, str]) -> list[dict[str, str]]:
    """`name#7=…` and `model#7=…` gathered into one model per number, in the file's order."""
    models: dict[str, dict[str, str]] = {}
    for key, value in entries.items():
        field, mark, number = key.partition("#")
        if mark:
            models.setdefault(number, {})[field] = value.strip()
    return [model for model in models.values() if "model" in model]


def _licence(root: Path, entries: dict[str, str]) -> str:
    """The catalogue's licence by its SPDX name, from the address in LICENSE.TXT; else in its own words."""
    path = root / "LICENSE.TXT"
    named = _LICENCE.search(path.read_text(encoding="latin-1") if path.is_file() else "")
    if not named:
        return entries.get("license", "").strip() or "unknown"
    if not named["terms"]:
        return "CC0-1.0"
    parts = ("CC", named["terms"].upper(), named["version"], (named["country"] or "").upper())
    return "-".join(part for part in parts if part)


def _mesh(shelf: _Shelf, model: dict[str, str], folder: Path) -> Mesh:
    path = _model_path(shelf, model)
    name = model.get("name") or path.stem
    creator = model.get("creator") or _creator_beside(path) or shelf.creator
    category = _category(name, model.get("tags", ""))
    return Mesh(category, name, creator, shelf.licence, PACKAGE, path.relative_to(folder))


def _model_path(shelf: _Shelf, model: dict[str, str]) -> Path:
    return shelf.root / model["model"].lstrip("/")


def _has_mesh(shelf: _Shelf, model: dict[str, str]) -> bool:
    path = _model_path(shelf, model)
    inside = ".." not in Path(model["model"]).parts
    return inside and path.suffix.lower() == ".obj" and path.is_file()


def _creator_beside(model: Path) -> str:
    """The author whom a licence file in the model's own folder names, or an empty string."""
    for licence in sorted(model.parent.glob("*[Ll][Ii][Cc][Ee][Nn][Ss][Ee]*")):
        text = licence.read_text(encoding="utf-8", errors="replace")
        for author in _AUTHORS:
            if found := author.search(text):
                return found[1].strip()
    return ""


def _category(name: str, tags: str) -> str:
    """The first of CATEGORIES' words in the name; cars are named after their make, so there the tag decides."""
    words = re.findall(r"[a-z]+", name.lower())
    if ACCESSORIES.intersection(words):
        return "other"
    if found := next((CATEGORIES[word] for word in words if word in CATEGORIES), None):
        return found
    return "car" if "car" in re.split(r"\s*,\s*", tags.lower()) else "other"


def properties(content: bytes) -> dict[str, str]:
    """The entries of a Java properties file, as java.util.Properties.load reads them."""
    pairs = (re.match(r"((?:\\.|[^\\=:\s])*)\s*[=:]?\s*(.*)", line, re.DOTALL) for line in _lines(content))
    return {_unescaped(pair[1]): _unescaped(pair[2]) for pair in pairs if pair}


def _lines(content: bytes) -> Iterator[str]:
    """Logical lines: comments and blanks dropped, those that end in a backslash joined to the next."""
    logical = ""
    for line in content.splitlines():
        text = line.decode("latin-1").lstrip(" \t\f")
        if not logical and text[:1] in ("", "#", "!"):
            continue
        logical += text
        if (len(logical) - len(logical.rstrip("\\"))) % 2:
            logical = logical[:-1]
        else:
            yield logical
            logical = ""
    if logical:
        yield logical


def _unescaped(text: str) -> str:
    controls = {"t": "\t", "n": "\n", "r": "\r", "f": "\f"}
    units = re.sub(
        r"\\(u[0-9a-fA-F]{4}|.)",
        lambda found: chr(int(found[1][1:], 16)) if len(found[1]) > 1 else controls.get(found[1], found[1]),
        text,
    )
    # Java writes characters beyond 16 bits as two \u escapes: a surrogate pair, which Python would keep apart.
    return units.encode("utf-16", "surrogatepass").decode("utf-16", "replace")
