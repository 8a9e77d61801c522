"""A folder of photographs with known cameras, in any of five layouts, brought into the frame of the unit sphere."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float

from distrace.camera import Camera
from distrace.data.checks import check_intrinsics
from distrace.data.photo_readers import colmap, idr, middlebury, own, transforms
from distrace.data.photo_readers.frames import Frame, inside
from distrace.data.photograph import Photograph as Photograph
from distrace.data.photograph import Source
from distrace.data.pictures import read_mask, read_picture
from distrace.data.space_carving import within_masks
from distrace.data.unit_sphere import UnitSphere as UnitSphere
from distrace.data.unit_sphere import among_points, between_axes
from distrace.errors import about
from distrace.files import save_json
from distrace.pixels import thinned
from distrace.rays import meet_sphere
from distrace.shading import colour_picture, save_png

LAYOUTS = (own, transforms, idr, middlebury, colmap)
LOOKED_FOR = (
    "views.json, transforms.json, transforms_train.json, cameras_sphere.npz, *_par.txt, and COLMAP's cameras.bin or"
    " cameras.txt in sparse/0, sparse and the folder itself"
)
MAX_SHARE_BEYOND = 0.05  # of the masks' pixels: with more, the unit sphere is smaller than the object
MAX_PIXELS = 20_000  # pixels of a mask that are examined
MAX_WHITE_SHARE = 0.9  # of the pixels: with so many at full white, colour tells nothing


@dataclass(frozen=True)
class Photographs:
    """Views of one object in the unit sphere, and how that lies in the world of their folder."""

    views: tuple[Photograph, ...]
    unit_sphere: UnitSphere
    layout: str
    sphere_known: bool = False  # whether the folder says where the unit sphere lies


def load_photographs(folder: Path, least: int = 2) -> Photographs:
    """Reads the photographs of a folder, in whichever layout it has; fewer than two need a `unit_sphere` there.

    Raises `ValueError`, in one sentence that names file and field, for what is missing or makes no sense.
    """
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}")
    frames = next((found for layout in LAYOUTS if (found := layout.read(folder)) is not None), None)
    if frames is None:
        raise ValueError(f"{folder} holds no photographs with cameras; looked for {LOOKED_FOR}")
    if len(frames.views) < (2 if frames.unit_sphere is None else least):
        raise ValueError(f"{folder}: its {frames.layout} describes {len(frames.views)} views; at least two are needed")
    names = _distinct([frame.image.stem for frame in frames.views])
    views = [replace(_photograph(frame), name=name) for frame, name in zip(frames.views, names)]
    masks = [view.mask for view in views if view.mask is not None]
    with about(folder):
        if len(masks) == len(views) and not any(mask.any() for mask in masks):
            raise ValueError(f"its {len(masks)} masks mark no pixel as object; they are white where the object is")
        unit_sphere = frames.unit_sphere or estimated(views, frames.points)
    placed = []
    for view in views:
        camera = unit_sphere.camera_to_unit(view.camera)
        single = camera.float()
        placed.append(replace(view, camera=single))
    return Photographs(tuple(placed), unit_sphere, frames.layout, frames.unit_sphere is not None)


def save_photographs(folder: Path, photographs: Photographs) -> None:
    """Writes our own layout: `views.json`, and images and masks as PNG of eight bits beside it."""
    entries = []
    names = _distinct([view.name for view in photographs.views])
    for name, view in zip(names, photographs.views):
        entry: dict[str, object] = {"image": f"images/{name}.png"}
        save_png(inside(folder, f"images/{name}.png", "the view"), colour_picture(view.image))
        if view.mask is not None:
            entry["mask"] = f"masks/{name}.png"
            white = view.mask[..., None].expand(-1, -1, 3).float()
            save_png(folder / "masks" / f"{name}.png", colour_picture(white))
        double = replace(view.camera, T_world_camera=view.camera.T_world_camera.double())
        entry["intrinsics"] = view.camera.intrinsics.tolist()
        entry["T_world_camera"] = photographs.unit_sphere.camera_to_world(double).T_world_camera.tolist()
        entries.append(entry)
    save_json(folder / own.NAME, {"views": entries, "unit_sphere": photographs.unit_sphere.described()})


def estimated(views: Sequence[Photograph], points: Float[np.ndarray, "points 3"] | None = None) -> UnitSphere:
    """Returns the sphere around the masks if two views have one, else around known points, else where cameras look.

    Raises `ValueError` where none of these tells.
    """
    masked = [(view.camera, view.mask) for view in views if view.mask is not None and view.mask.any()]
    if len(masked) >= 2:
        return within_masks(*zip(*masked))
    among = None if points is None else among_points(points)
    return among or between_axes([view.camera for view in views])


def notes(photographs: Photographs) -> list[str]:
    """Returns sentences about views that can be used but look wrong."""
    found = []
    shares_beyond = []  # of each mask's pixels, those whose rays miss the unit sphere
    for view in photographs.views:
        found += [f"{view.name} {remark}" for remark in _remarks(view)]
        if view.mask is not None and view.mask.any():
            rays = view.camera.rays(view.camera.pixels()[thinned(view.mask, MAX_PIXELS)])
            shares_beyond.append(meet_sphere(rays).near.isinf().double().mean().item())
    beyond = float(np.median(shares_beyond)) if shares_beyond else 0.0
    if beyond > MAX_SHARE_BEYOND:
        found.append(f"{beyond:.0%} of the object in the masks lies beyond the unit sphere; give a larger radius")
    return found


def _distinct(names: Sequence[str]) -> list[str]:
    """Returns the names; with numbers before them where two are the same, as in folders of several cameras."""
    return list(names) if len(set(names)) == len(names) else [f"{k:03d}_{name}" for k, name in enumerate(names)]


def _photograph(frame: Frame) -> Photograph:
    with about(frame.field):
        image, mask = read_picture(frame.image)
        mask = mask if frame.mask is None else read_mask(frame.mask)
        height, width = image.shape[:2]
        if frame.size not in (None, (height, width)):
            stated = f"{frame.size[0]} × {frame.size[1]}"
            raise ValueError(f"{frame.image} has {height} × {width} pixels, and the camera's image {stated}")
        if mask is not None and mask.shape != image.shape[:2]:
            other = f"{mask.shape[0]} × {mask.shape[1]}"
            raise ValueError(f"{frame.mask} has {other} pixels, and its image {frame.image.name} {height} × {width}")
        matrices = torch.from_numpy(frame.intrinsics), torch.from_numpy(frame.T_world_camera)
        camera = Camera.from_matrices(*matrices, height, width)
        check_intrinsics(camera)
    return Photograph(frame.image.stem, camera, image, mask, Source(frame.image, camera, frame.mask))


def _remarks(view: Photograph) -> list[str]:
    found: list[str] = []
    if (view.image == view.image[0, 0]).all():
        found.append("is of one colour all over; is its file whole?")
    elif (white := (view.image >= 1).all(-1).float().mean()) > MAX_WHITE_SHARE:
        found.append(f"is fully white at {white:.0%} of its pixels; it is over-exposed, or nothing but background")
    if view.mask is not None and not view.mask.any():
        found.append("has a mask that marks no pixel as object")
    if view.mask is not None and view.mask.all():
        found.append("has a mask that marks every pixel as object")
    if view.camera.T_world_camera[:3, 3].norm() <= 1:
        found.append("was taken from within the unit sphere, where the object is; give a smaller unit_sphere")
    elif not view.camera.shows(*view.camera.project(view.camera.T_world_camera.new_zeros(3))):
        found.append("does not show the middle of the unit sphere; is its camera right?")
    return found
