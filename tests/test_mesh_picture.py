import numpy as np
import trimesh

import distrace as dt
from distrace.report.mesh_picture import mesh_picture
from distrace.shading import shaded_picture

CAMERA = dt.Camera.orbit(30, 20, 4, height=96, width=96)


def test_a_sphere_looks_as_it_does_when_its_field_is_rendered():
    picture = mesh_picture(trimesh.creation.icosphere(5, radius=0.5), CAMERA)
    buffers = dt.render(dt.primitives.sphere(0.5), CAMERA)
    traced = shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions)
    inside = (picture < 255).any(-1)
    middle = np.hypot(*np.indices(inside.shape) - 47.5) < 20  # pixels
    assert inside[buffers.mask.numpy()].all()
    assert inside.sum() < 1.1 * int(buffers.mask.sum())  # pixels at the outline are partly covered
    assert np.abs(picture.astype(int) - traced)[middle].max() <= 6  # of 255


def test_what_lies_before_hides_what_is_behind():
    small = trimesh.creation.icosphere(4, radius=0.2)
    large = trimesh.creation.icosphere(4, radius=0.6)
    together = trimesh.util.concatenate([small, large])
    apart = np.abs(mesh_picture(together, CAMERA).astype(int) - mesh_picture(large, CAMERA)).max(-1)
    assert np.quantile(apart, 0.99) <= 8  # values of 255: other points are drawn


def test_an_empty_mesh_is_white():
    assert (mesh_picture(trimesh.Trimesh(), CAMERA) == 255).all()
