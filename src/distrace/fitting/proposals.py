"""Where a fit to a scan starts: typical shapes, turned, sized and shifted, that contradict the scan least."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import roma
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import interpolate, normalize

from distrace.data.scan import Scan
from distrace.fields.decoder import Decoder
from distrace.fields.precision import BFloat16Decoder
from distrace.fitting.ray_sampling import drawn
from distrace.fitting.scan_residuals import PlacedCode
from distrace.pose import Similarity
from distrace.prior import Prior

SHAPES = 64  # typical ones
EVALUATED_CELLS = 16  # along each axis of their volumes of values, …
CELLS = 32  # … and after interpolation
TURNS = 24  # about up
SIZES = (0.9, 1.05, 1.25, 1.5, 1.8)  # of the unit sphere, in radii of the scan
SHIFTS = (-0.35, 0.0, 0.35)  # along each axis, in sizes
SCAN_POINTS = 120  # and as many rays of free space …
RAY_POINTS = 5  # … with so many points on each
REACH = 1.3  # radii of the scan, before and behind the object's middle, where these lie
FREE_WEIGHT = 3.0  # of free space, beside the surface
DEVIATION = 0.1  # of a typical shape from the scan, in radii of the scan: what is off by more is an outlier
HIDDEN = 0.3  # radii before a point that are compared with free space
REFINED = 60  # proposals that are moved about, …
TRIALS = 100  # … each so often, …
REFINEMENT = (1.0, 0.6, 0.35)  # … ever less far: × these
TRIED_TURN = 0.08  # radians
TRIED_GROWTH = 0.12  # logarithm of the size
TRIED_SHIFT = 0.1  # sizes
LEAST_GROWTH = 0.25  # logarithm of the ratio of two proposals' sizes, turned alike
LEAST_APART = 0.9 * 2 * math.pi / TURNS  # radians between two proposals


@dataclass(frozen=True)
class Volumes:
    """Values of typical shapes on a grid of the cube about the unit sphere."""

    codes: Float[Tensor, "shapes length"]
    values: Float[Tensor, "cells shapes"]

    @staticmethod
    @torch.no_grad()
    def of(decoder: Decoder | BFloat16Decoder, prior: Prior, seed: int) -> "Volumes":
        """Evaluates typical shapes on a coarse grid, which is interpolated to a finer one."""
        codes = typical_codes(prior, seed)
        steps = (torch.arange(EVALUATED_CELLS).to(codes) + 0.5) * 2 / EVALUATED_CELLS - 1
        centres = torch.cartesian_prod(steps, steps, steps)
        length = centres.norm(dim=-1)
        within = length < 1 + 2 / EVALUATED_CELLS
        values = length.expand(len(codes), -1).clone()  # far outside, what it is does not matter
        values[:, within] = decoder.fields(codes)(centres[within].expand(len(codes), -1, -1))
        coarse = values.reshape(1, len(codes), *[EVALUATED_CELLS] * 3)
        fine = interpolate(coarse, scale_factor=CELLS // EVALUATED_CELLS, mode="trilinear")
        return Volumes(codes, fine[0].flatten(1).T.contiguous())

    def only(self, shape: int) -> "Volumes":
        """Returns the volume of one shape."""
        return Volumes(self.codes[shape, None], self.values[:, shape, None])

    def at(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch shapes"]:
        """Returns the values of the nearest cells; beyond the cube the distance to it is added."""
        cell = ((points + 1) * (CELLS / 2)).long().clamp(0, CELLS - 1)
        index = (cell[..., 0] * CELLS + cell[..., 1]) * CELLS + cell[..., 2]
        beyond = (points.abs() - 1).clamp_min(0).norm(dim=-1)
        return self.values[index] + beyond[..., None]


def typical_codes(prior: Prior, seed: int) -> Float[Tensor, "shapes length"]:
    """Returns the training codes nearest to the means of `SHAPES` groups (k-means)."""
    from scipy.cluster.vq import kmeans2

    if len(prior.codes) <= SHAPES:
        few = list(prior.codes) or [prior.mean]
        return torch.stack(few)
    codes = torch.stack(list(prior.codes))
    w = torch.linalg.solve(prior.basis, (codes - prior.mean).T).T
    group: Any = kmeans2
    means, _ = group(w.cpu().double().numpy(), SHAPES, minit="++", seed=seed)
    nearest = torch.cdist(torch.from_numpy(means).to(w), w).argmin(1)
    return codes[nearest.unique()]


@torch.no_grad()
def proposed(scan: Scan, decoder: Decoder | BFloat16Decoder, prior: Prior, count: int, seed: int) -> list[PlacedCode]:
    """Returns the best proposal of each of the `count` best rotations, best first; numbered from 0."""
    volumes = Volumes.of(decoder, prior, seed)
    probes = Probes.of(scan, seed)
    rotations = _rotations(scan.ups).to(scan.points)
    found: list[tuple[float, int, Similarity]] = []
    for rotation in rotations:
        sizes, centres = _places(probes.surface, rotation, scan.radius)
        least, shape = probes.losses(volumes, rotation, sizes, centres).min(dim=1)
        for size in sizes.unique():
            of_size = (sizes == size).nonzero()[:, 0]
            place = int(of_size[least[of_size].argmin()])
            found.append((float(least[place]), int(shape[place]), Similarity(rotation, centres[place], size)))
    found.sort(key=lambda each: each[0])
    refined = probes.refined(volumes, found[:REFINED], seed)
    chosen: list[PlacedCode] = []
    for _, shape, place in sorted(refined, key=lambda each: each[0]):
        if not any(_is_near(place, other.place) for other in chosen):
            chosen.append(PlacedCode(len(chosen), volumes.codes[shape], prior.mean[:0], place))
        if len(chosen) == count:
            break
    return chosen


def _is_near(first: Similarity, second: Similarity) -> bool:
    """Returns whether two proposals lead to the same end: turned nearly alike, and nearly as large."""
    apart = float(roma.rotmat_geodesic_distance(first.rotation, second.rotation))
    return apart < LEAST_APART and abs(float((first.scale / second.scale).log())) < LEAST_GROWTH


@dataclass(frozen=True)
class Probes:
    """Points of a scan's surface, and points of the free space about the object."""

    surface: Float[Tensor, "n 3"]
    free: Float[Tensor, "rays points 3"]
    deviation: float

    @staticmethod
    def of(scan: Scan, seed: int) -> "Probes":
        """Draws points; those of free space lie on rays, at most a radius before and behind the object's middle."""
        random = torch.Generator().manual_seed(seed)
        deviation = DEVIATION * scan.radius
        surface = drawn(scan.points, SCAN_POINTS, random)
        chosen = torch.randperm(len(scan.free_until), generator=random)[:SCAN_POINTS]
        rays = scan.free[chosen]
        middle = ((scan.centre - rays.origins) * rays.directions).sum(-1)
        last = torch.minimum(scan.free_until[chosen] - HIDDEN * scan.radius, middle + REACH * scan.radius)
        first = middle - REACH * scan.radius
        shares = (torch.arange(RAY_POINTS) + torch.rand(len(last), RAY_POINTS, generator=random)) / RAY_POINTS
        t = first[:, None] + shares.to(last) * (last - first)[:, None]
        points = rays.origins[:, None] + t[..., None] * rays.directions[:, None]
        return Probes(surface, points[last > first], deviation)

    def losses(
        self,
        volumes: Volumes,
        rotation: Float[Tensor, "3 3"],
        sizes: Float[Tensor, "places"],
        centres: Float[Tensor, "places 3"],
    ) -> Float[Tensor, "places shapes"]:
        """How much each typical shape at each place contradicts the points; outliers count alike."""
        return self._losses(volumes, rotation[None], sizes, centres)

    def _losses(self, volumes: Volumes, rotations: Tensor, sizes: Tensor, centres: Tensor) -> Tensor:
        count = len(self.surface)
        probes = torch.cat([self.surface, self.free.flatten(0, 1)])
        points = (probes - centres[:, None]) @ rotations / sizes[:, None, None]
        off = volumes.at(points) * (sizes / self.deviation)[:, None, None]
        loss = _robust(off[:, :count]).mean(1)
        if not len(self.free):
            return loss
        entered = off[:, count:].unflatten(1, self.free.shape[:2]).amin(2).clamp_max(0)
        return loss + FREE_WEIGHT * _robust(entered).mean(1)

    def refined(
        self, volumes: Volumes, proposals: Sequence[tuple[float, int, Similarity]], seed: int
    ) -> list[tuple[float, int, Similarity]]:
        """Moves each proposal to the best of random places about it, ever nearer; its shape stays."""
        random = torch.Generator().manual_seed(seed)
        best = list(proposals)
        for width in REFINEMENT:
            for number, (loss, shape, place) in enumerate(best):
                steps = width * torch.randn(TRIALS, 7, generator=random).to(self.surface)
                rotations = roma.rotvec_to_rotmat(TRIED_TURN * steps[:, :3]) @ place.rotation
                sizes = place.scale * (TRIED_GROWTH * steps[:, 3]).exp()
                centres = place.translation + TRIED_SHIFT * place.scale * steps[:, 4:]
                losses = self._losses(volumes.only(shape), rotations, sizes, centres)[:, 0]
                k = int(losses.argmin())
                if losses[k] < loss:
                    best[number] = (float(losses[k]), shape, Similarity(rotations[k], centres[k], sizes[k]))
        return best


