"""What a camera sees of a mesh, as an observation for `distrace complete`, and the true surface to measure against.

    python examples/03_observe_a_mesh.py SPLIT SHAPE MESHES OUT

writes OUT/SHAPE.npz (depth, mask and normals, by Embree's ray casting) and OUT/SHAPE.ply (30,000 points of the outer
surface). The bundled observation was made so.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from distrace.benchmarks.measuring import poster_view
from distrace.data.observation import observe, save_view
from distrace.data.shapes import read_split
from distrace.data.solid import solid_of
from distrace.metrics import POINTS, surface_points

SIZE = 256
split, name, meshes, out = sys.argv[1:5]
(shape,) = (shape for shape in read_split(split) if shape.name == name)
solid = solid_of(shape, Path(meshes))
view = observe(solid, poster_view(SIZE))
save_view(Path(out) / f"{name}.npz", replace(view, normal=view.normal.half()))
points = surface_points(solid.surface, POINTS, seed=1).astype(np.float32)
trimesh.PointCloud(points).export(Path(out) / f"{name}.ply")
