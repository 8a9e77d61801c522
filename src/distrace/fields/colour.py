"""The colour decoder: a point, its normal, a shape's code and a colour code to the albedo of a matt surface.

After the textured rendering of DIST (Liu et al., CVPR 2020); points enter by sines and cosines too (Mildenhall et al.,
*NeRF*, ECCV 2020), so that neighbouring parts can have sharp borders.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from distrace.colour_space import to_linear

Albedo = Callable[[Float[Tensor, "n 3"], Float[Tensor, "n 3"]], Float[Tensor, "n 3"]]
"""Maps points and unit normals to the linear share of light that a matt surface reflects there."""


@dataclass(frozen=True)
class ColourSpecs:
    """A colour decoder's size."""

    shape_code: int = 256  # the length of the shapes' codes
    colour_code: int = 32
    width: int = 192
    layers: int = 3  # hidden
    frequencies: int = 5  # of the sines and cosines: π, 2π, 4π …


class ColourDecoder(nn.Module):
    """An MLP g(point, normal; shape code, colour code) → sRGB colour, from 0 to 1.

    >>> decoder = ColourDecoder(ColourSpecs(shape_code=8, colour_code=4, width=16))
    >>> decoder(torch.zeros(5, 3), torch.ones(5, 3), torch.zeros(8), torch.zeros(4)).shape
    torch.Size([5, 3])
    """

    def __init__(self, specs: ColourSpecs = ColourSpecs()) -> None:
        super().__init__()
        self.specs = specs
        self.of_points = nn.Linear(6 + 6 * specs.frequencies, specs.width)
        self.of_shape = nn.Linear(specs.shape_code, specs.width, bias=False)
        self.of_colour = nn.Linear(specs.colour_code, specs.width, bias=False)
        self.hidden = nn.ModuleList(nn.Linear(specs.width, specs.width) for _ in range(specs.layers - 1))
        self.out = nn.Linear(specs.width, 3)

    def forward(
        self,
        points: Float[Tensor, "*batch 3"],
        normals: Float[Tensor, "*batch 3"],
        shape_code: Float[Tensor, "*#batch length"],
        colour_code: Float[Tensor, "*#batch colour"],
    ) -> Float[Tensor, "*batch 3"]:
        """Returns colours. Codes with batch axes of size 1 enter once, not per point."""
        scales = math.pi * 2.0 ** torch.arange(self.specs.frequencies).to(points)
        angles = (points[..., None] * scales).flatten(-2)
        x = self.of_points(torch.cat([points, normals, angles.sin(), angles.cos()], dim=-1))
        x = x + self.of_shape(shape_code) + self.of_colour(colour_code)
        for layer in self.hidden:
            x = layer(F.relu(x))
        return torch.sigmoid(self.out(F.relu(x)))

    def albedo(self, shape_code: Float[Tensor, "length"], colour_code: Float[Tensor, "colour"]) -> Albedo:
        """Returns the albedo of one shape in the unit sphere, as `lights.lit` takes it."""

        def albedo(points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
            return to_linear(self(points, normals, shape_code, colour_code))

        return albedo
