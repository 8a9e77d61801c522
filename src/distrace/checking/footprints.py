"""Derivatives of footprint normals at a few hits, over steps that move the hits by a part of the footprint."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.moves import Move
from distrace.checking.retrace import Retraced, root_near
from distrace.fields.base import SDF
from distrace.pixels import thinned
from distrace.render import Buffers

MOST_HITS = 256
CHORDS = 10  # more than for the other rows, since steps are longer
STEP_OF_VIEW = 1 / 20  # footprint widths to each side, for moves of the camera or of the shape
STEP_OF_FIELD = 1 / 400  # the same for changes of the field, whose distances are not linear over longer steps


@dataclass(frozen=True)
class Footprints:
    """At most MOST_HITS hits of a view, with the median width of a footprint.

    A difference step moves the median hit by STEP_OF_VIEW or STEP_OF_FIELD widths to each side. A code that moves the
    surface by a whole pixel makes another shape: over such a step derivatives of the hits are off by up to 30 %.
    """

    view: Retraced
    chosen: Bool[Tensor, "height width"]
    slope: Float[Tensor, "n"]  # of f along the ray
    width: float

    @staticmethod
    def of(view: Retraced, sdf: SDF, camera: Camera) -> "Footprints":
        chosen = thinned(view.trace.hit, MOST_HITS)
        footprints = Footprints(view, chosen, view.slope[chosen[view.trace.hit]], 0.0)
        with torch.no_grad():
            widths = footprints._buffers(sdf, camera, view.trace.distance[chosen]).footprint_widths
        return replace(footprints, width=float(widths.median()))

    def step(self, of_field: bool) -> float:
        """Returns how far a difference step moves the median hit."""
        return (STEP_OF_FIELD if of_field else STEP_OF_VIEW) * self.width

    def pixels(self) -> Tensor:
        """Returns the (x, y) of the hits."""
        return self.chosen.nonzero().flip(-1)

    def slopes(self, move: Move, step: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"]]:
        """Returns derivatives of footprint normals, and central differences; NaN where a hit is lost."""
        by_autograd = derivatives(lambda h: self._attached(*move(h)), self.slope)
        speed = by_autograd["hit points"].norm(dim=-1).median()
        if not speed > 0:  # nothing moves, so any step will do
            speed = torch.ones_like(speed)
        normals = {"footprint normal": by_autograd["footprint normal"]}  # for its shape: central differences ignore it
        central, _ = differences(lambda h: self._retraced(*move(h)), normals, float(step / speed), self.slope)
        return normals["footprint normal"], central["footprint normal"]

    def _attached(self, sdf: SDF, camera: Camera) -> Images:
        buffers = self._buffers(sdf, camera, self.view.trace.distance[self.chosen])
        return {"footprint normal": buffers.footprint_normal, "hit points": buffers.points}

    @torch.no_grad()
    def _retraced(self, sdf: SDF, camera: Camera) -> Images:
        distance = self.view.trace.distance[self.chosen]
        roots = root_near(sdf, camera.rays()[self.chosen], distance, self.slope, self.view.precision.zero, CHORDS)
        lost = roots.isnan()
        normals = self._buffers(sdf, camera, torch.where(lost, distance, roots)).footprint_normal
        return {"footprint normal": normals.masked_fill(lost[:, None], torch.nan)}

    def _buffers(self, sdf: SDF, camera: Camera, distance: Float[Tensor, "n"]) -> Buffers:
        trace = replace(self.view.trace[self.chosen], distance=distance)
        rays = camera.rays()[self.chosen]
        cosines = camera.cosines()[self.chosen]
        pixel = camera.pixel_angle()[self.chosen]
        return Buffers(sdf, rays, cosines, trace, self.view.radius, pixel=pixel)
