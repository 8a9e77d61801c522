"""Furniture and aircraft that nobody drew: shapes of a class put together from convex parts at random.

Twenty meshes of a class say little of what else there is; a network that also learns these says more shapes well.
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
    """A closed surface in the orientation of its class: furniture in metres, aircraft in lengths of their fuselage.

    Raises `ValueError` for a class that there is no generator for.
    """
    if category not in GENERATORS:
        raise ValueError(f"shapes of {category} cannot be made; those of {', '.join(GENERATORS)} can")
    hulls = [Manifold.hull_points(part) for part in GENERATORS[category](random)]
    mesh = Manifold.batch_boolean(hulls, OpType.Add).to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts, process=False)
