"""Footprint normals of a few hits, as the renderer attaches them and over steps that move the hits."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.moves import Move
from distrace.checking.retrace import Retraced, zero_beside
from distrace.fields.base import SDF
from distrace.pixels import thinned
from distrace.render import Buffers

MOST = 256  # hits
CHORDS = 10  # steps are longer than those of the other rows
ACROSS = 1 / 20  # of the footprint's width: a step to either side, one pixel in all where footprints are ten wide
WITHIN = 1 / 400  # the same where the field itself changes: over longer steps not even its distances are linear


@dataclass(frozen=True)
class Footprints:
    """A few hits of a view, with the width of a footprint there.

    A step to either side moves the median hit by ACROSS of the width as the camera or the shape moves, and by WITHIN
    of it as the field itself changes. A code that moves the surface by a whole pixel makes another shape: over such a
    step the derivatives of the hits themselves are off by up to 30 %.
    """

    view: Retraced
    chosen: Bool[Tensor, "height width"]
    slope: Float[Tensor, "n"]  # of f along the ray
    width: float  # the median

    @staticmethod
    def of(view: Retraced, sdf: SDF, camera: Camera) -> "Footprints":
        chosen = thinned(view.trace.hit, MOST)
        found = Footprints(view, chosen, view.slope[chosen[view.trace.hit]], 0.0)
        with torch.no_grad():
            widths = found._buffers(sdf, camera, view.trace.distance[chosen]).footprint_widths
        return replace(found, width=float(widths.median()))

    def step(self, of_field: bool) -> float:
        return (WITHIN if of_field else ACROSS) * self.width

    def pixels(self) -> Tensor:
        """The (x, y) of the hits."""
        return self.chosen.nonzero().flip(-1)

    def both(self, move: Move, step: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Derivatives of footprint normals, and differences over ± a step; NaN where a hit is lost on the way."""
        slopes = derivatives(lambda h: self._attached(*move(h)), self.slope)
        moved = slopes["hit points"].norm(dim=-1).median()
        normals = slopes["footprint normal"]
        if not moved > 0:  # nothing moves: any step will do
            moved = torch.ones_like(moved)
        here = {"footprint normal": normals}  # its shape: the central difference does not use the values
        central, _ = differences(lambda h: self._anew(*move(h)), here, float(step / moved), self.slope)
        return normals, central["footprint normal"]

    def _attached(self, sdf: SDF, camera: Camera) -> Images:
        buffers = self._buffers(sdf, camera, self.view.trace.distance[self.chosen])
        return {"footprint normal": buffers.footprint_normal, "hit points": buffers.points}

    @torch.no_grad()
    def _anew(self, sdf: SDF, camera: Camera) -> Images:
        rays, distance = camera.rays()[self.chosen], self.view.trace.distance[self.chosen]
        found = zero_beside(sdf, rays, distance, self.slope, self.view.precision.zero, CHORDS)
        lost = found.isnan()
        normals = self._buffers(sdf, camera, torch.where(lost, distance, found)).footprint_normal
        return {"footprint normal": normals.masked_fill(lost[:, None], torch.nan)}

    def _buffers(self, sdf: SDF, camera: Camera, distance: Float[Tensor, "n"]) -> Buffers:
        trace = replace(self.view.trace[self.chosen], distance=distance)
        rays, cosines, pixel = camera.rays()[self.chosen], camera.cosines()[self.chosen], camera.pixel_angle()
        return Buffers(sdf, rays, cosines, trace, self.view.radius, pixel=pixel[self.chosen])
