"""Which pixels of a depth image are the object's, in one view and again in further views of the same world."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.observation import View
from distrace.data.points import LEAST_POINTS, object_points, radius_of, random_subset
from distrace.data.up import GIVEN_TILT, Floor, Up, find_floor
from distrace.pixels import rectangle_around

CROP = 0.5  # of the object's size in the image, around it, where rays tell what is free
BACKGROUND = 0.2  # radii behind the farthest point of the object: there nothing of it is
REACH = 0.1  # radii: a further view's points that near to the object are its own, besides the drift of poses
MOST_CONTRADICTIONS = 0.3  # of a further view's points where the first view shows the object: those before it


@dataclass(frozen=True)
class SegmentedView:
    """A depth image with all that it shows, and the object's pixels in it."""

    scene: View
    inside: Bool[Tensor, "height width"]  # the object's pixels, of those with a depth
    around: Bool[Tensor, "height width"]  # a rectangle about the object, where rays tell what is free
    mask: Bool[Tensor, "height width"] | None  # all of the object's pixels, where they are known
    floor: Floor | None
    up: Up

    @cached_property
    def points(self) -> Float[Tensor, "n 3"]:
        """The object's points, in the world."""
        return self.scene.masked(self.inside).points()

    def is_behind(self) -> Bool[Tensor, "height width"]:
        """Where the floor is seen, or something behind the object: nothing of the object is behind that."""
        scene = self.scene
        farthest = float(scene.depth[self.inside].quantile(0.98)) + BACKGROUND * radius_of(self.points)
        found = scene.seen & (scene.depth > farthest)
        if self.floor is not None:
            height = torch.full_like(scene.depth, torch.inf)
            height[scene.seen] = scene.points() @ self.floor.normal - self.floor.height
            found |= height.abs() < self.floor.thickness
        return found & ~self.inside


def find_object(scene: View, mask: Bool[Tensor, "height width"] | None, up: Up, isolate: bool) -> SegmentedView:
    """Returns the object that a mask marks in a depth image; without a mask, all that has a depth.

    Separate pieces are left out. `isolate`: the mask holds other things, too, as a rectangle does; so is the floor.
    The plane that the object stands on, where it is seen, tells up better than the user.
    Raises `ValueError` where hardly any pixel of the object has a depth.
    """
    inside = scene.seen if mask is None else scene.seen & mask
    check_count(int(inside.sum()))
    around = rectangle_around(inside, _margins)
    floor = None if up.direction is None else find_floor(random_subset(scene.masked(around).points()), up)
    if floor is not None:
        up = Up(floor.normal, floor.normal[None], GIVEN_TILT)
    points = scene.masked(inside).points()
    kept = object_points(points, floor, 1.0) if isolate else object_points(points, None)
    inside = _only(inside, kept)
    return SegmentedView(scene, inside, around, None if isolate else mask, floor, up)


def find_object_again(first: SegmentedView, scene: View) -> SegmentedView | None:
    """Returns the object of a first view in a further one; None where that shows hardly any of it.

    A point belongs to the object if it lies near the points of the first view, and above the floor. It does not if the
    first view shows it beside the object, as part of something else.
    Raises `ValueError` where the two views contradict each other.
    """
    from scipy.spatial import KDTree

    reach = REACH * radius_of(first.points)
    points = scene.points()
    pixels, depths = first.scene.camera.project(points)
    shown = first.scene.camera.shows(pixels, depths)
    columns, rows = pixels[shown].long().unbind(-1)
    ahead = torch.full_like(depths, torch.nan)
    ahead[shown] = first.scene.depth[rows, columns] - depths[shown]
    on_object = torch.zeros_like(shown)
    on_object[shown] = first.inside[rows, columns]
    contradicting = float((ahead[on_object] > reach).float().mean())
    if on_object.sum() >= LEAST_POINTS and contradicting > MOST_CONTRADICTIONS:
        raise ValueError(
            f"{contradicting:.0%} of its points where the first image shows the object lie before that; are the poses"
            " (--poses, or T_world_camera) camera-to-world, in the depths' unit, and in the images' order?"
        )
    near = torch.zeros_like(shown)
    box = (points > first.points.amin(0) - reach) & (points < first.points.amax(0) + reach)
    close = box.all(-1)
    away, _ = KDTree(first.points.double().numpy()).query(points[close].double().numpy(), distance_upper_bound=reach)
    near[close] = torch.from_numpy(away).isfinite()
    near &= on_object | ~(ahead.abs() < reach)
    if first.floor is not None:
        near &= points @ first.floor.normal - first.floor.height > 1.5 * first.floor.thickness
    if near.sum() < LEAST_POINTS:
        return None
    inside = _only(scene.seen, near)
    return SegmentedView(scene, inside, rectangle_around(inside, _margins), None, first.floor, first.up)


def check_count(count: int) -> None:
    """Raises `ValueError` for too few points."""
    if count < LEAST_POINTS:
        raise ValueError(f"{count} points of the object are known; at least {LEAST_POINTS} are needed")


def _margins(length: int) -> tuple[int, int]:
    """Returns how far around an object of a length rays tell what is free, in pixels."""
    margin = int(CROP * length) + 1
    return margin, margin


def _only(pixels: Bool[Tensor, "height width"], chosen: Bool[Tensor, "n"]) -> Bool[Tensor, "height width"]:
    """Returns those of n pixels that are chosen."""
    return pixels.masked_scatter(pixels, chosen)
