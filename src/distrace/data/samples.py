"""Signed samples of a solid, in DeepSDF's distribution and file layout (Park et al., CVPR 2019, section 3)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from distrace.data.solid import Solid, first_met
from distrace.files import atomic_write
from distrace.metrics import surface_points

NEAR_SHARE = 0.94  # the share of samples near the surface; the rest fills the unit sphere
VARIANCES = (0.0025, 0.00025, 0.000025)  # DeepSDF has the first two; the third is for thin legs and wings
MAX_WINDING_ERROR = 0.25  # a winding number this far from a whole number leaves the sign in doubt
MAX_DOUBTFUL_SHARE = 0.02  # a shape with a larger share of doubtful signs is not learnt
MAX_LOST_SHARE = 0.3  # nor one of which more of what is seen bounds no solid: cloth and cane without thickness
MAX_THIN_SHARE = 0.3  # nor one of which a larger share of the surface bounds nothing thicker than THIN
THIN = 0.002  # in which a mesh of 256 cells, each 0.008 wide, does not tell two sides apart, nor a network
LOST_DISTANCE = 0.02  # what is seen of the solid, if so far behind what is seen of the mesh, is something else


@dataclass(frozen=True)
class Doubt:
    """A report on a shape: whether its signs are reliable, and if not, why."""

    name: str
    faces: int
    outer_area: float  # share of the faces' area that bounds the solid
    doubtful: float  # share of samples whose winding number is far from a whole number
    usable: bool
    reason: str = ""  # why it is left out
    lost: float = 0.0  # share of what is seen of the mesh that bounds no solid
    thin: float = 0.0  # share of the surface behind which the solid ends at once

    def is_of(self, name: str) -> bool:
        """Whether it is the report on a shape of that name, with values of the right types, as JSON has them."""
        shares = (self.outer_area, self.doubtful, self.lost, self.thin)
        rest = isinstance(self.usable, bool) and isinstance(self.reason, str) and isinstance(self.faces, int)
        return self.name == name and rest and all(isinstance(share, int | float) for share in shares)


def sample(solid: Solid, count: int, seed: int, near: float = NEAR_SHARE) -> Float[np.ndarray, "count 4"]:
    """Points and signed distances: most are displaced surface points, the rest fill the unit sphere."""
    random = np.random.default_rng(seed)
    surface = surface_points(solid.surface, int(near * count) // len(VARIANCES), seed)
    displaced = np.concatenate([surface + random.normal(size=surface.shape) * variance**0.5 for variance in VARIANCES])
    points = np.concatenate([displaced, _in_ball(random, count - len(displaced))])
    return np.column_stack([points, solid.distance(points)]).astype(np.float32)


def doubt(name: str, solid: Solid, count: int = 20_000) -> Doubt:
    """How reliable a shape's signs are, by winding numbers at random points in and around it."""
    points = np.random.default_rng(0).uniform(-1, 1, (count, 3)) * np.abs(solid.soup.bounds).max(0) * 1.05
    winding = solid.winding(points)
    doubtful = float((np.abs(winding - np.round(winding)) > MAX_WINDING_ERROR).mean())
    outer = float(solid.surface.area / solid.soup.area)
    missing = lost(solid)
    sheet = thin(solid)
    reasons = [f"{doubtful:.1%} of its signs are doubtful"] if doubtful > MAX_DOUBTFUL_SHARE else []
    reasons += [f"{missing:.0%} of what is seen of it bounds no solid"] if missing > MAX_LOST_SHARE else []
    reasons += [f"{sheet:.0%} of its surface bounds nothing thicker than {THIN:g}"] if sheet > MAX_THIN_SHARE else []
    return Doubt(name, len(solid.soup.faces), outer, doubtful, not reasons, " and ".join(reasons), missing, sheet)


def lost(solid: Solid, count: int = 5000) -> float:
    """The share of random rays that hit the mesh but miss the solid there: a seat of cane without thickness, say."""
    random = np.random.default_rng(0)
    directions = random.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = _in_ball(random, count) - 2 * directions
    of_soup, of_solid = (first_met(mesh, origins, directions) for mesh in (solid.soup, solid.surface))
    met = np.isfinite(of_soup)
    return float((of_solid[met] > of_soup[met] + LOST_DISTANCE).mean()) if met.any() else 0.0


def thin(solid: Solid, count: int = 5000) -> float:
    """The share of the surface behind which the solid is thinner than THIN: a sheet with a face on either side."""
    from trimesh.sample import sample_surface

    points, faces = sample_surface(solid.surface, count, seed=0)[:2]
    inwards = -solid.surface.face_normals[faces]
    return float((first_met(solid.surface, points + 1e-5 * inwards, inwards) < THIN).mean())


def _in_ball(random: np.random.Generator, count: int) -> Float[np.ndarray, "count 3"]:
    """Points that fill the unit sphere evenly."""
    direction = random.normal(size=(count, 3))
    return direction * random.random((count, 1)) ** (1 / 3) / np.linalg.norm(direction, axis=1, keepdims=True)


def write_samples(path: Path, samples: Float[np.ndarray, "n 4"]) -> None:
    """DeepSDF's `.npz`, with `pos` and `neg` [n, 4]: what lies outside and what lies inside."""
    inside = samples[:, 3] < 0
    with atomic_write(path) as part:
        np.savez(part, pos=samples[~inside], neg=samples[inside])
