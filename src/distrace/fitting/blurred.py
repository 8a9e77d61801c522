"""A first approach to a camera, by blurred images of normals: on flat faces single rays feel no edge until it crosses
them, and say nothing of where the face is."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from distrace.camera import Camera
from distrace.data.observation import View
from distrace.fields.base import value_and_gradient
from distrace.fitting.alignment import Still
from distrace.fitting.solver import Residuals
from distrace.pose import turned_object

SIZE = 32  # pixels along the longer side
STEP = 0.02  # of differences: radians, and radii of the unit sphere


@dataclass(frozen=True)
class Blurred:
    """Observed normals in the camera's axes on a coarse grid, zero where unknown; compared are only known parts."""

    shape: Still
    factor: float  # from the view's pixels to the grid's
    known: Float[Tensor, "1 height width"]  # how much of each pixel
    observed: Float[Tensor, "3 height width"]
    sigma: float  # of the blur, in pixels of the grid

    @staticmethod
    def of(shape: Still, view: View, sigma: float) -> "Blurred":
        """Raises `ValueError` for a view without normals."""
        if view.normal is None:
            raise ValueError("the view has no normals to compare")
        factor = min(1.0, SIZE / max(view.depth.shape))
        coarse, known = view.camera.resized(factor), view.normal.any(-1, keepdim=True)
        images = torch.cat([view.normal @ view.camera.T_world_camera[:3, :3], known.to(view.normal)], dim=-1)
        pooled = F.adaptive_avg_pool2d(images.permute(2, 0, 1), (coarse.height, coarse.width))
        return Blurred(shape, factor, pooled[3:], blurred(pooled[:3], sigma), sigma)

    @torch.no_grad()
    def residuals(self, camera: Camera) -> Residuals:
        """How far the images are apart, and by forward differences how that changes as the object turns and shifts."""
        here = self.image(camera)
        changes = []
        for step in STEP * torch.eye(6).to(here):
            changes.append((self.image(turned_object(camera, step[:3], step[3:])) - here).reshape(-1) / STEP)
        values = (here - self.observed).reshape(-1)
        return Residuals(values, torch.stack(changes, dim=-1), torch.full_like(values, 1 / len(values)))

    def image(self, camera: Camera) -> Float[Tensor, "3 height width"]:
        """What the camera sees where normals are known."""
        coarse = camera.resized(self.factor)
        rays = coarse.rays().flat()
        trace = self.shape.trace(rays)
        _, gradient = value_and_gradient(self.shape.sdf, rays[trace.hit].at(trace.distance[trace.hit]))
        normals = torch.zeros_like(rays.directions)
        normals[trace.hit] = F.normalize(gradient, dim=-1) @ camera.T_world_camera[:3, :3]
        return blurred(normals.T.reshape(3, coarse.height, coarse.width) * self.known, self.sigma)


def blurred(image: Float[Tensor, "channels height width"], sigma: float) -> Float[Tensor, "channels height width"]:
    """By a Gaussian; beyond the image there is zero."""
    reach = int(3 * sigma)
    kernel = torch.exp(-(torch.arange(-reach, reach + 1).to(image) ** 2) / (2 * sigma**2))
    kernel = (kernel / kernel.sum())[None, None]
    rows = F.conv2d(image[:, None], kernel[:, :, None, :], padding=(0, reach))
    return F.conv2d(rows, kernel[:, :, :, None], padding=(reach, 0))[:, 0]
