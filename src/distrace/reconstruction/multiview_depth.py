"""Depths from photographs alone: a plane sweep, and a consistency check between the views.

The sweep is Collins, *A space-sweep approach to true multi-image matching*, CVPR 1996, with windows parallel to the
image, normalised cross-correlation, and the best neighbours only (Kang, Szeliski and Chai, CVPR 2001, section 3.1).
Such depths show what outlines cannot, as inside a bowl.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.photograph import Photograph
from distrace.photos.stereo_pairs import neighbour_views, sample_image, window_mean, window_moments
from distrace.rays import Rays, meet_sphere

SIZE = 160  # pixels along the longer side, of views that are compared
PLANES = 96  # about one for each pixel of disparity
NEAREST_PLANE = 0.1  # radii, where an eye is within the sphere or looks away
NEIGHBOURS = 4  # views that each is compared with, …
BEST_NEIGHBOURS = 2  # … and those that count: the others may be occluded
WINDOW = 7  # pixels
LEAST_VARIANCE = 4e-4  # of brightness: a window with less says nothing
LEAST_CORRELATION = 0.7  # of a reliable match, …
LEAST_LEAD = 0.1  # … by which it must beat all planes …
PEAK_WIDTH = 4  # … that are more than so many planes away
DEPTH_ERROR = 0.03  # radii: of reliable depths
LEAST_CONFIRMATIONS = 2  # other views that see a surface at the point; fewer may see through it
CONFIRMED_ERROR = 0.02  # radii: of consistent depths
TOLERANCE = CONFIRMED_ERROR / 4  # radii: field values within it are right on the surface


@dataclass(frozen=True)
class DepthMap:
    """Depths of one view; unreliable ones say nothing."""

    camera: Camera
    depth: Float[Tensor, "height width"]
    reliable: Bool[Tensor, "height width"]

    def votes(self, points: Float[Tensor, "n 3"]) -> tuple[Bool[Tensor, "n"], Bool[Tensor, "n"]]:
        """Which points the view sees through, and which lie on a surface that it sees."""
        pixels, depths = self.camera.project(points)
        free, occupied = torch.zeros(2, len(points), dtype=torch.bool)
        shown = self.camera.shows(pixels, depths)
        column, row = pixels[shown].long().unbind(-1)
        behind = self.depth[row, column] - depths[shown]
        free[shown] = self.reliable[row, column] & (behind > DEPTH_ERROR)
        occupied[shown] = self.reliable[row, column] & (behind.abs() <= DEPTH_ERROR)
        return free, occupied


@torch.no_grad()
def plane_sweep(photographs: Sequence[Photograph]) -> list[DepthMap]:
    """Coarse depth maps of all photographs that have a neighbour. Raises `ValueError` for one without a mask."""
    views = [photograph.at_most(SIZE) for photograph in photographs]
    chosen = neighbour_views([view.camera for view in views], NEIGHBOURS).tolist()
    neighbours = [[views[number] for number in row if number >= 0] for row in chosen]
    return [_depth_map(view, others) for view, others in zip(views, neighbours, strict=True) if others]


def _depth_map(view: Photograph, neighbours: Sequence[Photograph]) -> DepthMap:
    """The depth, per pixel, of the plane with the highest correlation; planes are even in inverse depth."""
    camera = view.camera
    rays = camera.rays()
    distance_per_depth = 1 / camera.cosines()
    brightness = view.image.mean(-1)[None]
    moments = window_moments(brightness, WINDOW)
    centre = camera.project(torch.zeros(1, 3))[1].item()
    planes = 1 / torch.linspace(1 / max(centre - 1, NEAREST_PLANE), 1 / max(centre + 1, 2 * NEAREST_PLANE), PLANES)
    by_plane = []
    for depth in planes:
        points = rays.at(depth * distance_per_depth)
        found = torch.stack([_correlation(brightness, *moments, neighbour, points) for neighbour in neighbours])
        by_plane.append(found.topk(min(BEST_NEIGHBOURS, len(found)), dim=0).values.mean(0))
    correlation = torch.stack(by_plane)
    best, plane = correlation.max(0)
    peak = (torch.arange(PLANES)[:, None, None] - plane).abs() <= PEAK_WIDTH
    unique = best - correlation.masked_fill(peak, -1).amax(0) > LEAST_LEAD
    reliable = view.known_mask & (moments[1][0] > LEAST_VARIANCE) & (best > LEAST_CORRELATION) & unique
    return DepthMap(camera, planes[plane], reliable)


def _correlation(
    brightness: Float[Tensor, "1 height width"],
    mean: Float[Tensor, "1 height width"],
    variance: Float[Tensor, "1 height width"],
    neighbour: Photograph,
    points: Float[Tensor, "height width 3"],
) -> Float[Tensor, "height width"]:
    """Correlation of each pixel's window with the neighbour's, if the pixels show these points.

    It is −1 where the neighbour does not show the point, or has no texture there.
    """
    pixels, depths = neighbour.camera.project(points)
    warped = sample_image(neighbour.image.mean(-1)[None], pixels)
    warped_mean, warped_variance = window_moments(warped, WINDOW)
    covariance = window_mean(brightness * warped, WINDOW) - mean * warped_mean
    correlation = (covariance / (variance * warped_variance).sqrt().clamp_min(LEAST_VARIANCE / 10))[0]
    return torch.where(
        neighbour.camera.shows(pixels, depths) & (warped_variance[0] > LEAST_VARIANCE), correlation, -1.0
    )


@dataclass(frozen=True)
class ConsistentDepths:
    """Rays that meet the unit sphere; distances along them to the sphere, and to a surface that several views see."""

    rays: Rays
    near: Float[Tensor, "n"]
    distance: Float[Tensor, "n"]

    @staticmethod
    @torch.no_grad()
    def of(maps: Sequence[DepthMap]) -> "ConsistentDepths":
        """The reliable depths that enough other views confirm."""
        parts = []
        for one in maps:
            rays = one.camera.rays()[one.reliable]
            distance = (one.depth / one.camera.cosines())[one.reliable]
            points = rays.at(distance)
            bounds = meet_sphere(rays)
            free, occupied = torch.zeros(2, len(points))
            for other in maps:
                if other is not one:
                    votes_free, votes_occupied = other.votes(points)
                    free += votes_free
                    occupied += votes_occupied
            kept = (occupied >= LEAST_CONFIRMATIONS) & (occupied > free) & (points.norm(dim=-1) < 1) & bounds.meets
            parts.append((rays.origins[kept], rays.directions[kept], bounds.near[kept], distance[kept]))
        if not parts:
            return NO_DEPTHS
        origins, directions, near, distance = (torch.cat(part) for part in zip(*parts, strict=True))
        return ConsistentDepths(Rays(origins, directions), near, distance)

    def __len__(self) -> int:
        return len(self.distance)

    def sample(self, count: int, random: torch.Generator) -> Float[Tensor, "four_times_count 3"]:
        """Points of `count` rays, in this order: on the surface, anywhere before it, shortly before, and behind it."""
        rows = torch.randint(len(self), (count,), generator=random)
        rays = self.rays[rows]
        near = self.near[rows]
        surface = self.distance[rows]
        share_anywhere, share_close = torch.rand(2, count, generator=random)
        before = near + share_anywhere * (surface - CONFIRMED_ERROR - near).clamp_min(0)
        close = surface - CONFIRMED_ERROR * (1 + 2 * share_close)
        return torch.cat([rays.at(distance) for distance in (surface, before, close, surface + CONFIRMED_ERROR)])


NO_DEPTHS = ConsistentDepths(Rays(torch.zeros(0, 3), torch.zeros(0, 3)), torch.zeros(0), torch.zeros(0))


def consistent_depth_loss(values: Float[Tensor, "four_times_count"]) -> Float[Tensor, ""]:
    """The mean error of a field's values at the points of `ConsistentDepths.sample`, beyond the tolerance."""
    on, before, close, behind = values.chunk(4)
    free = (TOLERANCE - before).relu() + (TOLERANCE - close).relu()
    return ((on.abs() - TOLERANCE).relu() + free + behind.relu()).mean()
