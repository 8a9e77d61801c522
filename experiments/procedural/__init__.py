"""Procedural furniture and aircraft: random shapes of a class, unions of convex parts.

Twenty meshes cover little of a class; a network that also trains on these represents more shapes.
"""

from collections.abc import Callable

import numpy as np
import trimesh
from manifold3d import Manifold, OpType

from experiments.procedural.chair import chair
from experiments.procedural.parts import Part
from experiments.procedural.plane import plane
from experiments.procedural.sofa import sofa
from experiments.procedural.table import table

GENERATORS: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "sofas": sofa,
    "chairs": chair,
    "tables": table,
    "planes": plane,
}


def procedural_mesh(category: str, random: np.random.Generator) -> trimesh.Trimesh:
    """Returns a closed mesh in the orientation of its class: furniture in metres, aircraft in fuselage lengths.

    Raises `ValueError` for a class without a generator.
    """
    if category not in GENERATORS:
        raise ValueError(f"there is no generator of {category}; choose from {', '.join(GENERATORS)}")
    hulls = [Manifold.hull_points(part) for part in GENERATORS[category](random)]
    mesh = Manifold.batch_boolean(hulls, OpType.Add).to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts, process=False)
