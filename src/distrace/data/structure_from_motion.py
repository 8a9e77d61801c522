"""Cameras from photographs alone: structure from motion (Schönberger and Frahm, CVPR 2016) by COLMAP's own library.

All steps run on the CPU. Features and matches live in a database, so a run that was interrupted continues from there.
"""

import math
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from distrace.files import emptied
from distrace.optional import require

T = TypeVar("T")
Watch = Callable[[int], None]
"""Is called now and then with the number of steps done."""

PEAK_THRESHOLD = 0.003  # of SIFT's contrast: half of COLMAP's, for photographs of smooth or dark objects
MIN_INLIERS = 15  # matches that place a photograph, at least: half of COLMAP's, which left out 3 of 16
MAX_EXHAUSTIVE = 80  # photographs of which every pair is matched
NEIGHBOURS = 10  # photographs before and after one in a sequence that it is matched with
LOOP_PERIOD = 5  # every fifth photograph of a sequence is matched with every other fifth: this closes loops
PAIRS_AT_ONCE = 50  # pairs of photographs in a transaction of the database
MIN_IMAGES = 3
MIN_PLACED = 10  # photographs from which the principal point is found
MAX_OFF_CENTRE = 0.1  # of the width or the height, between the middle and a principal point that is believed
DIAGONAL = math.hypot(36, 24)  # of a 35 mm film, in millimetres
MIN_UP = 0.1  # of the length of the mean of unit vectors: below, the photographs do not agree on what is up
JPEG_QUALITY = 95
POLL = 0.2  # seconds


@dataclass(frozen=True)
class Picture:
    """One photograph: its file's name, its size in pixels, and its focal length in 35 mm terms, if EXIF has it."""

    name: str
    height: int
    width: int
    focal_35mm: float | None = None

    @property
    def kind(self) -> tuple[int, int, float]:
        """Photographs of one kind share a camera."""
        return self.height, self.width, self.focal_35mm or 0.0


