"""A catalogue of aircraft meshes: Debian's package `flightgear-data-ai`, in AC3D, under the GPL."""

import shutil
from pathlib import Path

from .catalogue import Mesh, listed
from .debian import by_hand, unpacked

PACKAGE = "flightgear-data-ai"
AIRCRAFT = "usr/share/games/flightgear/AI/Aircraft"
LICENCE, CREATOR = "GPL-2.0-or-later", "FlightGear team"
PARTS = {"light", "lights", "Lights", "refueling"}  # folders
NO_PLANES = {"Ferry", "SpaceShuttle", "balloon"}


def prepare(out: Path, deb: Path | None = None) -> list[Mesh]:
    """One mesh of each aircraft of the package, by `catalogue.listed`."""
    return listed(PACKAGE, catalogue, out, deb)


def catalogue(deb: Path, folder: Path) -> list[Mesh]:
    """The mesh of each aircraft, by its folder's name: of several liveries or variants the one with most in it.

    Raises ValueError if `deb` is missing, broken, or another package.
    """
    home = unpacked(PACKAGE, deb, folder, _arrange)
    meshes = [_mesh(aircraft, folder) for aircraft in sorted(home.iterdir()) if _models(aircraft)]
    if not meshes:
        raise ValueError(f"{deb} holds no aircraft ({AIRCRAFT}/*.ac); {by_hand(PACKAGE)}")
    return meshes


def _arrange(content: Path, home: Path) -> None:
    """Meshes alone: textures, sounds and flight plans are left behind."""
    root = content / AIRCRAFT
    for path in sorted(root.rglob("*.ac")):
        target = home / path.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.move(path, target)


def _models(aircraft: Path) -> list[Path]:
    return sorted(path for path in aircraft.rglob("*.ac") if path.parent.name not in PARTS)


def _mesh(aircraft: Path, folder: Path) -> Mesh:
    largest = max(_models(aircraft), key=lambda path: path.stat().st_size)
    category = "other" if aircraft.name in NO_PLANES else "plane"
    return Mesh(category, aircraft.name, CREATOR, LICENCE, PACKAGE, largest.relative_to(folder))
