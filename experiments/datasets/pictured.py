"""Pictures of meshes."""

from distrace.camera import Camera
from distrace.data.solid import Solid
from distrace.shading import Picture
from experiments.datasets.solids import observe


def pictured(solid: Solid, camera: Camera) -> Picture:
    """Returns a mesh's outer surface, shaded as clay."""
    picture = observe(solid, camera).shaded
    assert picture is not None
    return picture
