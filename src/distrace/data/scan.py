"""What a sensor saw of an object, in the sensor's frame and unit: points of its surface, and space that is free."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.cloud import Cloud, read_points
from distrace.data.depth_image import KINDS, load_depth_image, load_intrinsics, load_mask
from distrace.data.observation import View, read_scene
from distrace.errors import about
from distrace.rays import Rays

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "-x": (-1, 0, 0), "-y": (0, -1, 0), "-z": (0, 0, -1)}
CLOUDS = (".ply", ".pcd", ".xyz", ".obj", ".off", ".stl", ".glb")
LEAST_POINTS = 20
MOST_POINTS = 20_000
MOST_RAYS = 6_000
CROP = 0.5  # of the object's size in the image, around it, where rays tell what is free
CLEAN = 0.05  # share of the background's pixels with a depth: with fewer, the mask alone tells what is background
RADIUS_SHARE = 0.8  # of the points are surely the object's: they tell its radius, …
RADIUS_FACTOR = 1.25  # … which is this × their largest distance from the median
BACKGROUND = 0.2  # radii behind the farthest point of the object: there nothing of it is
FAR_OUTLIER = 2.0  # × the radius: points farther from the median are no part of the object
NEIGHBOURS = 16  # of a point, which tell the noise
CELLS = 64  # along the object, at most: pieces of it touch in such cells, …
SPACING = 3.0  # … which are at least so many distances of neighbouring points wide
PIECE_SHARE = 0.2  # of the largest piece's points: so large a piece is another part of the object
PIECE_GAP = 0.05  # of the length of these parts: a small piece that near to them is the object's, too
FLOOR_THICKNESS = 0.02  # of the radius
FLOOR_TILT = 15.0  # degrees
FLOOR_SHARE = 0.05  # of the points, at least
FLOOR_TRIALS = 300
FLOOR_RAYS = 2000  # just below the floor, where nothing of the object is, …
FLOOR_REACH = 1.5  # … within so many radii of its middle
TOLD_TILT = 0.1  # radians: an object's own up is that near to the one that is told, or to the floor's normal
PITCHED_TILT = 0.15  # radians: the same about the candidates of a camera's frame
PITCHES = (0.0, 15.0, 30.0)  # degrees, by which a camera looks down
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
    tilt: float = TOLD_TILT  # standard deviation, in radians
    views: tuple[View, ...] = ()  # cameras, depths and masks of the object alone

    @property
    def centre(self) -> Float[Tensor, "3"]:
        return self.points.median(0).values

    @property
    def radius(self) -> float:
        """About the distance from the centre within which the object's points lie; a fifth may be others'."""
        return _radius(self.points)

    def to(self, device: torch.device | str) -> "Scan":
        views = tuple(view.to(device) for view in self.views)
        return replace(
            self,
            points=self.points.to(device),
            free=Rays(self.free.origins.to(device), self.free.directions.to(device)),
            hits=Rays(self.hits.origins.to(device), self.hits.directions.to(device)),
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
    free = _joined_rays([scan.free for scan in scans])
    hits = _joined_rays([scan.hits for scan in scans])
    free_until = torch.cat([scan.free_until for scan in scans])
    noise = float(np.mean([scan.noise for scan in scans]))
    views = tuple(view for scan in scans for view in scan.views)
    first = scans[0]
    return Scan(_thinned(points), free, free_until, hits, noise, first.ups, first.tilt, views)


def scan_of_view(scene: View, mask: Bool[Tensor, "height width"] | None, up: "Up", isolate: bool = False) -> Scan:
    """Returns the scan of the object that a mask marks in a depth image; without a mask, of all that has a depth.

    Separate pieces are left out. `isolate`: the mask holds other things, too, as a rectangle does; so is the floor.
    The plane that the object stands on, where it is seen, tells up better than the user.
    Raises `ValueError` where hardly any pixel of the object has a depth.
    """
    inside = scene.seen if mask is None else scene.seen & mask
    _check_count(int(inside.sum()))
    around = _around(inside)
    floor = None if up.direction is None else find_floor(_thinned(scene.masked(around).points()), up)
    if floor is not None:
        up = Up(floor.normal, floor.normal[None], TOLD_TILT)
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
        below = _below(floor, points[kept])
        rays = _joined_rays([rays, below])
        until = torch.cat([until, torch.full((len(below.origins),), torch.inf)])
    return _scan(points[kept], rays, until, hit_rays, up, (view,))


def _below(floor: "Floor", points: Float[Tensor, "n 3"]) -> Rays:
    """Returns level rays just below the floor, under the object: nothing of it is there."""
    random = torch.Generator().manual_seed(0)
    side = torch.linalg.cross(floor.normal, floor.normal.roll(1) + 0.1)
    side = side / side.norm()
    level = torch.stack([side, torch.linalg.cross(floor.normal, side)])
    angles = 2 * np.pi * torch.rand(FLOOR_RAYS, generator=random)
    directions = angles.cos()[:, None] * level[0] + angles.sin()[:, None] * level[1]
    radius = _radius(points)
    centre = points.median(0).values
    centre = centre - (centre @ floor.normal - floor.height + floor.thickness) * floor.normal
    across = torch.linalg.cross(floor.normal.expand_as(directions), directions)
    offsets = FLOOR_REACH * radius * (2 * torch.rand(FLOOR_RAYS, 1, generator=random) - 1)
    return Rays(centre + offsets * across - 2 * FLOOR_REACH * radius * directions, directions)


def _behind(
    scene: View, points: Float[Tensor, "n 3"], inside: Bool[Tensor, "height width"], floor: "Floor | None"
) -> Bool[Tensor, "height width"]:
    """Where the floor is seen, or something behind the object: nothing of the object is behind that."""
    farthest = float(scene.depth[inside].quantile(0.98)) + BACKGROUND * _radius(points)
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
    chosen = _thinned(free.nonzero(), MOST_RAYS)
    pixels = camera.pixels()[chosen[:, 0], chosen[:, 1]]
    until = depth[chosen[:, 0], chosen[:, 1]] / camera.cosines(pixels)
    chosen = _thinned(hits.nonzero(), MOST_RAYS)
    return camera.rays(pixels), until, camera.rays(camera.pixels()[chosen[:, 0], chosen[:, 1]])


def scan_of_points(points: Float[Tensor, "n 3"], up: "Up") -> Scan:
    """Returns the scan of a cloud, of which nobody says from where it was seen. Raises `ValueError` for few points."""
    _check_count(len(points))
    return _scan(points, NO_RAYS, points.new_empty(0), NO_RAYS, up, ())


def canonical_scan(seen: View | Cloud) -> Scan:
    """Returns what was seen of a shape that lies as the model's do; it may be a silhouette alone."""
    up = Up.told("y").candidates
    if isinstance(seen, Cloud):
        return Scan(seen.points, NO_RAYS, torch.empty(0), NO_RAYS, _noise(seen.points), up)
    points = seen.points()
    free = seen.seen if seen.mask is None else seen.seen | ~seen.mask
    hits = torch.zeros_like(free) if seen.mask is None else seen.mask & ~seen.seen
    return Scan(points, *_rays(seen.camera, seen.depth, free, hits), _noise(points), up, views=(seen,))


