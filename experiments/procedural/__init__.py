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

INVENTORS: dict[str, Callable[[np.random.Generator], list[Part]]] = {
    "sofas": sofa,
    "chairs": chair,
    "tables": table,
    "planes": plane,
}


def invented(category: str, random: np.random.Generator) -> trimesh.Trimesh:
    """A closed surface in the orientation of its class: furniture in metres, aircraft in lengths of their fuselage.

    Raises `ValueError` for a class that nothing is invented of.
    """
    if category not in INVENTORS:
        raise ValueError(f"shapes of {category} cannot be invented; those of {', '.join(INVENTORS)} can")
    hulls = [Manifold.hull_points(part) for part in INVENTORS[category](random)]
    mesh = Manifold.batch_boolean(hulls, OpType.Add).to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties, mesh.tri_verts, process=False)
