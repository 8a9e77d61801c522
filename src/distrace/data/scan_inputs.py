"""Reads the files that a user gives of an object: depth images with cameras, observations, clouds of points."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from distrace.data.cloud import read_points
from distrace.data.depth_image import KINDS, load_depth_image, load_intrinsics, load_mask, load_pose
from distrace.data.observation import View, read_scene
from distrace.data.scan import Scan, joined, scan_of_object, scan_of_points
from distrace.data.segmented_view import SegmentedView, find_object, find_object_again
from distrace.data.up import Up
from distrace.errors import DoubtfulResult, about

CLOUDS = (".ply", ".pcd", ".xyz", ".obj", ".off", ".stl", ".glb")
DEPTH_IMAGE = "a depth image"
CLOUD = "a cloud"
OBSERVATION = "an observation"
Image = tuple[View, Bool[Tensor, "height width"] | None, Up]
"""All that an image shows, the mask in its file, and up."""


@dataclass(frozen=True)
class ScanOptions:
    """What a user says about the inputs; None where nothing is said. Mask and box are of the first image."""

    up: str | None = None  # an axis of `AXES`, or `unknown`
    intrinsics: str | None = None
    mask: Path | None = None
    box: tuple[int, int, int, int] | None = None  # left, top, right, bottom, in pixels
    poses: tuple[Path, ...] = ()  # camera to world, of each depth image


def load_scan(paths: Sequence[Path], options: ScanOptions = ScanOptions()) -> Scan:
    """Reads depth images or observations of one object by cameras in one world, or clouds in one frame.

    Images after the first that have no mask of their own give the points near those of the first, and their free rays.
    Up is by default −y of the first camera for depth images, whose y points down, and y for everything else.
    Raises `ValueError`, in one sentence, for what cannot be read or does not fit together.
    """
    kind = _kind_of_all(paths)
    if kind == CLOUD:
        _refuse(paths[0], "is an image's", mask=options.mask, box=options.box)
    if kind != DEPTH_IMAGE:
        _refuse(paths[0], "is a depth image's", intrinsics=options.intrinsics, poses=options.poses or None)
    if kind == CLOUD:
        return joined([_read_cloud(path, options) for path in paths])
    if kind == DEPTH_IMAGE:
        poses = _poses(paths, options.poses)
        return _scan_of_images(paths, [_read_depth_image(*each, options) for each in zip(paths, poses)], options)
    return _scan_of_images(paths, [(*read_scene(path), Up.along(options.up or "y")) for path in paths], options)


def assumed_up(paths: Sequence[Path]) -> str:
    """Returns which axis `load_scan` takes to point up where nobody says."""
    return "about -y of the first camera" if _kind_of_all(paths) == DEPTH_IMAGE else "y"


def _kind_of_all(paths: Sequence[Path]) -> str:
    """Returns what all inputs are. Raises `ValueError` where there are none, or of several kinds."""
    if not paths:
        raise ValueError("no input was given; give a depth image, an observation or a cloud of points")
    first_of_kind: dict[str, Path] = {}
    for path in paths:
        suffix = path.suffix.lower()
        kind = DEPTH_IMAGE if suffix in KINDS else CLOUD if suffix in CLOUDS else OBSERVATION
        first_of_kind.setdefault(kind, path)
    if len(first_of_kind) > 1:
        given = " and ".join(f"{path} ({kind})" for kind, path in first_of_kind.items())
        raise ValueError(
            f"{given} were given together; give inputs of one kind: depth images with --poses, observations of one"
            " world, or clouds in one frame"
        )
    return next(iter(first_of_kind))


def _scan_of_images(paths: Sequence[Path], images: Sequence[Image], options: ScanOptions) -> Scan:
    """Finds the object in the first image, and again in the others."""
    scans = []
    first: SegmentedView | None = None
    for path, (scene, mask, up) in zip(paths, images):
        with about(path):
            if first is None:
                found = first = _find_first(scene, mask, options, up)
            elif mask is not None:
                found = find_object(scene, mask, up, isolate=False)
            else:
                found = find_object_again(first, scene)
        if found is None:
            sentence = f"{path} shows hardly a point near the object of the first image, and is left out"
            warnings.warn(sentence, DoubtfulResult, stacklevel=3)
        else:
            scans.append(scan_of_object(found))
    return joined(scans)


def _poses(images: Sequence[Path], poses: Sequence[Path]) -> Sequence[Path | None]:
    """Returns the pose of each depth image. Raises `ValueError` for any other number of them."""
    if not poses and len(images) == 1:
        return [None]
    if not poses:
        raise ValueError(
            f"{len(images)} depth images were given without --poses: a file for each, in the same order, with the 4 × 4"
            " matrix that maps its camera to the world"
        )
    if len(poses) != len(images):
        raise ValueError(
            f"--poses names {len(poses)} files for {len(images)} depth images; give one for each, in the same order"
        )
    return poses


def _read_depth_image(path: Path, pose: Path | None, options: ScanOptions) -> Image:
    if options.intrinsics is None:
        raise ValueError(f"{path} is a depth image, and needs --intrinsics: fx,fy,cx,cy in pixels, or a file")
    depth = load_depth_image(path)
    camera = load_intrinsics(options.intrinsics, depth.shape[0], depth.shape[1])
    if pose is not None:
        camera = replace(camera, T_world_camera=load_pose(pose))
    up = Up.along(options.up) if options.up else Up.of_camera(camera.T_world_camera[:3, :3])
    return View(camera, depth), None, up


def _read_cloud(path: Path, options: ScanOptions) -> Scan:
    points = torch.from_numpy(read_points(path)).float()
    with about(path):
        return scan_of_points(points, Up.along(options.up or "y"))


def _refuse(path: Path, whose: str, **given: object) -> None:
    """Raises `ValueError` for an option that says nothing about such a file."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"--{name} was given for {path}, and {whose} alone; leave it out")


def _find_first(scene: View, mask: Bool[Tensor, "height width"] | None, options: ScanOptions, up: Up) -> SegmentedView:
    """Returns the object that the options tell, or else the mask of the file."""
    height, width = scene.depth.shape
    if options.mask is not None:
        mask = load_mask(options.mask, height, width)
    if options.box is None:
        return find_object(scene, mask, up, isolate=mask is None)
    left, top, right, bottom = options.box
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        given = f"--box {left} {top} {right} {bottom}"
        raise ValueError(f"{given} was given; left < right and top < bottom must lie within {width} × {height} pixels")
    within = torch.zeros(height, width, dtype=torch.bool)
    within[top:bottom, left:right] = True
    return find_object(scene, within if mask is None else within & mask, up, isolate=mask is None)
