"""Photographs of patches by Mitsuba 3, a path tracer independent of this renderer (Jakob et al. 2022)."""

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from distrace.camera import Camera
from distrace.colour_space import to_linear
from distrace.data.patches import Patch
from distrace.lights import Ambient, Directional, Light
from distrace.shading import Picture
from experiments.clips import clutter

BRIGHTNESS = 0.42  # radiance of the surroundings
LAMP_RADIANCE = 6.0
LAMP_EDGE = 3.0  # radii
LAMP_PLACE = (2.6, 5.2, 3.0)  # in the world, beyond the cameras' orbit and above their images
BOUNCES = 3
AXES = np.diag([-1.0, -1.0, 1.0, 1.0])  # Mitsuba's cameras have x to the left and y up


def mitsuba(variant: str = "scalar_rgb") -> Any:
    """Imports Mitsuba, by default in the variant that needs no compiler. Raises `ValueError` where it is missing."""
    try:
        library = importlib.import_module("mitsuba")
    except ImportError as error:
        raise ValueError(
            "this command renders by Mitsuba, which is not installed; `pip install 'distrace[clips]'` installs it"
        ) from error
    library.set_variant(variant)
    return library


@dataclass(frozen=True)
class Stage:
    """The shape alone, for its true mask and depth, and the lit scene."""

    alone: dict[str, Any]
    lit: dict[str, Any]


def staged(patches: Sequence[Patch], background: str, seed: int) -> Stage:
    """Returns the patches in the light of a lamp and of their surroundings, grey or cluttered."""
    mi = mitsuba()
    alone = {f"patch{index}": _mesh(mi, patch) for index, patch in enumerate(patches)}
    around = {"grey": _grey()} if background == "plain" else _hall(mi, seed)
    return Stage({"type": "scene", **alone}, {"type": "scene", **alone, **around, "lamp": _lamp(mi)})


def in_lights(patches: Sequence[Patch], lights: Sequence[Light]) -> Stage:
    """Returns the patches in ambient and directional lights, with shadows. Raises `ValueError` for other lights."""
    mi = mitsuba()
    alone = {f"patch{index}": _mesh(mi, patch) for index, patch in enumerate(patches)}
    emitters = {f"light{index}": _emitter(light) for index, light in enumerate(lights)}
    return Stage({"type": "scene", **alone}, {"type": "scene", **alone, **emitters})


def _emitter(light: Light) -> dict[str, Any]:
    if isinstance(light, Ambient):
        return {"type": "constant", "radiance": {"type": "rgb", "value": light.colour.tolist()}}
    if isinstance(light, Directional):  # a surface that faces it reflects albedo × irradiance / π
        irradiance = {"type": "rgb", "value": (np.pi * light.colour).tolist()}
        return {"type": "directional", "direction": (-light.direction).tolist(), "irradiance": irradiance}
    raise ValueError(f"{light} cannot be rendered by Mitsuba; give ambient and directional lights")


def photograph(stage: Stage, camera: Camera, samples: int, seed: int) -> Picture:
    """Renders an image in 8-bit sRGB."""
    mi = mitsuba()
    sampler = {"type": "independent", "sample_count": samples}
    scene = mi.load_dict({**stage.lit, "sensor": sensor(mi, camera, sampler)})
    path = mi.load_dict({"type": "path", "max_depth": BOUNCES})
    bitmap = mi.Bitmap(mi.render(scene, integrator=path, seed=seed % 2**32))
    return np.array(bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, srgb_gamma=True))


def truth(stage: Stage, camera: Camera) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Renders the mask of the shape at the pixels' centres, and its depth z, `inf` on the background."""
    mi = mitsuba()
    sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
    scene = mi.load_dict({**stage.alone, "sensor": sensor(mi, camera, sampler)})
    aovs = mi.load_dict({"type": "aov", "aovs": "distance:depth,point:position"})
    channels = np.array(mi.render(scene, integrator=aovs), np.float64)
    mask = channels[..., -4] > 0
    points = channels[..., -3:]
    pose = camera.T_world_camera.double().numpy()
    return mask, np.where(mask, (points - pose[:3, 3]) @ pose[:3, 2], np.inf).astype(np.float32)


def sensor(mi: Any, camera: Camera, sampler: dict[str, Any]) -> dict[str, Any]:
    """Returns Mitsuba's camera; the principal point is the middle of the image."""
    focal = camera.intrinsics[0, 0].item()
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / (2 * focal)))),
        "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(camera.T_world_camera.double().numpy() @ AXES),
        "near_clip": 0.1,
        "film": {
            "type": "hdrfilm",
            "width": camera.width,
            "height": camera.height,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": sampler,
    }


def _mesh(mi: Any, patch: Patch) -> Any:
    """Returns a matt, two-sided mesh with flat faces, since normals in files point either way."""
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(
        {"type": "twosided", "matt": {"type": "diffuse", "reflectance": _reflectance(patch)}}
    )
    count = len(patch.corners)
    mesh = mi.Mesh("patch", 3 * count, count, has_vertex_texcoords=True, props=properties)
    mesh.add_attribute("vertex_color", 3, _linear(patch.colours).astype(np.float32).ravel())
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = patch.corners.astype(np.float32).ravel()
    parameters["faces"] = np.arange(3 * count, dtype=np.uint32)
    parameters["vertex_texcoords"] = (patch.uv * (1, -1) + (0, 1)).astype(np.float32).ravel()  # Mitsuba's v is down
    parameters.update()
    return mesh


def _reflectance(patch: Patch) -> dict[str, Any]:
    if patch.image is None:
        return {"type": "mesh_attribute", "name": "vertex_color"}
    return {"type": "bitmap", "bitmap": mitsuba().Bitmap(patch.image.copy()), "raw": False}


def _linear(colours: Float[np.ndarray, "*colours 3"]) -> Float[np.ndarray, "*colours 3"]:
    return to_linear(torch.from_numpy(np.array(colours, np.float64))).numpy()


def _grey() -> dict[str, Any]:
    return {"type": "constant", "radiance": {"type": "rgb", "value": [BRIGHTNESS] * 3}}


def _lamp(mi: Any) -> dict[str, Any]:
    place = mi.ScalarTransform4f().look_at(origin=LAMP_PLACE, target=(0, 0, 0), up=(0, 0, 1))
    return {
        "type": "rectangle",
        "to_world": place @ mi.ScalarTransform4f().scale(LAMP_EDGE / 2),
        "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [LAMP_RADIANCE] * 3}},
    }


def _hall(mi: Any, seed: int) -> dict[str, Any]:
    """Returns boxes under a luminous sky."""
    sky = mi.Bitmap(_sky_radiance(clutter.sky(seed)))
    return {"boxes": _mesh(mi, clutter.boxes(seed)), "sky": {"type": "envmap", "bitmap": sky}}


def _sky_radiance(image: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Scales the sky to the mean radiance of the plain surroundings."""
    light = _linear(image / 255)
    return (light * BRIGHTNESS / light.mean()).astype(np.float32)
