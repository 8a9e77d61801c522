"""Every derivative of an image against finite differences, on a field and a camera of the user's own."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.footprints import Footprints
from distrace.checking.moves import Change, Move, Tally, all_moves, in_double, own_changes
from distrace.checking.retrace import DOUBLE, SINGLE, Precision, Retraced
from distrace.fields.base import SDF

STRAY = 0.01  # of what is compared: so much may be off, on kinks of ReLU networks that one-sided differences miss
SMALL = 0.1  # of the median derivative: smaller ones are measured against that
ROUGHLY = 0.2  # the median error up to which a footprint normal's derivative agrees: bundled models' are 0.02 – 0.15

Verdict = Literal["agrees", "disagrees", "zero"]


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
    verdict: Verdict  # "zero": both are zero wherever they were compared, so that nothing was tested
    step: float = 0.0  # by which hits move to either side for the differences; 0: as little as numbers allow

    @property
    def agrees(self) -> bool:
        return self.verdict == "agrees"


@dataclass(frozen=True)
class GradientCheck:
    """All rows, the precision they were measured in, and how often the field was asked."""

    rows: tuple[GradientRow, ...]
    precision: Precision
    evaluations: int

    @property
    def agrees(self) -> bool:
        """Whether no row disagrees; a row of zeros does not."""
        return not any(row.verdict == "disagrees" for row in self.rows)

    def verdicts(self) -> dict[Verdict, int]:
        """How many rows have each verdict."""
        every: tuple[Verdict, ...] = get_args(Verdict)
        return {verdict: sum(row.verdict == verdict for row in self.rows) for verdict in every}


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
    """Compares derivatives of distance, depth, hit points, normals, clearance and footprint normals with differences.

    Along the camera's pose and intrinsics, the place of the shape, and the `parameters`: each turns a number h (a
    tensor without axes) into the field moved by h; by default the weights of a network, and the code of a decoder's
    shape. On an image of at most `size` pixels a side, in float64 where the field follows. A pixel is left out, and
    counted, where one-sided differences disagree (a kink: ReLU networks are full of them), where its surface is gone
    on one side, and where the least value on its ray lies on the bounds. Of the others at most STRAY may be off. A row
    whose derivatives and differences are all zero gets the verdict "zero", not "agrees". No derivative of a hit sees an
    outline move, and neither does this.

    Footprint normals are compared at a few hits, over steps that move these by a part of the footprint (see
    `Footprints`), kinks and all; the row agrees if the median error is at most ROUGHLY.

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
    footprints = Footprints.of(view, tally.field(field), camera)
    rows: list[GradientRow] = []
    for parameter, components in all_moves(field, camera, changes).items():
        moves = {along: tally.move(move) for along, move in components.items()}
        compared = [_compared(view, here, along, move) for along, move in moves.items()]
        rows += [_row(view, quantity, parameter, [by[quantity] for by in compared]) for quantity in compared[0]]
        rows.append(_footprint_row(view, footprints, parameter, moves, parameter in changes))
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


def compare(along: str, derivative: Tensor, difference: Tensor, bend: Tensor | None, precision: Precision) -> Compared:
    """Each pixel's relative error; by `bend` the one-sided differences disagree, and None leaves no kinks out."""
    derivative, difference = (image.reshape(len(image), -1) for image in (derivative, difference))
    size = difference.norm(dim=-1)
    scale = size.clamp_min(max(precision.least, SMALL * float(size.nanmedian().nan_to_num())))
    bent = torch.zeros_like(size) if bend is None else bend.reshape(len(bend), -1).norm(dim=-1)
    left_out = size.isnan() | ~(bent <= precision.tolerance * scale)
    error = ((derivative - difference).norm(dim=-1) / scale).nan_to_num(torch.inf, posinf=torch.inf)
    return Compared(along, derivative, difference, error.masked_fill(left_out, torch.nan))


def _footprint_row(
    view: Retraced, footprints: Footprints, parameter: str, moves: Mapping[str, Move], of_field: bool
) -> GradientRow:
    """The row of footprint normals by a parameter, which is of the field itself or of what sees it."""
    step = footprints.step(of_field)
    found = {along: footprints.both(move, step) for along, move in moves.items()}
    compared = [compare(along, *both, None, view.precision) for along, both in found.items()]
    row = _row(view, "footprint normal", parameter, compared, footprints.pixels(), ROUGHLY)
    if row.verdict == "zero":
        return replace(row, step=step)
    return replace(row, step=step, verdict="agrees" if row.median <= ROUGHLY else "disagrees")


def _row(
    view: Retraced,
    quantity: str,
    parameter: str,
    compared: list[Compared],
    pixels: Tensor | None = None,
    tolerance: float | None = None,
) -> GradientRow:
    """The pixels' (x, y) and the tolerance are the view's where they are not given."""
    tolerance = view.precision.tolerance if tolerance is None else tolerance
    errors = torch.cat([by.error for by in compared])
    kept, off = ~errors.isnan(), errors > tolerance
    at = int(errors.nan_to_num(-1.0, posinf=torch.inf).argmax())
    worst, pixel = compared[at // len(compared[0].error)], at % len(compared[0].error)
    x, y = (view.pixels(quantity) if pixels is None else pixels)[pixel].tolist()
    agrees = bool(errors[at].isfinite() and off.sum() <= STRAY * kept.sum())
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
        verdict="disagrees" if not agrees else "zero" if _zero(compared, view.precision) else "agrees",
    )


def _zero(compared: list[Compared], precision: Precision) -> bool:
    """Whether derivatives and differences are zero, as far as can be told, at all but STRAY of what is compared."""
    sizes = [torch.cat([by.derivative, by.difference], dim=-1).abs().amax(-1) for by in compared]
    kept = ~torch.cat([by.error for by in compared]).isnan()
    some = torch.cat(sizes)[kept] > precision.tolerance * precision.least
    return bool(some.sum() <= STRAY * len(some))