@dataclass(frozen=True)
class Up:
    """Where an object's own up may point: near one of several directions, of which one is the most likely."""

    direction: Float[Tensor, "3"] | None  # None where nothing is known
    candidates: Float[Tensor, "k 3"]
    tilt: float

    @staticmethod
    def told(axis: str) -> "Up":
        """Returns what a user says: an axis of `AXES`, or `unknown`."""
        if axis == "unknown":
            return Up(None, torch.empty(0, 3), torch.inf)
        direction = torch.tensor(AXES[axis], dtype=torch.float32)
        return Up(direction, direction[None], TOLD_TILT)

    @staticmethod
    def of_camera() -> "Up":
        """Returns what is likely in a camera's frame, whose y points down: cameras look level, or down."""
        pitches = torch.deg2rad(torch.tensor(PITCHES))
        candidates = torch.stack([torch.zeros(len(PITCHES)), -pitches.cos(), -pitches.sin()], dim=1)
        return Up(candidates[0], candidates, PITCHED_TILT)


@dataclass(frozen=True)
class Floor:
    """A plane: `normal` · x = `height`; what lies less than `thickness` above it belongs to it."""

    normal: Float[Tensor, "3"]
    height: float
    thickness: float


def find_floor(points: Float[Tensor, "n 3"], up: Up) -> Floor | None:
    """Returns the largest plane across up that has hardly any point below it (RANSAC), or None."""
    assert up.direction is not None
    random = torch.Generator().manual_seed(0)
    thickness = FLOOR_THICKNESS * _radius(points)
    points = _thinned(points, 2000)
    triples = points[torch.randint(len(points), (FLOOR_TRIALS, 3), generator=random)]
    normals = torch.linalg.cross(triples[:, 1] - triples[:, 0], triples[:, 2] - triples[:, 0])
    normals = torch.nn.functional.normalize(normals, dim=-1)
    normals = normals * (normals @ up.direction).sign()[:, None]
    heights = (triples[:, 0] * normals).sum(-1)
    above = points @ normals.T - heights
    on_plane = (above.abs() < thickness).float().mean(0)
    below = (above < -2 * thickness).float().mean(0)
    degrees = FLOOR_TILT + (max(PITCHES) if len(up.candidates) > 1 else 0.0)
    fits = (normals @ up.direction > np.cos(np.radians(degrees))) & (below < 0.1 * on_plane) & (on_plane > FLOOR_SHARE)
    if not fits.any():
        return None
    best = torch.where(fits, on_plane, 0.0).argmax()
    supports = points[above[:, best].abs() < thickness]
    normal = torch.linalg.svd(supports - supports.mean(0))[2][-1]
    normal = normal * (normal @ up.direction).sign()
    return Floor(normal, float(supports.mean(0) @ normal), thickness)


