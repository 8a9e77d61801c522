"""Observes a mesh by one camera, for `distrace complete`, and samples its true surface, to measure against.

    PYTHONPATH=. python examples/03_observe_a_mesh.py SPLIT SHAPE MESHES OUT

Writes OUT/SHAPE.npz (depth, mask and normals, by Embree's ray casting) and OUT/SHAPE.ply (30,000 points of the outer
surface). SPLIT is a CSV file. The bundled observation was made by this script.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

import distrace as dt
from distrace.data.observation import save_view
from distrace.data.shapes import read_split
from distrace.metrics import POINTS, surface_points
from experiments.datasets.solids import observe, solid_of

split, name, meshes, out = sys.argv[1:5]
(shape,) = (shape for shape in read_split(split) if shape.name == name)
solid = solid_of(shape, Path(meshes))
camera = dt.Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=256, width=256)
view = observe(solid, camera)
save_view(Path(out) / f"{name}.npz", replace(view, normal=view.normal.half()))
points = surface_points(solid.surface, POINTS, seed=1).astype(np.float32)
trimesh.PointCloud(points).export(Path(out) / f"{name}.ply")
