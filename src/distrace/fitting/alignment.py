"""How far a known shape before a camera is from what was observed: residuals along rays and their exact Jacobian."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from distrace.camera import Camera
from distrace.fields.base import SDF, value_and_gradient
from distrace.fitting.solver import Residuals
from distrace.fitting.visibility import ObservedRays
from distrace.pose import object_in_camera
from distrace.rays import Bounds, Rays, meet_sphere
from distrace.surface import minimum
from distrace.tracing.bounds import Occupancy
from distrace.tracing.sphere_tracing import Trace
from distrace.tracing.tracer import TracerConfig, trace_rays
from distrace.vectors import perpendicular

CURVATURE_STEP = 0.015  # from a hit to where normals tell how the surface bends: a decoder's facets are smaller
CORE = 0.5  # of the unit sphere: rays that miss the sphere are drawn to within
REACH = 0.05  # for the least value on a ray: then to a fifth of that, and to a fifth of that
TRACE_TOLERANCE = 3e-4  # enough for a step of the solver


@dataclass(frozen=True)
class Accuracy:
    """What deviations count alike: of depths and outlines in units of the unit sphere, of normals in radians."""

    depth: float = 0.01
    outline: float = 0.01
    normal: float = 0.2


@dataclass(frozen=True)
class Still:
    """A shape that stays as it is, with the cells that may hold its surface."""

    sdf: SDF
    occupancy: Occupancy

    @staticmethod
    def of(sdf: SDF, like: Tensor) -> "Still":
        ray = Rays(like.new_tensor([[0.0, 0.0, 2.0]]), like.new_tensor([[0.0, 0.0, 1.0]]))
        return Still(sdf, trace_rays(sdf, ray)[1])

    def trace(self, rays: Rays) -> Trace:
        """Where rays hit the shape; `closest`, of those that miss the unit sphere, is where they come nearest to it."""
        trace, _ = trace_rays(self.sdf, rays, config=TracerConfig(tolerance=TRACE_TOLERANCE), occupancy=self.occupancy)
        nearest = -(rays.origins * rays.directions).sum(-1).clamp_max(0)
        return replace(trace, closest=torch.where(trace.closest.isfinite(), trace.closest, nearest))


@torch.no_grad()
def residuals(shape: Still, observed: ObservedRays, camera: Camera, accuracy: Accuracy, *, focal: bool) -> Residuals:
    """Of all rays that disagree, by how the shape turns and shifts before the camera (and the log of its focal length).

    A depth is off by (z − z_observed) · |∇f · v|: how far the surface is from the observed point. A ray that should hit
    is off by the least value of f on it. One that should miss is off by as far as its hit lies from the object that was
    observed, across the view; where the outline itself is on the ray, by the least value, closely, too.
    """
    rays, cosines = camera.rays(observed.pixels), camera.cosines(observed.pixels)
    bounds = meet_sphere(rays)
    trace = shape.trace(rays)
    beyond = observed.is_background & trace.hit & (observed.outside.norm(dim=-1) > 0)
    lacking = torch.where(trace.hit, observed.is_background & ~beyond, observed.is_object)
    astray = lacking & ~bounds.meets
    seen = trace.hit & ~observed.is_background
    t = torch.where(trace.hit, trace.distance, trace.closest)
    low = lacking & observed.is_object & observed.is_background & bounds.meets  # others need not be known so closely
    some = Bounds(bounds.near[low], bounds.far[low])
    t[low] = minimum(shape.sdf, rays[low], t[low], some, reach=REACH, refine=2)
    rows = (lacking | beyond | seen).nonzero()[:, 0]
    here = _Here.of(shape.sdf, camera, rays[rows], t[rows], astray[rows], focal=focal)
    off = (t * cosines - observed.depth)[rows] * here.slope / cosines[rows]
    parts = [
        here.part(here.value, lacking[rows], accuracy.outline),
        here.part(off, (seen & observed.depth.isfinite())[rows], accuracy.depth),
        here.across(observed.outside[rows], beyond[rows], camera, accuracy.outline),
        here.normals(shape.sdf, observed.normal[rows], (seen & observed.has_normal)[rows], accuracy.normal),
    ]
    values, jacobian = (torch.cat(part) for part in zip(*parts))
    weights = torch.full_like(values, 1 / len(observed.pixels))
    weights[len(values) - len(parts[-1][0]) :] /= 3  # of a normal's three parts
    return Residuals(values, jacobian, weights)


@dataclass(frozen=True)
class _Here:
    """Points on rays, and how the points of the shape there move before the camera, by each unknown."""

    points: Float[Tensor, "n 3"]  # in the world …
    seen: Float[Tensor, "n 3"]  # … and in the camera's axes
    directions: Float[Tensor, "n 3"]
    value: Float[Tensor, "n"]
    gradient: Float[Tensor, "n 3"]
    rotation: Float[Tensor, "3 3"]  # from world to camera
    motion: Float[Tensor, "n 3 unknowns"]  # in the camera's axes

    @staticmethod
    def of(sdf: SDF, camera: Camera, rays: Rays, t: Tensor, astray: Tensor, *, focal: bool) -> "_Here":
        """Where rays go astray the field is unknown; there it is a ball's."""
        rotation, translation = object_in_camera(camera)
        points = rays.at(t)
        value, gradient = value_and_gradient(sdf, points)
        value = torch.where(astray, points.norm(dim=-1) - CORE, value)
        gradient = torch.where(astray[:, None], normalize(points, dim=-1), gradient)
        from_middle = points @ rotation.T
        axes = torch.eye(3).to(points).expand(len(points), 3, 3)
        columns = [_crossed(axes, from_middle), axes]
        if focal:
            columns.append(((from_middle + translation) * points.new_tensor([1.0, 1.0, 0.0]))[:, :, None])
        motion = torch.cat(columns, dim=2)
        return _Here(points, from_middle + translation, rays.directions, value, gradient, rotation, motion)

    @property
    def slope(self) -> Float[Tensor, "n"]:
        return (self.gradient * self.directions).sum(-1).abs()

    def part(self, values: Tensor, where: Bool[Tensor, "n"], scale: float) -> tuple[Tensor, Tensor]:
        """Residuals that change as the field does at a fixed point: by −∇f · motion."""
        gradient = self.gradient[where] @ self.rotation.T
        return values[where] / scale, -torch.einsum("nk,nku->nu", gradient, self.motion[where]) / scale

    def across(self, outside: Tensor, where: Bool[Tensor, "n"], camera: Camera, scale: float) -> tuple[Tensor, Tensor]:
        """How far points are from the observed object, at their depth and parallel to the image."""
        seen, motion, z = self.seen[where], self.motion[where], self.seen[where, 2:]
        away, away_by = outside[where].norm(dim=-1), normalize(outside[where], dim=-1)
        lateral = motion[:, :2] - (seen[:, :2] / z)[:, :, None] * motion[:, 2:]
        values = away * z[:, 0] / camera.intrinsics[0, 0]
        return values / scale, torch.einsum("nk,nku->nu", away_by, lateral) / scale

    def normals(self, sdf: SDF, observed: Tensor, where: Bool[Tensor, "n"], scale: float) -> tuple[Tensor, Tensor]:
        """Differences of normals in the camera's axes; they turn with the shape, and as the hit slides over its bends.

        Bends are differences over CURVATURE_STEP: a ReLU network has none but at its facets' edges.
        """
        normal, ray = normalize(self.gradient[where], dim=-1), self.directions[where]
        side = perpendicular(normal)
        tangents = torch.stack([side, torch.linalg.cross(normal, side)], dim=1)
        _, around = value_and_gradient(
            sdf, self.points[where, None] + CURVATURE_STEP * torch.cat([tangents, -tangents], dim=1)
        )
        ahead, behind = normalize(around, dim=-1).split(2, dim=1)
        motion = -torch.einsum("kj,nku->nju", self.rotation, self.motion[where])  # of a fixed point over the shape
        along = torch.einsum("nj,nju->nu", normal, motion) / (normal * ray).sum(-1).clamp_max(-0.05)[:, None]
        slid = torch.einsum("nsj,nju->nsu", tangents, motion - ray[:, :, None] * along[:, None])
        curvature = torch.einsum("nsj,nsu->nju", (ahead - behind) / (2 * CURVATURE_STEP), slid)
        change = torch.einsum("ij,nju->niu", self.rotation, curvature)
        seen = normal @ self.rotation.T
        change[:, :, :3] += _crossed(torch.eye(3).to(seen).expand(len(seen), 3, 3), seen)
        return ((seen - observed[where]) / scale).flatten(), (change / scale).flatten(0, 1)


def _crossed(axes: Float[Tensor, "n 3 3"], vectors: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3 3"]:
    """By each axis of rotation, as columns: axis × vector."""
    return torch.linalg.cross(axes, vectors[:, None]).transpose(1, 2)
