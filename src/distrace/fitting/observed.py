"""What a shape in the unit sphere is fitted to: points and rays, drawn from views or from a list of points."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.data.observation import View
from distrace.data.points import noise_of
from distrace.fields.decoder import Decoder
from distrace.fitting.ray_sampling import Targets, drawn, pools_of
from distrace.fitting.scan_residuals import ScanSample
from distrace.prior import Prior
from distrace.rays import Rays


@dataclass(frozen=True)
class Observed:
    """What a shape is fitted to: points and rays, drawn from views or from a list of points."""

    draw: Callable[[int, int, torch.Generator], ScanSample]  # at most so many points and rays of each view
    noise: float  # standard deviation of the points about the surface

    @staticmethod
    def of_views(decoder: Decoder, views: Sequence[View], prior: Prior) -> "Observed":
        """Raises `ValueError` without views, or with one from inside the mean shape."""
        pools = pools_of(decoder.field(prior.mean), views, prior.mean.device)
        noise = max(noise_of(view.to("cpu").points()) for view in views)

        def draw(points: int, rays: int, random: torch.Generator) -> ScanSample:
            return _sample([pool.draw(points, rays, random) for pool in pools], 2 * noise)

        return Observed(draw, noise)

    @staticmethod
    def of_points(samples: Float[Tensor, "n 4"]) -> "Observed":
        """Takes points and their signed distances from the surface. Raises `ValueError` without points."""
        if not len(samples):
            raise ValueError("no points were given; fitting needs points with their signed distances")

        def draw(points: int, rays: int, random: torch.Generator) -> ScanSample:
            chosen = drawn(samples, points + rays, random)
            none = samples[:0, :3]
            return ScanSample(chosen[:, :3], Rays(none, none), none[:, 0], 0, chosen[:, 3])

        return Observed(draw, 0.0)


def _sample(targets: Sequence[Targets], before: float) -> ScanSample:
    """Returns points at depths, rays that are free until `before` these or beside the object, and rays that meet it."""
    points = []
    free: list[Rays] = []
    until = []
    hits: list[Rays] = []
    for target in targets:
        rays = target.camera.rays(target.pixels)
        distance = target.depth / target.camera.cosines(target.pixels)
        known = distance.isfinite()
        points.append(rays.at(distance)[known])
        is_free = known | ~target.is_object
        free.append(rays[is_free])
        until.append(distance[is_free] - before)
        hits.append(rays[target.is_object & ~known])
    rays = Rays.cat([*free, *hits])
    ends = torch.cat(until)
    beyond = ends.new_full((len(rays.origins) - len(ends),), torch.inf)
    return ScanSample(torch.cat(points), rays, torch.cat([ends, beyond]), len(ends))
