"""What a sensor saw of an object, in the sensor's frame and unit: points of its surface, and space that is free."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.cloud import Cloud, read_points
from distrace.data.depth_image import KINDS, load_depth_image, load_intrinsics, load_mask
from distrace.data.observation import View, read_scene
from distrace.data.points import LEAST_POINTS, noise_of, object_points, radius_of, thinned
from distrace.data.up import GIVEN_TILT, Floor, Up, find_floor, rays_below
from distrace.errors import about
from distrace.rays import Rays

CLOUDS = (".ply", ".pcd", ".xyz", ".obj", ".off", ".stl", ".glb")
MOST_RAYS = 6_000
CROP = 0.5  # of the object's size in the image, around it, where rays tell what is free
CLEAN = 0.05  # share of the background's pixels with a depth: with fewer, the mask alone tells what is background
BACKGROUND = 0.2  # radii behind the farthest point of the object: there nothing of it is
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
        chosen = torch.randperm(len(self.points), generator=torch.Generator().manual_seed(seed))[:count]
        return replace(self, points=self.points[chosen])


@dataclass(frozen=True)
class ScanOptions:
    """What a user says about an input; None where nothing is said."""

    up: str | None = None  # an axis of `AXES`, or `unknown`
    intrinsics: str | None = None
    mask: Path | None = None
    box: tuple[int, int, int, int] | None = None  # left, top, right, bottom, in pixels


def load_scan(paths: Sequence[Path], options: ScanOptions = ScanOptions()) -> Scan:
    """Reads a depth image, observations of one object by cameras in one world, or clouds.

    Up is by default −y for a depth image, whose y points down, and y for everything else.
    Raises `ValueError`, in one sentence, for what cannot be read or does not fit together.
    """
    return joined([_load(path, options) for path in paths])


def joined(scans: Sequence[Scan]) -> Scan:
    """Returns several scans of one object in one frame as one."""
    points = torch.cat([scan.points for scan in scans])
    free = Rays.cat([scan.free for scan in scans])
    hits = Rays.cat([scan.hits for scan in scans])
    free_until = torch.cat([scan.free_until for scan in scans])
    noise = float(np.mean([scan.noise for scan in scans]))
    views = tuple(view for scan in scans for view in scan.views)
    first = scans[0]
    return Scan(thinned(points), free, free_until, hits, noise, first.ups, first.tilt, views)


def scan_of_view(scene: View, mask: Bool[Tensor, "height width"] | None, up: Up, isolate: bool = False) -> Scan:
    """Returns the scan of the object that a mask marks in a depth image; without a mask, of all that has a depth.

    Separate pieces are left out. `isolate`: the mask holds other things, too, as a rectangle does; so is the floor.
    The plane that the object stands on, where it is seen, tells up better than the user.
    Raises `ValueError` where hardly any pixel of the object has a depth.
    """
    inside = scene.seen if mask is None else scene.seen & mask
    _check_count(int(inside.sum()))
    around = _around(inside)
    floor = None if up.direction is None else find_floor(thinned(scene.masked(around).points()), up)
    if floor is not None:
        up = Up(floor.normal, floor.normal[None], GIVEN_TILT)
    points = scene.masked(inside).points()
    kept = object_points(points, floor, 1.0) if isolate else object_points(points, None)
    pixels = inside.nonzero()[~kept]
    inside = inside.index_put((pixels[:, 0], pixels[:, 1]), torch.tensor(False))
    mask = None if isolate else mask
    behind = ~inside & _behind(scene, points[kept], inside, floor)
    free = scene.seen
    hits = torch.zeros_like(free)
    if mask is not None:
        behind &= ~mask
        if (scene.seen & ~mask).sum() < CLEAN * (~mask).sum():
            free = free | ~mask
            hits = mask & ~scene.seen
    depth = scene.depth.masked_fill(behind, torch.inf)
    view = View(scene.camera, scene.depth.masked_fill(~inside, torch.inf), mask)
    rays, until, hit_rays = _rays(scene.camera, depth, free & around, hits)
    if floor is not None:
        below = rays_below(floor, points[kept])
        rays = Rays.cat([rays, below])
        until = torch.cat([until, torch.full((len(below.origins),), torch.inf)])
    return _scan(points[kept], rays, until, hit_rays, up, (view,))


def _behind(
    scene: View, points: Float[Tensor, "n 3"], inside: Bool[Tensor, "height width"], floor: Floor | None
) -> Bool[Tensor, "height width"]:
    """Where the floor is seen, or something behind the object: nothing of the object is behind that."""
    farthest = float(scene.depth[inside].quantile(0.98)) + BACKGROUND * radius_of(points)
    found = scene.seen & (scene.depth > farthest)
    if floor is not None:
        height = torch.full_like(scene.depth, torch.inf)
        height[scene.seen] = scene.points() @ floor.normal - floor.height
        found |= height.abs() < floor.thickness
    return found


def _rays(
    camera: Camera, depth: Tensor, free: Bool[Tensor, "height width"], hits: Bool[Tensor, "height width"]
) -> tuple[Rays, Float[Tensor, "m"], Rays]:
    """Returns the rays that are free up to a depth, and those that hit."""
    chosen = thinned(free.nonzero(), MOST_RAYS)
    pixels = camera.pixels()[chosen[:, 0], chosen[:, 1]]
    until = depth[chosen[:, 0], chosen[:, 1]] / camera.cosines(pixels)
    chosen = thinned(hits.nonzero(), MOST_RAYS)
    return camera.rays(pixels), until, camera.rays(camera.pixels()[chosen[:, 0], chosen[:, 1]])


def scan_of_points(points: Float[Tensor, "n 3"], up: Up) -> Scan:
    """Returns the scan of a cloud, of which nobody says from where it was seen. Raises `ValueError` for few points."""
    _check_count(len(points))
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


def _load(path: Path, options: ScanOptions) -> Scan:
    kind = path.suffix.lower()
    if kind not in KINDS:
        _refuse(path, "is a depth image's", intrinsics=options.intrinsics)
    if kind in CLOUDS:
        _refuse(path, "is an image's", mask=options.mask, box=options.box)
        points = torch.from_numpy(read_points(path)).float()
        with about(path):
            return scan_of_points(points, Up.along(options.up or "y"))
    if kind not in KINDS:
        scene, mask = read_scene(path)
        up = Up.along(options.up or "y")
    elif options.intrinsics is None:
        raise ValueError(f"{path} is a depth image, and needs --intrinsics: fx,fy,cx,cy in pixels, or a file")
    else:
        depth = load_depth_image(path)
        scene, mask = View(load_intrinsics(options.intrinsics, depth.shape[0], depth.shape[1]), depth), None
        up = Up.along(options.up) if options.up else Up.of_camera()
    with about(path):
        return _scan_of_image(scene, mask, options, up)


def _refuse(path: Path, whose: str, **given: object) -> None:
    """Raises `ValueError` for an option that says nothing about such a file."""
    for name, value in given.items():
        if value is not None:
            raise ValueError(f"--{name} was given for {path}, and {whose} alone; leave it out")


def _scan_of_image(scene: View, mask: Bool[Tensor, "height width"] | None, options: ScanOptions, up: Up) -> Scan:
    height, width = scene.depth.shape
    if options.mask is not None:
        mask = load_mask(options.mask, height, width)
    if options.box is None:
        return scan_of_view(scene, mask, up, isolate=mask is None)
    left, top, right, bottom = options.box
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        given = f"--box {left} {top} {right} {bottom}"
        raise ValueError(f"{given} was given; left < right and top < bottom must lie within {width} × {height} pixels")
    within = torch.zeros(height, width, dtype=torch.bool)
    within[top:bottom, left:right] = True
    return scan_of_view(scene, within if mask is None else within & mask, up, isolate=mask is None)


def _scan(points: Tensor, free: Rays, free_until: Tensor, hits: Rays, up: Up, views: tuple[View, ...]) -> Scan:
    """Leaves out what is far from everything, and tells the noise."""
    points = thinned(points)
    away = (points - points.median(0).values).norm(dim=-1)
    points = points[away <= FAR_OUTLIER * radius_of(points)]
    if not float((points - points[0]).norm(dim=-1).max()) > 0:
        raise ValueError(f"all of its {len(points)} points are in one place")
    return Scan(points, free, free_until, hits, noise_of(points), up.candidates, up.tilt, views)


def _check_count(count: int) -> None:
    if count < LEAST_POINTS:
        raise ValueError(f"{count} points of the object are known; at least {LEAST_POINTS} are needed")


def _around(inside: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """The pixels of a box about those that are inside."""
    found = torch.zeros_like(inside)
    spans = []
    for axis in (1, 0):
        occupied = inside.any(axis).nonzero()[:, 0]
        margin = int(CROP * (occupied[-1] - occupied[0] + 1)) + 1
        spans.append(slice(max(int(occupied[0]) - margin, 0), int(occupied[-1]) + margin + 1))
    found[spans[0], spans[1]] = True
    return found
