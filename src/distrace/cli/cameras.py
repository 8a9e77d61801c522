"""`cameras`: from photographs or a video to cameras, in a folder that `reconstruct` and `multiview` read."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import distrace
from distrace.cli.console import Bar, Run, console, progress, start
from distrace.data.photo_readers.frames import read_json
from distrace.data.picture_input import copied_frames, copied_photographs, listed
from distrace.data.structure_from_motion import (
    MIN_IMAGES,
    Database,
    Picture,
    pairs,
    undistort,
    upright,
    with_principal_points,
)
from distrace.files import emptied, run_lock, save_json, save_text
from distrace.optional import require
from distrace.report.cameras_page import cameras_page

WRITTEN = ("images", "masks", "sparse")
WORK = "work"
MIN_SHARE = 0.5  # of the photographs: with fewer placed, something is wrong
SHOWN = 5  # names in a warning, at most
ADVICE = (
    "take sharp photographs of a textured scene from all around it, each with two thirds of what the one before shows"
)

Source = Annotated[Path, tyro.conf.arg(metavar="PHOTOS_OR_VIDEO", help="a folder of PNG or JPEG files, or a video")]


@dataclass(frozen=True)
class Cameras:
    """Find the cameras of photographs, or of a video, by structure from motion.

    Writes undistorted images and a COLMAP model, which `reconstruct` and `multiview` read.
    """

    source: tyro.conf.Positional[Source]
    out: Path = Path("out/cameras")
    frames: int = 60  # of a video: the sharpest in so many equal spans
    max_size: int = 1600  # pixels along the longer side; larger photographs are scaled down
    seed: int = 0

    def run(self) -> None:
        self._check()
        run = start(self.out)
        with run_lock(run.out):
            self._check_out()
            pictures = self._pictures()
            found = _placed(run, pictures, self.seed)
            self._finish(run, pictures, found)

    @property
    def work(self) -> Path:
        return self.out / WORK

    def _check(self) -> None:
        if not self.source.exists():
            raise ValueError(f"there is no folder or file {self.source}")
        if self.frames < MIN_IMAGES:
            raise ValueError(f"--frames {self.frames} was given; at least {MIN_IMAGES} are needed")
        if self.max_size < 64:
            raise ValueError(f"--max-size {self.max_size} was given; give at least 64 pixels")
        require("finding cameras", "pycolmap")

    def _check_out(self) -> None:
        """Raises `ValueError` where this command would replace the photographs, or what it did not write."""
        folders = (*WRITTEN, WORK)
        if any(self.source.resolve().is_relative_to((self.out / name).resolve()) for name in folders):
            raise ValueError(f"{self.source} would be replaced; give another folder than --out {self.out}")
        foreign = [name for name in folders if (self.out / name).exists()]
        if foreign and not (self.work / "input.json").is_file():
            raise ValueError(
                f"--out {self.out} holds {foreign[0]}/ that no run of `cameras` wrote, by its work/; give another"
            )

    def _pictures(self) -> list[Picture]:
        """Returns the copies of the photographs; those of an earlier run where the input is the same."""
        paths = listed(self.source) if self.source.is_dir() else [self.source]
        if self.source.is_dir():
            _check_count(len(paths), self.source)
        given = {
            "files": [[str(path.resolve()), path.stat().st_size, path.stat().st_mtime_ns] for path in paths],
            "options": [self.frames, self.max_size, self.seed],
            "version": distrace.__version__,
        }
        note = self.work / "input.json"
        before = read_json(note) if note.is_file() else {}
        if before.get("given") == given and before.get("pictures"):
            console.print("continuing from the photographs and features of an earlier run")
            return [Picture(**each) for each in before["pictures"]]
        if (self.out / "masks").exists():
            raise ValueError(f"{self.out / 'masks'} are masks of other photographs; remove them, or give another --out")
        emptied(self.work)
        save_json(note, {"given": given})
        if self.source.is_dir():
            with progress("reading photographs", len(paths)) as bar:
                pictures = copied_photographs(paths, self.work, self.max_size, bar.advance)
        else:
            with progress("choosing frames", self.frames) as bar:
                pictures = copied_frames(self.source, self.frames, self.work, self.max_size, bar.advance)
        _check_count(len(pictures), self.source)
        save_json(note, {"given": given, "pictures": [asdict(each) for each in pictures]})
        return pictures

    def _finish(self, run: Run, pictures: list[Picture], found: Any) -> None:
        placed = sorted(image.name for image in found.images.values() if image.has_pose)
        missing = sorted({each.name for each in pictures} - set(placed))
        if missing:
            names = ", ".join(missing[:SHOWN]) + (", …" if len(missing) > SHOWN else "")
            run.warn(f"{len(missing)} of {len(pictures)} photographs could not be placed and are left out: {names}")
        masks = self.work / "masks"
        (run.out / "result.json").unlink(missing_ok=True)
        console.print("undistorting")
        masked = masks.is_dir() and len(list(masks.iterdir())) == len(pictures)
        undistort(found, self.work / "images", run.out, masks if masked else None)
        with run.optional("report.html"):
            save_text(run.out / "report.html", cameras_page(found, len(pictures), run.origin))
        need = "" if masked else f", with masks in {run.out / 'masks'} or a dark background"
        error = found.compute_mean_reprojection_error()
        points = found.num_points3D()
        run.finish(
            {
                "photographs": len(pictures),
                "placed": len(placed),
                "missing": missing,
                "reprojection_error": round(error, 4),
                "points": points,
                "cameras": len(found.cameras),
            },
            f"{len(placed)} of {len(pictures)} photographs placed",
            f"{points:,} points, mean reprojection error {error:.2f} pixels",
            f"next: distrace reconstruct {run.out}{need}",
        )


def _placed(run: Run, pictures: list[Picture], seed: int) -> Any:
    """Returns the reconstruction. Raises `ValueError` where too few photographs can be placed."""
    work = run.out / WORK
    names = [each.name for each in pictures]
    database = Database(work / "database.db", work / "images")
    database.add(pictures)
    with progress("finding features", len(names)) as bar:
        database.extract(names, _to(bar))
    with progress("matching pairs", len(pairs(names))) as bar:
        database.match(names, seed, _to(bar))
    if not database.verified_pairs():
        raise ValueError(f"no two of the {len(names)} photographs show enough of the same place; {ADVICE}")
    with progress("placing cameras", len(names)) as bar:
        found = database.place(work / "sparse", len(names), seed, _to(bar))
    placed = 0 if found is None else found.num_reg_images()
    if placed < max(MIN_IMAGES, MIN_SHARE * len(names)):
        raise ValueError(f"only {placed} of {len(names)} photographs could be placed; {ADVICE}")
    found = with_principal_points(found)
    upright(found)
    return found


def _to(bar: Bar) -> Callable[[int], None]:
    return lambda done: bar.advance(to=done)


def _check_count(count: int, source: Path) -> None:
    if count < MIN_IMAGES:
        what = "photographs" if source.is_dir() else "frames"
        raise ValueError(f"{source} holds {count} {what}; at least {MIN_IMAGES} are needed, better 20 to 60")
