"""Masks of an object that was photographed before a dark background: whatever is not the background's colours."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from skimage.filters import gaussian, sobel, threshold_li, threshold_otsu
from skimage.measure import label
from skimage.morphology import dilation, disk, erosion, opening, remove_small_holes, skeletonize
from skimage.segmentation import watershed

from distrace.data.photographs import Photographs
from distrace.data.space_carving import within_masks
from distrace.data.unit_sphere import UnitSphere

MAX_BACKGROUND_BRIGHTNESS = 0.15  # brightness that most pixels along the edges of the images stay below
SAMPLED_PIXELS = 200_000  # pixels that tell the background's colours
MIN_DEVIATION = 1 / 255  # standard deviation of a colour, at least
DIRT_RADIUS = 2  # pixels: parts that are thinner on both sides are dirt, in an image of 640 × 480
MAX_SHADOW_SHARE = 5e-4  # of an image: smaller holes in the object are shadows …
MAX_LIGHT_HOLE_SHARE = 1e-2  # … and so are holes smaller than this, whose median colour is none of the background's
OUTLIER_DISTANCE = 4.03  # standard deviations, beyond which lies one in a thousand of a 3-D Gaussian's draws
SHADOW_DEPTH = 4  # pixels: colours between background and object are shadow deeper within it, and lit cloth elsewhere
OUTLINE_MARGIN = 2  # pixels on each side of an outline, within which its place is where the image changes most


def masked(photographs: Photographs) -> Photographs:
    """Photographs with masks: those that they have, or what stands out from a dark background.

    Where there were some without, and nobody said where the unit sphere is, it is put around what the masks allow.
    Raises `ValueError` where some have no mask and the background is not dark, or nothing stands out from it.
    """
    views = photographs.views
    if all(view.mask is not None for view in views):
        return photographs
    without = [view.name for view in views if view.mask is None]
    bright = [view.image.amax(-1).numpy() for view in views]
    edges = np.concatenate([side for image in bright for side in (image[0], image[-1], image[:, 0], image[:, -1])])
    if np.median(edges) > MAX_BACKGROUND_BRIGHTNESS:
        raise ValueError(
            f"{without[0]} and {len(without) - 1} others have no mask, and their background is not dark: half of the"
            f" pixels along the edges are brighter than {np.median(edges):.2f}; give masks, white where the object is"
        )
    masks = dark_masks([view.image for view in views])
    found = tuple(
        replace(view, mask=mask) if view.mask is None else view for view, mask in zip(views, masks, strict=True)
    )
    empty = [view.name for view in found if not view.known_mask.any()]
    if 2 * len(empty) > len(found):
        raise ValueError(
            f"in {len(empty)} of {len(found)} views, as {empty[0]}, nothing stands out from the dark; give masks"
        )
    photographs = replace(photographs, views=found)
    return photographs if photographs.sphere_known else _placed_again(photographs)


def dark_masks(images: Sequence[Float[torch.Tensor, "_ _ 3"]]) -> list[Bool[torch.Tensor, "_ _"]]:
    """What stands out from the background of all images together: the largest part of each.

    Distances from the mean colour of what is dark are measured in its standard deviations (Mahalanobis, 1936), so that
    cloth that catches some light is still background, for it is grey. What is nearer than Li's threshold (Li and Tam,
    Pattern Recognition Letters 1998) is background, what is farther than Otsu's (1979) is object; between them, and
    about them, for thresholds dilate what is bright, a watershed puts the outline where the image changes most.
    """
    colours = np.concatenate([image.numpy().reshape(-1, 3) for image in images])
    colours = colours[:: -(-len(colours) // SAMPLED_PIXELS)].astype(np.float64)
    bright = colours.max(-1)
    if bright.max() - bright.min() < MIN_DEVIATION:
        raise ValueError(
            f"all {len(images)} images have one brightness, {bright.max():.2f}: nothing stands out; give masks"
        )
    dark = colours[bright < threshold_li(bright)]
    mean = dark.mean(0)
    whiten = np.linalg.inv(np.linalg.cholesky(np.cov(dark.T) + MIN_DEVIATION**2 * np.eye(3)))
    distance = _deviations(colours, mean, whiten)
    low = threshold_li(distance)
    high = max(threshold_otsu(distance), low)
    smooth = (gaussian(image.numpy(), 1.0, channel_axis=-1) for image in images)
    return [torch.from_numpy(_stands_out(_deviations(image, mean, whiten), low, high)) for image in smooth]


def _deviations(colours: np.ndarray, mean: np.ndarray, whiten: np.ndarray) -> np.ndarray:
    """Returns Mahalanobis distances from the background's mean colour."""
    return np.linalg.norm((colours - mean) @ whiten.T, axis=-1)


def _stands_out(distance: np.ndarray, low: float, high: float) -> np.ndarray:
    about, surely = (_largest(distance > threshold) for threshold in (low, high))
    core = erosion(surely, disk(OUTLINE_MARGIN)) | erosion(about, disk(SHADOW_DEPTH))
    core |= skeletonize(surely)  # keeps threads
    markers = np.where(dilation(about, disk(OUTLINE_MARGIN)), 0, 1)
    markers[core] = 2
    return _with_niches(np.asarray(watershed(sobel(distance), markers) == 2), distance)


def _with_niches(mask: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """With the holes that are too small for background, and lighter."""
    holes = remove_small_holes(mask, max_size=round(MAX_LIGHT_HOLE_SHARE * mask.size)) & ~mask
    parts = np.asarray(label(holes, connectivity=1))
    lighter = [hole for hole in range(1, parts.max() + 1) if np.median(distance[parts == hole]) > OUTLIER_DISTANCE]
    return mask | np.isin(parts, lighter)


def _largest(mask: np.ndarray) -> np.ndarray:
    """The largest part, without dirt and with its shadows."""
    parts = np.asarray(label(opening(mask, disk(DIRT_RADIUS))))
    largest = parts == (1 + np.bincount(parts.ravel())[1:].argmax() if parts.any() else -1)
    return np.asarray(remove_small_holes(largest, max_size=round(MAX_SHADOW_SHARE * parts.size)))


def _placed_again(photographs: Photographs) -> Photographs:
    """In the sphere around what the masks allow."""
    views = photographs.views
    before = photographs.unit_sphere
    sphere = within_masks(*zip(*((view.camera, view.known_mask) for view in views if view.known_mask.any())))
    placed = tuple(replace(view, camera=sphere.camera_to_unit(view.camera)) for view in views)
    there = UnitSphere(before.to_world(sphere.centre), before.radius * sphere.radius)
    return replace(photographs, views=placed, unit_sphere=there)