def _robust(off: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    squared = off.square()
    return squared / (1 + squared)


def _rotations(ups: Float[Tensor, "k 3"]) -> Float[Tensor, "n 3 3"]:
    """Returns rotations of an object whose y axis points to one of `ups`, or anywhere where there are none."""
    if len(ups):
        return torch.cat([_turned(up) for up in ups])
    return torch.cat([_turned(axis)[::2] for axis in axes_around()])


def axes_around() -> Float[Tensor, "26 3"]:
    """Returns unit vectors in all directions: to the faces, edges and corners of a cube."""
    directions = torch.cartesian_prod(*(torch.tensor([-1.0, 0.0, 1.0]),) * 3)
    return normalize(directions[directions.norm(dim=-1) > 0], dim=-1)


def _turned(up: Float[Tensor, "3"]) -> Float[Tensor, "turns 3 3"]:
    """Returns rotations that take the y axis to `up`."""
    side = torch.linalg.cross(up, up.roll(1) + 0.1)
    side = side / side.norm()
    upright = torch.stack([torch.linalg.cross(up, side), up, side], dim=1)
    angles = torch.arange(TURNS).to(up) * (2 * math.pi / TURNS)
    about = torch.stack([torch.zeros(TURNS).to(up), angles, torch.zeros(TURNS).to(up)], dim=1)
    return upright @ roma.rotvec_to_rotmat(about)


def _places(surface: Tensor, rotation: Tensor, radius: float) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"]]:
    """Returns sizes and centres to try."""
    along = surface @ rotation  # in the object's axes
    middle = (along.quantile(0.02, dim=0) + along.quantile(0.98, dim=0)) / 2
    sizes = radius * torch.tensor(SIZES).to(surface)
    shift = torch.tensor(SHIFTS).to(surface)
    shifts = torch.cartesian_prod(shift, shift, shift)
    centres = (middle + sizes[:, None, None] * shifts) @ rotation.T
    return sizes[:, None].expand(-1, len(shifts)).reshape(-1), centres.reshape(-1, 3)