@dataclass(frozen=True)
class Database:
    """COLMAP's database of features and matches, and the folder of the photographs that it describes."""

    path: Path
    images: Path

    def add(self, pictures: Sequence[Picture]) -> None:
        """Adds the photographs that it lacks. Those of one size and focal length share a camera."""
        pycolmap = _pycolmap()
        pycolmap.Database.open(self.path).close()
        for _, group in groupby(sorted(pictures, key=lambda each: each.kind), key=lambda each: each.kind):
            shared = list(group)
            options = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", camera_params=_parameters(shared[0]))
            names = [each.name for each in shared]
            pycolmap.import_images(self.path, self.images, pycolmap.CameraMode.SINGLE, names, options)

    def extract(self, names: Sequence[str], watch: Watch) -> None:
        """Finds the SIFT features of the photographs that have none yet."""
        pycolmap = _pycolmap()
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.sift.peak_threshold = PEAK_THRESHOLD
        options.sift.estimate_affine_shape = True

        def work(token: Any) -> None:
            pycolmap.extract_features(
                self.path,
                self.images,
                list(names),
                extraction_options=options,
                device=pycolmap.Device.cpu,
                cancellation_token=token,
            )

        with pycolmap.Database.open(self.path) as database:
            images = [image.image_id for image in database.read_all_images()]
            _watched(work, lambda: watch(sum(map(database.exists_keypoints, images))))

    def match(self, names: Sequence[str], seed: int, watch: Watch) -> None:
        """Matches the features of pairs that were not matched yet, and verifies the matches by epipolar geometry."""
        pycolmap = _pycolmap()
        listed = self.path.with_name("pairs.txt")
        listed.write_text("".join(f"{one} {other}\n" for one, other in pairs(names)), encoding="utf-8")
        options = pycolmap.FeatureMatchingOptions()
        options.use_gpu = False
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed, block_size=PAIRS_AT_ONCE)
        verification = pycolmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = seed

        def work(token: Any) -> None:
            pycolmap.match_image_pairs(self.path, options, pairing, verification, pycolmap.Device.cpu, token)

        with pycolmap.Database.open(self.path) as database:
            _watched(work, lambda: watch(database.num_matched_image_pairs()))

    def verified_pairs(self) -> int:
        """Returns how many pairs of photographs see something in common."""
        with _pycolmap().Database.open(self.path) as database:
            _, inliers = database.read_two_view_geometry_num_inliers()
            return sum(count >= MIN_INLIERS for count in inliers)

    def place(self, folder: Path, count: int, seed: int, watch: Watch) -> Any | None:
        """Returns the largest reconstruction that incremental mapping finds, or None; models go to `folder`."""
        pycolmap = _pycolmap()
        emptied(folder)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = seed
        options.min_model_size = min(options.min_model_size, max(MIN_IMAGES, count // 2))
        options.mapper.abs_pose_min_num_inliers = MIN_INLIERS
        placed = [0]

        def begin() -> None:
            placed[0] = 2

        def advance() -> None:
            placed[0] += 1

        def work(token: Any) -> dict[int, Any]:
            return pycolmap.incremental_mapping(
                self.path,
                self.images,
                folder,
                options,
                initial_image_pair_callback=begin,
                next_image_callback=advance,
                cancellation_token=token,
            )

        models = _watched(work, lambda: watch(min(placed[0], count))).values()
        return max(models, key=lambda model: model.num_reg_images(), default=None)


def pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Returns the pairs to match: all of few photographs, else neighbours and those that may close a loop."""
    if len(names) <= MAX_EXHAUSTIVE:
        return list(combinations(names, 2))
    numbers = combinations(range(len(names)), 2)
    near = {(i, j) for i, j in numbers if j - i <= NEIGHBOURS or (i % LOOP_PERIOD == 0 and j % LOOP_PERIOD == 0)}
    return [(names[i], names[j]) for i, j in sorted(near)]


def with_principal_points(model: Any) -> Any:
    """Returns a reconstruction adjusted once more, with the principal points free.

    Few photographs do not tell where they are: then, and where one leaves the middle of the image, the model stays.
    """
    pycolmap = _pycolmap()
    if model.num_reg_images() < MIN_PLACED:
        return model
    adjusted = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    config = pycolmap.BundleAdjustmentConfig()
    for image in adjusted.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    adjuster = pycolmap.create_default_bundle_adjuster(options, config, adjusted)
    _watched(lambda _: adjuster.solve(), lambda: None)
    for camera in adjusted.cameras.values():
        off = (camera.principal_point_x / camera.width - 0.5, camera.principal_point_y / camera.height - 0.5)
        if max(map(abs, off)) > MAX_OFF_CENTRE:
            return model
    adjusted.update_point_3d_errors()
    return adjusted


def upright(model: Any) -> None:
    """Turns a reconstruction so that y is up: the mean of what is up in the photographs."""
    from scipy.spatial.transform import Rotation

    pycolmap = _pycolmap()
    poses = [image.cam_from_world().inverse().matrix() for image in model.images.values() if image.has_pose]
    up = -np.mean([pose[:, 1] for pose in poses], axis=0)
    if np.linalg.norm(up) < MIN_UP:
        return
    rotation = Rotation.align_vectors([[0, 1, 0]], [up])[0]
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(rotation.as_quat()), np.zeros(3)))


def undistort(model: Any, images: Path, out: Path, masks: Path | None = None) -> None:
    """Writes undistorted photographs to `out/images`, masks to `out/masks`, and pinhole cameras to `out/sparse/0`."""
    model_folder = emptied(out / "distorted")
    model.write(model_folder)
    made = _undistorted(model_folder, images, out / "made")
    emptied(out / "sparse")
    (made / "sparse").rename(out / "sparse" / "0")
    shutil.rmtree(out / "images", ignore_errors=True)
    (made / "images").rename(out / "images")
    if masks is not None:
        shutil.rmtree(out / "masks", ignore_errors=True)
        (_undistorted(model_folder, masks, out / "made") / "images").rename(out / "masks")
    shutil.rmtree(made)
    shutil.rmtree(model_folder)


def _undistorted(model_folder: Path, images: Path, made: Path) -> Path:
    pycolmap = _pycolmap()
    emptied(made)

    def work(token: Any) -> None:
        pycolmap.undistort_images(made, model_folder, images, jpeg_quality=JPEG_QUALITY, cancellation_token=token)

    _watched(work, lambda: None)
    return made


def _pycolmap() -> Any:
    """The library, whose log is silent: its errors are exceptions."""
    require("finding cameras", "pycolmap")
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    return pycolmap


def _parameters(picture: Picture) -> str:
    """Focal length, principal point and distortion, as COLMAP reads them; empty where EXIF has no focal length."""
    if picture.focal_35mm is None:
        return ""
    focal = picture.focal_35mm / DIAGONAL * math.hypot(picture.height, picture.width)
    return f"{focal}, {picture.width / 2}, {picture.height / 2}, 0"


def _watched(work: Callable[[Any], T], watch: Callable[[], None]) -> T:
    """Runs work in another thread, so that Ctrl-C is noticed: it cancels the work, and waits for its end."""
    token = _pycolmap().CancellationToken()
    with ThreadPoolExecutor(1) as pool:
        future = pool.submit(work, token)
        try:
            while not wait([future], timeout=POLL).done:
                watch()
        except BaseException:
            token.cancel()
            raise
        result = future.result()
    watch()
    return result
