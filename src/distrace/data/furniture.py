"""A catalogue of furniture meshes: Debian's package `sweethome3d-furniture`, with creators and licences."""

import re
from dataclasses import dataclass
from pathlib import Path

from distrace.data.archive import unpack_zip
from distrace.data.catalogue import Mesh, listed
from distrace.data.debian import by_hand, unpacked
from distrace.data.properties import properties

PACKAGE = "sweethome3d-furniture"
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
_LICENCE = re.compile(
    r"creativecommons\.org/(?:licenses/(?P<terms>[a-z-]+)/(?P<version>[\d.]+)(?:/(?P<country>[a-z]{2})\b)?"
    r"|(?:choose|publicdomain)/zero)"
)
_AUTHORS = (re.compile(r'downloading ".*" by (.+)'), re.compile(r"<title>.* by (.+?) - \d+ - "))
_HEADER_AUTHOR = re.compile(r"^# 3D models created by ([^,\r\n]+)", re.MULTILINE)


@dataclass(frozen=True)
class _Shelf:
    """One unpacked .sh3f: what its properties say of the whole and of each model."""

    root: Path
    models: list[dict[str, str]]
    licence: str
    creator: str


def prepare(out: Path, deb: Path | None = None) -> list[Mesh]:
    """Every mesh of the package, by `catalogue.listed`."""
    return listed(PACKAGE, catalogue, out, deb)


def catalogue(deb: Path, folder: Path) -> list[Mesh]:
    """Every .obj model of the package's catalogues, unpacked under `folder`; a second call unpacks nothing.

    Raises ValueError if `deb` is missing, broken, or another package.
    """
    shelves = _shelves(unpacked(PACKAGE, deb, folder, _arrange))
    if not shelves:
        raise ValueError(f"{deb} holds no furniture catalogue (.sh3f); {by_hand(PACKAGE)}")
    return [_mesh(shelf, model, folder) for shelf in shelves for model in shelf.models if _has_mesh(shelf, model)]


def left_out(folder: Path) -> int:
    """How many models of the catalogues are no plain .obj files."""
    shelves = _shelves(folder / PACKAGE)
    return sum(not _has_mesh(shelf, model) for shelf in shelves for model in shelf.models)


def _arrange(content: Path, home: Path) -> None:
    for archive in content.rglob("*.sh3f"):
        unpack_zip(archive, home / archive.stem)


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
