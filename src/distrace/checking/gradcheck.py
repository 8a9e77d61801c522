"""Every derivative of an image against finite differences, on a field and a camera of the user's own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.moves import Change, Move, Tally, all_moves, in_double, own_changes
from distrace.checking.retrace import DOUBLE, SINGLE, Precision, Retraced
from distrace.field import SDF

STRAY = 0.01  # of what is compared: so much may be off, on kinks of ReLU networks that one-sided differences miss
SMALL = 0.1  # of the median derivative: smaller ones are measured against that


@dataclass(frozen=True)
class GradientRow:
    """One quantity by one parameter: errors are relative, and over all components of the parameter."""

    quantity: str
    parameter: str
    median: float
    worst: float
    x: int  # the worst pixel
    y: int
    along: str  # and the component of the parameter
    derivative: tuple[float, ...]
    difference: tuple[float, ...]
    pixels: int  # compared, once for each component
    off: int  # of these, by more than the tolerance
    left_out: int  # a kink, or no surface or minimum on both sides
    agrees: bool


@dataclass(frozen=True)
class GradientCheck:
    """All rows, the precision they were measured in, and how often the field was asked."""

    rows: tuple[GradientRow, ...]
    precision: Precision
    evaluations: int

    @property
    def agrees(self) -> bool:
        return all(row.agrees for row in self.rows)


@dataclass(frozen=True)
class Compared:
    """The derivatives of a quantity's pixels along one component of a parameter."""

    along: str
    derivative: Float[Tensor, "n channels"]
    difference: Float[Tensor, "n channels"]
    error: Float[Tensor, "n"]  # relative; NaN where left out


def check_gradients(
    field: SDF,
    camera: Camera,
    *,
    parameters: Mapping[str, Change] | None = None,
    radius: float = 1.0,
    size: int = 48,
) -> GradientCheck:
    """Compares the derivatives of distance, depth, hit points, normals and clearance with central differences.

    Along the camera's pose and intrinsics, the place of the shape, and the `parameters`: each turns a number h (a
    tensor without axes) into the field moved by h; by default the weights of a network, and the code of a decoder's
    shape. On an image of at most `size` pixels a side, in float64 where the field follows. A pixel is left out, and
    counted, where one-sided differences disagree (a kink: ReLU networks are full of them), where its surface is gone
    on one side, and where the least value on its ray lies on the bounds. Of the others at most STRAY may be off. No
    derivative of a hit sees an outline move, and neither does this.

    Raises `ValueError` where the camera sees nothing of the shape, or for a size below 1.
    """
    if size < 1:
        raise ValueError(f"an image of {size} pixels a side was asked for; it must be at least 1")
    field, changes = in_double(field), own_changes(in_double(field)) if parameters is None else parameters
    like = camera.intrinsics.double()
    moved = [change(like.new_zeros(())) for change in changes.values()]
    precision = DOUBLE if all(_follows(sdf, like) for sdf in (field, *moved)) else SINGLE
    camera = camera.detach().resized(min(size / max(camera.height, camera.width), 1.0))
    matrices = camera.intrinsics.to(precision.dtype), camera.T_world_camera.to(precision.dtype)
    camera = replace(camera, intrinsics=matrices[0], T_world_camera=matrices[1])
    tally = Tally()
    view = Retraced.of(tally.field(field), camera, radius, precision)
    here = view.traced_anew(tally.field(field), camera)
    rows: list[GradientRow] = []
    for parameter, components in all_moves(field, camera, changes).items():
        compared = [_compared(view, here, along, tally.move(move)) for along, move in components.items()]
        rows += [_row(view, quantity, parameter, [by[quantity] for by in compared]) for quantity in compared[0]]
    return GradientCheck(tuple(rows), precision, tally.evaluations)


def _follows(sdf: SDF, like: Tensor) -> bool:
    """Whether a field takes float64 and gives it back."""
    try:
        return sdf(like.new_zeros(1, 3)).dtype == torch.float64
    except RuntimeError:
        return False


def _compared(view: Retraced, here: Images, along: str, move: Move) -> dict[str, Compared]:
    """Every quantity that the view has pixels of."""
    slopes = derivatives(lambda h: view.attached(*move(h)), here["distance"])
    central, bends = differences(lambda h: view.traced_anew(*move(h)), here, view.precision.step, here["distance"])
    return {
        name: compare(along, slopes[name], central[name], bends[name], view.precision)
        for name in central
        if len(central[name])
    }


def compare(along: str, derivative: Tensor, difference: Tensor, bend: Tensor, precision: Precision) -> Compared:
    """Each pixel's relative error; by `bend` the one-sided differences disagree."""
    derivative, difference, bend = (image.reshape(len(image), -1) for image in (derivative, difference, bend))
    size = difference.norm(dim=-1)
    scale = size.clamp_min(max(precision.least, SMALL * float(size.nanmedian().nan_to_num())))
    left_out = ~(bend.norm(dim=-1) <= precision.tolerance * scale)
    error = ((derivative - difference).norm(dim=-1) / scale).nan_to_num(torch.inf, posinf=torch.inf)
    return Compared(along, derivative, difference, error.masked_fill(left_out, torch.nan))


def _row(view: Retraced, quantity: str, parameter: str, compared: list[Compared]) -> GradientRow:
    errors = torch.cat([by.error for by in compared])
    kept, off = ~errors.isnan(), errors > view.precision.tolerance
    at = int(errors.nan_to_num(-1.0, posinf=torch.inf).argmax())
    worst, pixel = compared[at // len(compared[0].error)], at % len(compared[0].error)
    x, y = view.pixels(quantity)[pixel].tolist()
    return GradientRow(
        quantity,
        parameter,
        median=float(errors.nanmedian()),
        worst=float(errors[at]),
        x=x,
        y=y,
        along=worst.along,
        derivative=tuple(worst.derivative[pixel].tolist()),
        difference=tuple(worst.difference[pixel].tolist()),
        pixels=int(kept.sum()),
        off=int(off.sum()),
        left_out=int((~kept).sum()),
        agrees=bool(errors[at].isfinite() and off.sum() <= STRAY * kept.sum()),
    )
