"""A catalogue of furniture meshes: Debian's package `sweethome3d-furniture`, with creators and licences."""

import re
from pathlib import Path

from distrace.data.archive import unpack_zip
from distrace.data.debian import MeshEntry, by_hand, unpacked

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
_FIELD = re.compile(r"^(\w+)#(\d+)=(.*?)\s*$", re.MULTILINE)  # of a model, by its number
_LICENCE = re.compile(
    r"creativecommons\.org/(?:licenses/(?P<terms>[a-z-]+)/(?P<version>[\d.]+)(?:/(?P<country>[a-z]{2})\b)?"
    r"|(?:choose|publicdomain)/zero)"
)
_AUTHORS = (re.compile(r'downloading ".*" by (.+)'), re.compile(r"<title>.* by (.+?) - \d+ - "))
_HEADER_AUTHOR = re.compile(r"^# 3D models created by ([^,\r\n]+)", re.MULTILINE)


def catalogue(deb: Path, folder: Path) -> list[MeshEntry]:
    """Returns every .obj model of the package's catalogues, unpacked under `folder`; a second call unpacks nothing.

    Models in other formats are left out. Raises `ValueError` if `deb` is missing, broken, or another package.
    """
    shelves = sorted(unpacked(PACKAGE, deb, folder, _arrange).glob(f"*/{_PROPERTIES}"))
    if not shelves:
        raise ValueError(f"{deb} holds no furniture catalogue (.sh3f); {by_hand(PACKAGE)}")
    return [mesh for shelf in shelves for mesh in _meshes(shelf, folder)]


def _arrange(content: Path, home: Path) -> None:
    for archive in content.rglob("*.sh3f"):
        unpack_zip(archive, home / archive.stem)


def _meshes(properties: Path, folder: Path) -> list[MeshEntry]:
    """Returns the meshes of one catalogue, which its Java properties file describes as `name#7=…`, `model#7=…`."""
    root = properties.parent
    text = re.sub(r"\\u([0-9a-fA-F]{4})", _character, properties.read_text(encoding="latin-1"))
    models: dict[str, dict[str, str]] = {}
    for field, number, value in _FIELD.findall(text):
        models.setdefault(number, {})[field] = value
    licence = _licence(root, text)
    author = _HEADER_AUTHOR.search(text)
    found = []
    for model in models.values():
        path = root / model.get("model", "").lstrip("/")
        if path.suffix.lower() == ".obj" and ".." not in path.relative_to(root).parts and path.is_file():
            name = model.get("name") or path.stem
            creator = model.get("creator") or _creator_beside(path) or (author[1].strip() if author else "unknown")
            category = _category(name, model.get("tags", ""))
            found.append(MeshEntry(category, name, creator, licence, PACKAGE, path.relative_to(folder)))
    return found


def _character(escape: re.Match[str]) -> str:
    return chr(int(escape[1], 16))


def _licence(root: Path, properties: str) -> str:
    """Returns the licence by its SPDX name, from the address in LICENSE.TXT; else in the catalogue's own words."""
    path = root / "LICENSE.TXT"
    named = _LICENCE.search(path.read_text(encoding="latin-1") if path.is_file() else "")
    if not named:
        own = re.search(r"^license=(.*\S)", properties, re.MULTILINE)
        return own[1] if own else "unknown"
    if not named["terms"]:
        return "CC0-1.0"
    parts = ("CC", named["terms"].upper(), named["version"], (named["country"] or "").upper())
    return "-".join(part for part in parts if part)


def _creator_beside(model: Path) -> str:
    """Returns the author whom a licence file in the model's own folder names, or an empty string."""
    for licence in sorted(model.parent.glob("*[Ll][Ii][Cc][Ee][Nn][Ss][Ee]*")):
        text = licence.read_text(encoding="utf-8", errors="replace")
        for author in _AUTHORS:
            if found := author.search(text):
                return found[1].strip()
    return ""


def _category(name: str, tags: str) -> str:
    """Returns the first of CATEGORIES' words in the name; cars are named after their make, so there the tag decides."""
    words = re.findall(r"[a-z]+", name.lower())
    if ACCESSORIES.intersection(words):
        return "other"
    if found := next((CATEGORIES[word] for word in words if word in CATEGORIES), None):
        return found
    return "car" if "car" in re.split(r"\s*,\s*", tags.lower()) else "other"
