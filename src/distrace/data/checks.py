"""Plausibility of an observation of a shape in the unit sphere, and hints at what was probably meant instead."""

import warnings
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.errors import DoubtfulResult
from distrace.pixels import thinned

MAX_FIELD_OF_VIEW = 160.0  # degrees: largest field of view of a pinhole camera
MAX_FOCAL_RATIO = 4.0  # largest ratio of the two focal lengths
OTHER_RESOLUTION = 1.8  # times: intrinsics with a principal point that far beyond the middle are of another resolution
OFF_CENTRE = 0.2  # of an image: a principal point that far from the middle may be of another resolution …
MAX_LOG_RATIO = 0.1  # … if it is about as far along both sides: the logarithm of the ratio
MIN_DEPTH_RATIO = 0.02  # least share of depths within a mask, relative to that beyond it
MAX_MEDIAN_RADIUS = 1.2  # radii: largest median distance from the origin of a shape in the unit sphere
MAX_PIXELS = 100_000  # pixels that are examined


def check_intrinsics(camera: Camera) -> None:
    """Raises `ValueError` where they are no pinhole camera's of this image; warns where they may be another image's."""
    size = camera.intrinsics.new_tensor([camera.width, camera.height])
    across = camera.intrinsics
    (fx, fy) = across.diagonal()[:2].tolist()
    middle = across[:2, 2] / size
    image = f"an image of {camera.height} × {camera.width} pixels"
    angle = torch.rad2deg(2 * torch.atan(camera.width / (2 * across[0, 0]))).item()
    if angle > MAX_FIELD_OF_VIEW:
        raise ValueError(f"a focal length of {fx:.4g} pixels sees {angle:.0f}° in {image}; intrinsics are in pixels")
    if not 1 / MAX_FOCAL_RATIO < fx / fy < MAX_FOCAL_RATIO:
        raise ValueError(f"focal lengths of {fx:.4g} and {fy:.4g} pixels were given; they cannot differ so much")
    if (middle[0] / middle[1]).log().abs() < MAX_LOG_RATIO and (middle - 0.5).abs().min() > OFF_CENTRE:
        point = " × ".join(f"{2 * length:.4g}" for length in across[:2, 2].flip(0).tolist())
        sentence = f"the intrinsics are for an image of {point} pixels, and this is {image}; scale them with it"
        if middle.min() > OTHER_RESOLUTION / 2:
            raise ValueError(sentence)
        warnings.warn(f"if this is no part of an image, {sentence}", DoubtfulResult, stacklevel=4)


def check_mask(mask: Bool[Tensor, "height width"], seen: Bool[Tensor, "height width"]) -> None:
    """Raises `ValueError` where almost all depths are of the background."""
    if not seen.any():
        return
    within = (seen & mask).sum().item()
    beyond = (seen & ~mask).sum().item()
    inside = mask.sum().item()
    outside = (~mask).sum().item()
    if not inside:
        raise ValueError(f"mask marks no pixel as object, but {beyond} have a depth; mark the object, or leave it out")
    if within / inside < MIN_DEPTH_RATIO * beyond / max(outside, 1):
        raise ValueError(
            f"mask marks {inside} pixels as object, of which {within} have a depth, as have {beyond} of the {outside}"
            " others; is it inverted, or of another image?"
        )


def check_normals(camera: Camera, normal: Float[Tensor, "height width 3"]) -> None:
    """Raises `ValueError` where most of what is seen turns its back to the camera."""
    known = thinned(normal.any(-1), MAX_PIXELS)
    directions = camera.rays(camera.pixels()[known]).directions
    facing = ((normal[known] * directions).sum(-1) < 0).float().mean()
    if facing < 0.5:
        raise ValueError(
            f"normal points away from the camera at {1 - facing:.0%} of the pixels; it points out of the shape, in the"
            " axes of the world, not of the camera"
        )


def check_place(camera: Camera, depth: Float[Tensor, "height width"], observed: Bool[Tensor, "height width"]) -> None:
    """Raises `ValueError` where what was observed is not in the unit sphere, or the camera does not see that."""
    chosen = thinned(depth.isfinite() if depth.isfinite().any() else observed, MAX_PIXELS)
    pixels = camera.pixels()[chosen]
    depth = depth[chosen]
    away = _away(camera, pixels, depth)
    if away <= MAX_MEDIAN_RADIUS:
        return
    what = "its points lie" if depth.isfinite().any() else "the rays of the object pass"
    there = camera.T_world_camera[:3, 3].norm()
    raise ValueError(
        f"{what} {away:.3g} from the origin in the median, and the camera {there:.3g}, but the shape must be in the"
        f" unit sphere around the origin; {_hint(camera, pixels, depth)}"
    )


def _away(camera: Camera, pixels: Float[Tensor, "n 2"], depth: Float[Tensor, "n"]) -> float:
    """Median distance from the origin of the points, or of the rays where there is no depth."""
    rays = camera.rays(pixels)
    nearest = -(rays.origins * rays.directions).sum(-1).clamp_max(0)
    distance = torch.where(depth.isfinite(), depth / camera.cosines(pixels), nearest)
    return rays.at(distance).norm(dim=-1).median().item()


def _hint(camera: Camera, pixels: Float[Tensor, "n 2"], depth: Float[Tensor, "n"]) -> str:
    """The most plausible mistake, if one explains the observation."""
    away, hint = min((_away(other, pixels, depth), hint) for hint, other in _corrected(camera).items())
    if away <= MAX_MEDIAN_RADIUS:
        return hint
    if not depth.isfinite().any():
        return "T_world_camera maps camera axes (x right, y down, z forward) to the world: turn it to the shape"
    return (
        f"depth ({depth.median():.4g} in the median) and T_world_camera must be in the units of the unit sphere (metres"
        " or millimetres need scaling), and a background needs a mask"
    )


def _corrected(camera: Camera) -> dict[str, Camera]:
    """Returns the camera after each of the usual mistakes is undone, by the sentence that names the mistake."""
    pose = camera.T_world_camera
    inverse = torch.linalg.inv(pose)
    opengl = torch.diag(pose.new_tensor([1, -1, -1, 1]))
    found = {}
    for mistake, right in (
        ("the inverse, T_camera_world", inverse),
        ("in OpenGL's axes", pose @ opengl),
        ("the inverse in OpenGL's axes", inverse @ opengl),
    ):
        sentence = (
            f"T_world_camera seems to be {mistake}: it maps camera axes (x right, y down, z forward) to the world"
        )
        found[sentence] = replace(camera, T_world_camera=right)
    centred = camera.intrinsics.clone()
    centred[:2, 2] = centred.new_tensor([camera.width, camera.height]) / 2
    sentence = "the intrinsics seem to be of another image: look at the principal point"
    found[sentence] = replace(camera, intrinsics=centred)
    return found
