"""Depth images of a placed object as a structured-light sensor gives them: noisy, with holes, and partly hidden.

Noise after Nguyen, Izadi and Lovell, *Modeling Kinect Sensor Noise*, 3DIMPVT 2012. Rays are cast by Embree.
"""

import math
from dataclasses import dataclass

import numpy as np
import roma
import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import max_pool2d

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.data.solid import Solid
from distrace.pose import Similarity
from experiments.datasets.solids import observe

HEIGHT = 240
WIDTH = 320
FOCAL = 292.5  # pixels
BASELINE = 0.075  # metres, between projector and camera
DISPARITY_STEP = 1 / 8  # pixels
GRAZING = 0.2  # cosine below which a surface reflects too little light
JUMP = 0.05  # metres between neighbours: a part of such pixels has no depth
LOST_AT_JUMPS = 0.5
TILT = 10.0  # degrees, at most
RADII = (0.25, 0.75)  # metres, of the unit sphere: sizes of 0.5 – 1.5 m
WRONG_MASK = 0.15  # pixels of the mask that are wrong, relative to its area
HIDDEN = (0.2, 0.4)  # share of the object's width before which something stands
WALL = 1.5  # radii behind the object


@dataclass(frozen=True)
class Scene:
    """What the sensor gives, and what is true."""

    view: View  # of the whole scene, in metres; the world is y-up
    mask: Bool[Tensor, "height width"]
    place: Similarity  # true


def sensed(solid: Solid, seed: int, hidden: bool, reduction: int = 1) -> Scene:
    """Returns a random scene: the object on a floor before a wall, turned, tilted and sized at random.

    With a `reduction`, of every so many rows and columns of the sensor one.
    """
    random = np.random.default_rng(seed)
    radius = random.uniform(*RADII)
    turn = random.uniform(0, 2 * math.pi)
    axis = random.uniform(0, 2 * math.pi)
    tilt = math.radians(TILT) * random.uniform()
    rotation = roma.rotvec_to_rotmat(torch.tensor([tilt * math.cos(axis), 0, tilt * math.sin(axis)]).float())
    rotation = rotation @ roma.rotvec_to_rotmat(torch.tensor([0, turn, 0]).float())
    centre = torch.from_numpy(random.uniform(-0.3, 0.3, 3)).float()
    place = Similarity(rotation, centre, torch.tensor(float(radius)))
    camera = _camera(random, radius, centre, reduction)
    local = place.camera_in_object(camera)
    seen = observe(solid, local)
    depth = seen.depth * radius
    true_mask = seen.seen
    vertices = place.to_world(torch.tensor(np.asarray(solid.surface.vertices)).float())
    background, cosine = _room(camera, float(vertices[:, 1].min()), centre, radius)
    assert seen.normal is not None
    facing = -(seen.normal * local.rays().directions).sum(-1)
    cosine = torch.where(true_mask, facing, cosine)
    depth = torch.where(true_mask, depth, background)
    if hidden:
        before = _occluder(true_mask, random)
        depth = torch.where(before, 0.6 * float(depth[true_mask].min()), depth)
        true_mask = true_mask & ~before
        cosine = torch.where(before, 1.0, cosine)
    depth = _as_sensed(depth, cosine, seed)
    return Scene(View(camera, depth), _wrong(true_mask, seed), place)


def _camera(random: np.random.Generator, radius: float, centre: Tensor, reduction: int) -> Camera:
    azimuth = random.uniform(0, 2 * math.pi)
    elevation = math.radians(random.uniform(5, 40))
    distance = radius * random.uniform(3.0, 4.5) + 0.3
    direction = [math.sin(azimuth) * math.cos(elevation), math.sin(elevation), math.cos(azimuth) * math.cos(elevation)]
    eye = centre + distance * torch.tensor(direction).float()
    target = centre + radius * torch.from_numpy(random.uniform(-0.2, 0.2, 3)).float()
    size = {"height": HEIGHT // reduction, "width": WIDTH // reduction}
    return Camera.look_at(eye, target, **size, focal_px=FOCAL / reduction)


def _room(camera: Camera, floor: float, centre: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Returns the depths of a floor and of a wall behind the object, and the cosines at which they are seen."""
    rays = camera.rays()
    to_floor = (floor - rays.origins[..., 1]) / rays.directions[..., 1]
    to_floor = torch.where(to_floor > 0, to_floor, torch.inf)
    ahead = camera.T_world_camera[:3, 2] * torch.tensor([1.0, 0.0, 1.0])
    ahead = ahead / ahead.norm()
    behind = centre + WALL * radius * ahead
    to_wall = ((behind - rays.origins) @ ahead) / (rays.directions @ ahead)
    to_wall = torch.where(to_wall > 0, to_wall, torch.inf)
    distance = torch.minimum(to_floor, to_wall)
    cosine = torch.where(to_floor < to_wall, rays.directions[..., 1].abs(), (rays.directions @ ahead).abs())
    return distance * camera.cosines(), cosine


def _occluder(mask: Bool[Tensor, "height width"], random: np.random.Generator) -> Bool[Tensor, "height width"]:
    """Returns the pixels of something that stands before a part of the object."""
    columns = mask.any(0).nonzero()[:, 0]
    rows = mask.any(1).nonzero()[:, 0]
    width = int(random.uniform(*HIDDEN) * len(columns))
    first = int(columns[0]) + random.integers(-width // 2, len(columns) - width // 2)
    top = int(rows[int(random.uniform(0, 0.5) * len(rows))])
    before = torch.zeros_like(mask)
    before[top:, max(first, 0) : max(first + width, 0)] = True
    return before


def _as_sensed(depth: Float[Tensor, "height width"], cosine: Tensor, seed: int) -> Float[Tensor, "height width"]:
    random = torch.Generator().manual_seed(seed)
    deviation = 0.0012 + 0.0019 * (depth - 0.4).square()
    noisy = depth + deviation * torch.randn(depth.shape, generator=random)
    disparity = (2 * FOCAL * BASELINE / noisy / DISPARITY_STEP).round() * DISPARITY_STEP  # of the sensor's full size
    sensed = 2 * FOCAL * BASELINE / disparity
    finite = depth.nan_to_num(posinf=20.0)[None]
    spread = (max_pool2d(finite, 3, 1, 1) + max_pool2d(-finite, 3, 1, 1))[0]
    lost = (spread > JUMP) & (torch.rand(depth.shape, generator=random) < LOST_AT_JUMPS)
    return sensed.masked_fill(lost | (cosine < GRAZING) | ~depth.isfinite(), torch.inf)


def _wrong(mask: Bool[Tensor, "height width"], seed: int) -> Bool[Tensor, "height width"]:
    """Returns the mask with an outline that wanders to both sides, so that a share of its pixels is wrong."""
    from scipy.ndimage import distance_transform_edt, gaussian_filter

    random = np.random.default_rng(seed + 1)
    wander = gaussian_filter(random.normal(size=mask.shape), 8)
    wander /= np.abs(wander).max()
    inside = mask.numpy()
    signed = np.asarray(distance_transform_edt(inside)) - np.asarray(distance_transform_edt(~inside))
    low, high = 0.0, 200.0
    for _ in range(30):
        middle = (low + high) / 2
        wrong = ((signed + middle * wander > 0) != inside).sum() / inside.sum()
        low, high = (middle, high) if wrong < WRONG_MASK else (low, middle)
    return torch.from_numpy(signed + low * wander > 0)