def object_points(points: Float[Tensor, "n 3"], floor: Floor | None, share: float = PIECE_SHARE) -> Bool[Tensor, "n"]:
    """Returns which points belong to the largest pieces and what is near them; the floor's do not."""
    from scipy.spatial import KDTree

    kept = torch.ones(len(points), dtype=torch.bool)
    if floor is not None:
        kept = points @ floor.normal - floor.height > 1.5 * floor.thickness
    if kept.sum() < LEAST_POINTS:
        return torch.ones_like(kept)
    candidates = points[kept]
    pieces = _pieces(candidates)
    counts = pieces.bincount()
    is_main = (counts >= share * counts.max())[pieces]
    main = candidates[is_main]
    gap = PIECE_GAP * float((main.amax(0) - main.amin(0)).max())
    away, _ = KDTree(main.double().numpy()).query(candidates.double().numpy())
    nearest = torch.full((len(counts),), torch.inf, dtype=torch.float64)
    nearest.scatter_reduce_(0, pieces, torch.from_numpy(away), "amin")
    kept[kept.clone()] = nearest[pieces] <= gap
    return kept


def _load(path: Path, options: ScanOptions) -> Scan:
    kind = path.suffix.lower()
    if kind not in KINDS:
        _refuse(path, "is a depth image's", intrinsics=options.intrinsics)
    if kind in CLOUDS:
        _refuse(path, "is an image's", mask=options.mask, box=options.box)
        points = torch.from_numpy(read_points(path)).float()
        with about(path):
            return scan_of_points(points, Up.told(options.up or "y"))
    if kind not in KINDS:
        scene, mask = read_scene(path)
        up = Up.told(options.up or "y")
    elif options.intrinsics is None:
        raise ValueError(f"{path} is a depth image, and needs --intrinsics: fx,fy,cx,cy in pixels, or a file")
    else:
        depth = load_depth_image(path)
        scene, mask = View(load_intrinsics(options.intrinsics, depth.shape[0], depth.shape[1]), depth), None
        up = Up.told(options.up) if options.up else Up.of_camera()
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
    points = _thinned(points)
    away = (points - points.median(0).values).norm(dim=-1)
    points = points[away <= FAR_OUTLIER * _radius(points)]
    if not float((points - points[0]).norm(dim=-1).max()) > 0:
        raise ValueError(f"all of its {len(points)} points are in one place")
    return Scan(points, free, free_until, hits, _noise(points), up.candidates, up.tilt, views)


def _radius(points: Float[Tensor, "n 3"]) -> float:
    away = (points - points.median(0).values).norm(dim=-1)
    return RADIUS_FACTOR * float(away.quantile(RADIUS_SHARE))


def _joined_rays(rays: Sequence[Rays]) -> Rays:
    return Rays(torch.cat([each.origins for each in rays]), torch.cat([each.directions for each in rays]))


def _thinned(rows: Tensor, most: int = MOST_POINTS) -> Tensor:
    if len(rows) <= most:
        return rows
    return rows[torch.randperm(len(rows), generator=torch.Generator().manual_seed(0))[:most]]


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


def _noise(points: Float[Tensor, "n 3"]) -> float:
    """The median distance of points from the plane through their neighbours."""
    from scipy.spatial import KDTree

    if len(points) < NEIGHBOURS:
        return 0.0
    count = NEIGHBOURS
    chosen = points[:: max(len(points) // 1000, 1)].double().numpy()
    _, near = KDTree(points.double().numpy()).query(chosen, count)
    around = points.double().numpy()[near]
    flatness = np.linalg.svd(around - around.mean(1, keepdims=True), compute_uv=False)[:, -1]
    return float(np.median(flatness) / np.sqrt(count))


def _pieces(points: Float[Tensor, "n 3"]) -> Tensor:
    """The number of each point's piece: pieces are connected cells of a grid."""
    from scipy.ndimage import label
    from scipy.spatial import KDTree

    low = points.amin(0)
    some = points[:: max(len(points) // 1000, 1)].double().numpy()
    apart, _ = KDTree(points.double().numpy()).query(some, 2)
    width = max(float((points - low).max()) / CELLS, SPACING * float(np.median(apart[:, 1]))) or 1.0
    cell = ((points - low) / width).long()
    occupied = np.zeros((CELLS + 2,) * 3, dtype=bool)
    occupied[tuple(cell.T.numpy())] = True
    labels: Any = label(occupied, np.ones((3, 3, 3)))
    return torch.from_numpy(labels[0][tuple(cell.T.numpy())]).long()
