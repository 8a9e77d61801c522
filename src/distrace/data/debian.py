"""Debian's packages as a source of meshes: fetched by apt-get, unpacked once."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from distrace.data.archive import unpack_deb
from distrace.errors import explained

_STAMP = "unpacked-from.txt"
DOCUMENTS = "usr/share/doc"


def by_hand(package: str) -> str:
    """What to do where a package cannot be fetched."""
    return f"download the .deb by hand from https://packages.debian.org/{package} and pass --from FILE.deb"


def fetch(package: str, folder: Path) -> Path:
    """The package's .deb in `folder`, by `apt-get download` unless it is there already; else a ValueError."""
    present = sorted(folder.glob(f"{package}_*.deb"))
    if present:
        return present[-1]
    sentence = f"apt-get cannot download {package}; {by_hand(package)}"
    # apt-get writes under the final name from the first byte: an interrupted file must not look whole.
    with explained(sentence), TemporaryDirectory(dir=folder) as partial:
        downloaded = _download(package, Path(partial))
        return downloaded.replace(folder / downloaded.name)


def _download(package: str, folder: Path) -> Path:
    command = ["apt-get", "download", package]
    done = subprocess.run(command, check=False, cwd=folder, stdin=subprocess.DEVNULL, capture_output=True, text=True)
    found = list(folder.glob(f"{package}_*.deb"))
    if done.returncode or not found:
        raise ValueError(done.stderr.strip().rpartition("\n")[2])
    return found[0]


def unpacked(
    package: str,
    deb: Path,
    folder: Path,
    arrange: Callable[[Path, Path], None],
    keeping: str = "",
    below: str = "",  # the only folder of the package that is unpacked, for `arrange`
) -> Path:
    """The package's folder under `folder`: what `arrange` takes there from the files of the .deb, and `copyright`.

    A second call unpacks nothing: a stamp, written last, names the .deb and what was kept of it. Raises ValueError if
    `deb` is missing or broken, or if something else has the folder's name.
    """
    if not deb.is_file():
        raise ValueError(f"there is no file {deb}; {by_hand(package)}")
    home = folder / package
    source = f"{deb.name} {deb.stat().st_size} {keeping}".rstrip() + "\n"
    stamp = home / _STAMP
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
    (partial / _STAMP).write_text(source)
    _remove(home)
    return partial.replace(home)


def _remove(path: Path) -> None:
    """A folder with all that is in it; of a link only the link."""
    if path.is_symlink() or path.is_file():
        path.unlink()
    elif path.exists():
        shutil.rmtree(path)
