"""Catalogues of aircraft meshes, from Debian's packages of FlightGear, in AC3D, under the GPL.

Those that fly by themselves, in `flightgear-data-ai`, and those parked at its airports, in `flightgear-data-base`.
"""

import re
import shutil
from pathlib import Path

from distrace.data.debian import MeshEntry, by_hand, unpacked

PACKAGE = "flightgear-data-ai"
AIRCRAFT = "usr/share/games/flightgear/AI/Aircraft"
LICENCE = "GPL-2.0-or-later"
CREATOR = "FlightGear team"
PARTS = {"light", "lights", "Lights", "refueling"}  # folders
NO_PLANES = {"Ferry", "SpaceShuttle", "balloon"}

PARKED_PACKAGE = "flightgear-data-base"
PARKED = "usr/share/games/flightgear/Scenery/Models/Aircraft"

_TEXTURE = re.compile(r'^texture\s+"(?:[^"\n]*[/\\])?([^"\n]+)"', re.MULTILINE)


def catalogue(deb: Path, folder: Path) -> list[MeshEntry]:
    """Returns the mesh of each aircraft, by its folder's name: of several liveries or variants the largest file.

    Raises `ValueError` if `deb` is missing, broken, or another package.
    """
    home = unpacked(PACKAGE, deb, folder, _arrange, "meshes and images", AIRCRAFT)
    meshes = []
    for aircraft in sorted(home.iterdir()):
        models = sorted(path for path in aircraft.rglob("*.ac") if path.parent.name not in PARTS)
        if models:
            largest = max(models, key=lambda path: path.stat().st_size)
            category = "other" if aircraft.name in NO_PLANES else "plane"
            meshes.append(MeshEntry(category, aircraft.name, CREATOR, LICENCE, PACKAGE, largest.relative_to(folder)))
    if not meshes:
        raise ValueError(f"{deb} holds no aircraft ({AIRCRAFT}/*.ac); {by_hand(PACKAGE)}")
    return meshes


def parked(deb: Path, folder: Path) -> list[MeshEntry]:
    """Returns each mesh by its file's name, helicopters and liveries among them: the split says what is learnt.

    Raises `ValueError` if `deb` is missing, broken, or another package.
    """
    home = unpacked(PARKED_PACKAGE, deb, folder, _arrange, "parked aircraft", PARKED)
    paths = [path.relative_to(folder) for path in sorted(home.glob("*.ac"))]
    if not paths:
        raise ValueError(f"{deb} holds no aircraft ({PARKED}/*.ac); {by_hand(PARKED_PACKAGE)}")
    return [MeshEntry("parked", path.stem, CREATOR, LICENCE, PARKED_PACKAGE, path) for path in paths]


def _arrange(root: Path, home: Path) -> None:
    """Takes the meshes of `root`, each with the images that it names beside it; sounds and flight plans are left."""
    for path in sorted(root.rglob("*.ac")):
        target = home / path.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        for image in _images(path, root.joinpath(*path.parent.relative_to(root).parts[:1])):
            shutil.copy(image, target.parent)
        shutil.move(path, target)


def _images(mesh: Path, aircraft: Path) -> list[Path]:
    """Returns the files of a mesh's textures; of several liveries the default one, or the first."""
    named = sorted(set(_TEXTURE.findall(mesh.read_text(encoding="latin-1"))))
    files = [path for path in sorted(aircraft.rglob("*")) if path.is_file()]
    liveries = [[path for path in files if path.name == name] for name in named]

    def rank(path: Path) -> tuple[bool, bool, Path]:
        return path.parent != mesh.parent, "default" not in path.parent.name.lower(), path

    return [min(paths, key=rank) for paths in liveries if paths]
