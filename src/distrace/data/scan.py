"""What a sensor saw of an object, in the sensor's frame and unit: points of its surface, and space that is free."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.data.points import noise_of, radius_of, random_subset
from distrace.data.segmented_view import SegmentedView, check_count, find_object
from distrace.data.up import GIVEN_TILT, Up, rays_below
from distrace.rays import Rays

MOST_RAYS = 6_000
CLEAN = 0.05  # share of the background's pixels with a depth: with fewer, the mask alone tells what is background
FAR_OUTLIER = 2.0  # × the radius: points farther from the median are no part of the object
NO_RAYS = Rays(torch.empty(0, 3), torch.empty(0, 3))


@dataclass(frozen=True)
class Scan:
    """Points on an object and a few on other things, rays along which nothing lies up to a distance, and rays that hit.

    All are in the frame and the unit of the input. An object's own up is one of the unit vectors `ups`, to `tilt`;
    there are none where up is unknown.
    """

    points: Float[Tensor, "n 3"]
    free: Rays
    free_until: Float[Tensor, "m"]  # distances along them; `inf` where there is nothing at all
    hits: Rays  # which meet the object, nobody says where
    noise: float  # standard deviation of the points about the surface
    ups: Float[Tensor, "k 3"]
    tilt: float = GIVEN_TILT  # standard deviation, in radians
    views: tuple[View, ...] = ()  # cameras, depths and masks of the object alone
    images: tuple[Float[Tensor, "_ _"], ...] = ()  # the depths of each view as they were read, on the CPU

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return self.points.median(0).values

    @property
    def radius(self) -> float:
        """About the distance from the centre within which the object's points lie; a fifth may be others'."""
        return radius_of(self.points)

    def to(self, device: torch.device | str) -> "Scan":
        views = tuple(view.to(device) for view in self.views)
        return replace(
            self,
            points=self.points.to(device),
            free=self.free.to(device),
            hits=self.hits.to(device),
            free_until=self.free_until.to(device),
            ups=self.ups.to(device),
            views=views,
        )

    def sparse(self, count: int, seed: int = 0) -> "Scan":
        """Returns the scan with at most `count` of its points, drawn at random."""
        return replace(self, points=random_subset(self.points, count, seed))


def joined(scans: Sequence[Scan]) -> Scan:
    """Returns several scans of one object in one frame as one. Its noise is also the scans' disagreement."""
    if len(scans) == 1:
        return scans[0]
    points = random_subset(torch.cat([scan.points for scan in scans]))
    free = Rays.cat([scan.free for scan in scans])
    hits = Rays.cat([scan.hits for scan in scans])
    free_until = torch.cat([scan.free_until for scan in scans])
    views = tuple(view for scan in scans for view in scan.views)
    images = tuple(image for scan in scans for image in scan.images)
    first = scans[0]
    return Scan(points, free, free_until, hits, noise_of(points), first.ups, first.tilt, views, images)


def scan_of_view(scene: View, mask: Bool[Tensor, "height width"] | None, up: Up, isolate: bool = False) -> Scan:
    """Returns the scan of the object that `find_object` finds in a depth image.

    Raises `ValueError` where hardly any pixel of the object has a depth.
    """
    return scan_of_object(find_object(scene, mask, up, isolate))


def scan_of_object(found: SegmentedView) -> Scan:
    """Returns the points of an object in a depth image, and the rays about them."""
    scene = found.scene
    behind = found.is_behind()
    free = scene.seen
    hits = torch.zeros_like(free)
    if found.mask is not None:
        behind &= ~found.mask
        if (scene.seen & ~found.mask).sum() < CLEAN * (~found.mask).sum():
            free = free | ~found.mask
            hits = found.mask & ~scene.seen
    depth = scene.depth.masked_fill(behind, torch.inf)
    view = View(scene.camera, scene.depth.masked_fill(~found.inside, torch.inf), found.mask)
    rays, until, hit_rays = _rays(scene.camera, depth, free & found.around, hits)
    if found.floor is not None:
        below = rays_below(found.floor, found.points)
        rays = Rays.cat([rays, below])
        until = torch.cat([until, torch.full((len(below.origins),), torch.inf)])
    return replace(_scan(found.points, rays, until, hit_rays, found.up, (view,)), images=(scene.depth.cpu(),))


def _rays(
    camera: Camera, depth: Tensor, free: Bool[Tensor, "height width"], hits: Bool[Tensor, "height width"]
) -> tuple[Rays, Float[Tensor, "m"], Rays]:
    """Returns the rays that are free up to a depth, and those that hit."""
    chosen = random_subset(free.nonzero(), MOST_RAYS)
    pixels = camera.pixels()[chosen[:, 0], chosen[:, 1]]
    until = depth[chosen[:, 0], chosen[:, 1]] / camera.cosines(pixels)
    chosen = random_subset(hits.nonzero(), MOST_RAYS)
    return camera.rays(pixels), until, camera.rays(camera.pixels()[chosen[:, 0], chosen[:, 1]])


def scan_of_points(points: Float[Tensor, "n 3"], up: Up) -> Scan:
    """Returns the scan of a cloud, of which nobody says from where it was seen. Raises `ValueError` for few points."""
    check_count(len(points))
    return _scan(points, NO_RAYS, points.new_empty(0), NO_RAYS, up, ())


def canonical_scan(seen: View | Cloud) -> Scan:
    """Returns what was seen of a shape that lies as the model's do; it may be a silhouette alone."""
    up = Up.along("y").candidates
    if isinstance(seen, Cloud):
        return Scan(seen.points, NO_RAYS, torch.empty(0), NO_RAYS, noise_of(seen.points), up)
    points = seen.points()
    free = seen.seen if seen.mask is None else seen.seen | ~seen.mask
    hits = torch.zeros_like(free) if seen.mask is None else seen.mask & ~seen.seen
    return Scan(points, *_rays(seen.camera, seen.depth, free, hits), noise_of(points), up, views=(seen,))


def _scan(points: Tensor, free: Rays, free_until: Tensor, hits: Rays, up: Up, views: tuple[View, ...]) -> Scan:
    """Leaves out what is far from everything, and tells the noise."""
    points = random_subset(points)
    away = (points - points.median(0).values).norm(dim=-1)
    points = points[away <= FAR_OUTLIER * radius_of(points)]
    if not float((points - points[0]).norm(dim=-1).max()) > 0:
        raise ValueError(f"all of its {len(points)} points are in one place")
    return Scan(points, free, free_until, hits, noise_of(points), up.candidates, up.tilt, views)
