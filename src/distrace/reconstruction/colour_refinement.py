"""The end of a reconstruction: the surface stays as it is, and colours are learnt from all that pixels show of it.

Rays that are traced once serve every step, of many more pixels than a step that shapes can afford.
"""

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from distrace.rays import meet_sphere
from distrace.reconstruction.surface_network import ColourNetwork, Surface
from distrace.reconstruction.terms import Pixels, described
from distrace.tracing.sphere_tracing import TraceConfig, sphere_trace

MARCH = TraceConfig(coarse_levels=0, step_scale=1.0, tolerance=3e-4, steps=50, least_step=2e-3)
MOST = 1_000_000  # pixels that are kept
AT_ONCE = 1 << 15


@dataclass(frozen=True)
class Canvas:
    """Where rays of the object's pixels meet the surface, all that colours depend on there, and what they are."""

    points: Float[Tensor, "n 3"]
    normals: Float[Tensor, "n 3"]
    directions: Float[Tensor, "n 3"]
    features: Float[Tensor, "n features"]
    colours: Float[Tensor, "n 3"]

    @staticmethod
    def of(surface: Surface, pixels: Pixels, random: torch.Generator) -> "Canvas":
        """Of pixels of the object; of many, some drawn."""
        rows = pixels.is_object.nonzero()[:, 0].cpu()
        rows = rows[torch.randperm(len(rows), generator=random)[:MOST]]
        parts = [_met(surface, pixels[some.to(pixels.view.device)]) for some in rows.split(AT_ONCE)]
        return Canvas(*(torch.cat(part) for part in zip(*parts, strict=True)))

    def term(self, colour: ColourNetwork, count: int, random: torch.Generator) -> Float[Tensor, ""]:
        """The mean square by which some pixels are off: by amount alone, the joints between stones would be left out,
        for they are few.
        """
        some = torch.randint(len(self.points), (count,), generator=random).to(self.points.device)
        *seen, colours = (getattr(self, part.name)[some] for part in fields(self))
        return F.mse_loss(colour(*seen), colours)


def _met(surface: Surface, pixels: Pixels) -> tuple[Tensor, ...]:
    """Of each field of a canvas, that of pixels whose rays hit."""
    with torch.no_grad():
        trace = sphere_trace(surface, pixels.rays, meet_sphere(pixels.rays), MARCH)
        seen = pixels[trace.hit]
        points = seen.rays.at(trace.distance[trace.hit])
        normals, features = described(surface, points)
    return points, normals, seen.rays.directions, features, seen.colours
