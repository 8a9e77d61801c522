"""What a known shape, seen by a camera, lacks of an observed view: residuals on rays and their exact Jacobian."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.data.view import View
from distrace.fast import near_surface, prepared
from distrace.field import SDF, value_and_gradient
from distrace.forecast import Kind, forecast
from distrace.lattice import Lattice
from distrace.pose import object_in_camera
from distrace.rays import Bounds, Rays, meet_box, meet_sphere
from distrace.solver import Residuals
from distrace.surface import minimum
from distrace.targets import OUTLINE, band
from distrace.trace import Trace, TraceConfig, sphere_trace

APART = 0.015  # between the points whose normals tell how the surface bends: a decoder's facets are smaller
CORE = 0.5  # of the sphere: rays that miss it are drawn to within
MARCH = TraceConfig(coarse_levels=0, step_scale=1.2, tolerance=3e-4, steps=30, least_step=1e-3)


@dataclass(frozen=True)
class Accuracy:
    """What deviations count alike: of depths and outlines in units of the sphere's radius, of normals in radians."""

    depth: float = 0.01
    outline: float = 0.01
    normal: float = 0.2


@dataclass(frozen=True)
class Sight:
    """Rays of a view in its camera's axes: what was seen there. A depth is `inf` and a normal zero where unknown."""

    pixels: Float[Tensor, "n 2"]
    depth: Float[Tensor, "n"]
    is_object: Bool[Tensor, "n"]
    is_background: Bool[Tensor, "n"]
    normal: Float[Tensor, "n 3"]

    @staticmethod
    def of(view: View, rays: int, seed: int = 0, width: int = OUTLINE) -> "Sight":
        """A third of the rays each on the object, beside its outline and around it; without a mask all on the object."""
        random = torch.Generator().manual_seed(seed)
        normals = torch.zeros(*view.depth.shape, 3) if view.normal is None else view.normal
        known = view.seen | (normals.norm(dim=-1) > 0.5)
        inside = known if view.mask is None else known | view.mask
        regions = [inside] if view.mask is None else [inside, band(view.mask, width), _around(view.mask)]
        chosen = torch.cat([_some(region, rays // len(regions), random) for region in regions])
        is_object = inside.reshape(-1)[chosen]
        is_background = torch.zeros_like(is_object) if view.mask is None else ~is_object
        rotation = view.camera.T_world_camera[:3, :3]
        return Sight(
            view.camera.pixels().reshape(-1, 2)[chosen],
            view.depth.reshape(-1)[chosen],
            is_object,
            is_background,
            normals.reshape(-1, 3)[chosen] @ rotation,
        )


@dataclass(frozen=True)
class Scene:
    """A shape that stays as it is, with the lattice that tells where its surface may be."""

    sdf: SDF
    near: SDF
    lattice: Lattice

    @staticmethod
    def of(sdf: SDF, like: Tensor) -> "Scene":
        lattice, _ = prepared(sdf, like)
        return Scene(sdf, near_surface(sdf, lattice), lattice)

    @torch.no_grad()
    def trace(self, rays: Rays, bounds: Bounds) -> Trace:
        """From where the surface may first be; rays that pass it by are not marched."""
        box = self.lattice.box()
        within = bounds if box is None else meet_box(rays, *box)
        begin, end = within.near.maximum(bounds.near), within.far.minimum(bounds.far)
        ahead = forecast(self.lattice, rays, begin, end, pass_near=False)
        possible = ahead.kind != Kind.NOTHING
        bounds = Bounds(bounds.near.masked_fill(~possible, torch.inf), bounds.far)
        trace = sphere_trace(self.lattice.near, rays, bounds, MARCH, ahead.begins)
        middle = -(rays.origins * rays.directions).sum(-1).clamp_max(0)  # beside the middle, until more is known
        passed = torch.where(ahead.closest.isfinite(), ahead.closest, middle)
        closest = torch.where(possible, trace.closest, passed)
        return Trace(trace.distance, trace.outcome, closest, trace.stopped, trace.evaluations)


@torch.no_grad()
def residuals(scene: Scene, sight: Sight, camera: Camera, accuracy: Accuracy, *, focal: bool) -> Residuals:
    """Along rays: how far depth, outline and normals are off; and their change with turn, shift and log focal length.

    A depth is off by (z − z_observed) · |∇f · v|, which is how far the surface is from the observed point. A ray that
    should hit and does not is off by the least value of f on it, and so is one that hits and should not; all three
    change with the shape's motion dp by ∇f · dp.
    """
    rays = camera.rays(sight.pixels)
    bounds = meet_sphere(rays)
    trace = scene.trace(rays, bounds)
    lacking, extra = sight.is_object & ~trace.hit, sight.is_background & trace.hit
    seen = trace.hit & (sight.depth.isfinite() | (sight.normal.norm(dim=-1) > 0.5))
    t = torch.where(trace.hit, trace.distance, trace.closest)
    off = (lacking | extra) & bounds.meets
    t[off] = minimum(scene.sdf, rays[off], t[off], Bounds(bounds.near[off], bounds.far[off]))
    astray = lacking & ~bounds.meets
    rows = (off | astray | seen).nonzero()[:, 0]
    here = _Here.of(camera, rays[rows], t[rows], focal)
    value, gradient = value_and_gradient(scene.near, here.points)
    gradient = torch.where(astray[rows, None], torch.nn.functional.normalize(here.points, dim=-1), gradient)
    value = torch.where(astray[rows], here.points.norm(dim=-1) - CORE, value)
    parts = []
    silhouette = (off | astray)[rows]
    parts.append(_part(value, here.change(gradient), accuracy.outline, silhouette))
    depth, observed = (t * camera.cosines(sight.pixels))[rows], sight.depth[rows]
    slope = (gradient * rays.directions[rows]).sum(-1).abs() / camera.cosines(sight.pixels[rows])
    parts.append(_part((depth - observed) * slope, here.change(gradient), accuracy.depth, ~silhouette & observed.isfinite()))
    with_normal = ~silhouette & (sight.normal[rows].norm(dim=-1) > 0.5)
    if with_normal.any():
        off_normal, change = _normals(scene, here, gradient, rays.directions[rows], with_normal)
        parts.append((((off_normal - sight.normal[rows][with_normal]) / accuracy.normal).reshape(-1), (change / accuracy.normal).flatten(0, 1)))
    values, jacobian = (torch.cat(part) for part in zip(*parts))
    return Residuals(values, jacobian, torch.full_like(values, 1 / len(sight.pixels)))


def _part(values, jacobian, scale, where):
    return values[where] / scale, jacobian[where] / scale


@dataclass(frozen=True)
class _Here:
    points: Tensor
    rotation: Tensor  # world to camera
    motion: Tensor  # [n, 3, unknowns] of points in the camera's axes, by the unknowns, at fixed depth

    @staticmethod
    def of(camera, rays, t, focal):
        rotation, translation = object_in_camera(camera)
        points = rays.at(t)
        about = points @ rotation.T  # seen from the middle of the object, in the camera's axes
        axes = torch.eye(3, dtype=about.dtype, device=about.device)
        turn = torch.linalg.cross(about[:, None], axes[None]).transpose(1, 2)
        columns = [turn, -axes.expand(len(about), 3, 3)]
        if focal:
            across = (about + translation) * about.new_tensor([-1.0, -1.0, 0.0])
            columns.append(across[:, :, None])
        return _Here(points, rotation, torch.cat(columns, dim=2))

    def change(self, gradient):
        return torch.einsum("nk,nku->nu", gradient @ self.rotation.T, self.motion)


def _normals(scene, here, gradient, directions, which):
    """Normals in the camera's axes, and their change: as the shape turns, and as the hit slides over its bends."""
    unit = torch.nn.functional.normalize(gradient[which], dim=-1)
    side = torch.linalg.cross(unit, unit.roll(1, -1) + 0.1)
    tangents = torch.stack([side, torch.linalg.cross(unit, side)], dim=1)
    tangents = torch.nn.functional.normalize(tangents, dim=-1)
    around = here.points[which, None] + APART * torch.cat([tangents, -tangents], dim=1)
    _, gradients = value_and_gradient(scene.near, around)
    ahead, behind = torch.nn.functional.normalize(gradients, dim=-1).split(2, dim=1)
    bend = (ahead - behind) / (2 * APART)  # [n, tangent, 3]
    ray = directions[which]
    motion = torch.einsum("kj,nku->nju", here.rotation, here.motion[which])  # world axes
    slide = torch.einsum("nj,nju->nu", unit, motion) / (unit * ray).sum(-1).clamp_max(-0.05)[:, None]
    motion = motion - ray[:, :, None] * slide[:, None]
    change = torch.einsum("nsk,nsj,nju->nku", bend, tangents, motion)
    turned = torch.einsum("ik,nku->niu", here.rotation, change)
    normal = unit @ here.rotation.T
    axes = torch.eye(3, dtype=normal.dtype, device=normal.device)
    turned[..., :3] -= torch.linalg.cross(normal[:, None], axes[None]).transpose(1, 2)
    return normal, turned


def _around(mask: Bool[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
    """A box around the object, half as large again to each side."""
    rows, columns = (mask.any(axis).nonzero()[:, 0] for axis in (1, 0))
    box = torch.zeros_like(mask)
    top, left, height, width = rows[0], columns[0], rows[-1] - rows[0] + 1, columns[-1] - columns[0] + 1
    y, x = (int(edge - size // 2) for edge, size in ((top, height), (left, width)))
    box[max(y, 0) : y + 2 * int(height), max(x, 0) : x + 2 * int(width)] = True
    return box


def _some(region: Bool[Tensor, "height width"], count: int, random: torch.Generator) -> Tensor:
    pixels = region.reshape(-1).nonzero()[:, 0]
    return pixels[torch.randperm(len(pixels), generator=random)[:count]]
