"""Variants of shapes: warped along the axes, and still solids of the same kind."""

import numpy as np
import pytest
import trimesh

from distrace.data.augmentation import lopsided, warped
from distrace.data.solid import RADIUS, Solid, outer_surface


def boxes(*placed: tuple[tuple[float, float, float], tuple[float, float, float]]) -> Solid:
    """A solid of boxes, each of its extents and its middle."""
    parts = []
    for extents, middle in placed:
        parts.append(trimesh.creation.box(extents))
        parts[-1].apply_translation(middle)
    mesh = trimesh.util.concatenate(parts)
    return Solid(mesh, outer_surface(mesh))


TABLE = boxes(
    ((1.2, 0.1, 0.8), (0, 0.3, 0)), *(((0.1, 0.7, 0.1), (x, -0.1, z)) for x in (-0.5, 0.5) for z in (-0.3, 0.3))
)
CORNER = boxes(((1.0, 0.4, 0.4), (0, 0, 0)), ((0.4, 0.4, 0.8), (0.3, 0, 0.3)))


def test_a_shape_and_its_mirror_image_are_told_apart() -> None:
    assert not lopsided(TABLE)
    assert lopsided(CORNER)
    assert not lopsided(CORNER, axis=1)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("solid", [TABLE, CORNER], ids=["table", "corner"])
def test_a_warped_solid_is_another_one_in_the_sphere_with_its_surface_turned_outwards(solid: Solid, seed: int) -> None:
    other = warped(solid, np.random.default_rng(seed))
    middle = (other.soup.bounds[0] + other.soup.bounds[1]) / 2
    np.testing.assert_allclose(middle, 0, atol=1e-9)
    assert np.linalg.norm(other.soup.vertices, axis=1).max() == pytest.approx(RADIUS)
    points = other.surface.triangles_center + 1e-3 * other.surface.face_normals
    assert other.contains(points).mean() < 0.02
    assert other.contains(points - 2e-3 * other.surface.face_normals).mean() > 0.98
    assert np.abs(other.surface.extents / solid.surface.extents - 1).max() > 0.02


def test_what_is_symmetric_stays_so() -> None:
    for seed in range(5):
        other = warped(TABLE, np.random.default_rng(seed))
        assert not lopsided(other)
        assert not lopsided(other, axis=2)


def test_parts_change_their_sizes_and_not_only_the_whole() -> None:
    """The legs' share of the width differs from variant to variant."""
    shares = []
    for seed in range(6):
        surface = warped(TABLE, np.random.default_rng(seed)).surface
        below = surface.vertices[surface.vertices[:, 1] < surface.bounds[:, 1].mean()]
        inner = np.abs(below[:, 0]).min()
        shares.append(inner / surface.bounds[1, 0])
    assert np.ptp(shares) > 0.02
