"""Checks every derivative of an image against finite differences, on any field and camera."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, differences, image_derivatives
from distrace.checking.moves import Change, Move, counted_moves, in_double, own_changes
from distrace.checking.retrace import DOUBLE, SINGLE, Footprints, Precision, Retraced
from distrace.fields.base import SDF, Counted

STRAY = 0.01  # share of the pixels that may be off: one-sided differences miss some kinks of ReLU networks
LEAST_SCALE = 0.1  # × the median derivative: the scale of relative errors is never below it
ROUGHLY = 0.2  # median error up to which footprint normals agree: those of bundled models have 0.02 – 0.15

Verdict = Literal["agrees", "disagrees", "zero"]


@dataclass(frozen=True)
class GradientRow:
    """The errors of one quantity's derivatives by one parameter: relative, over all components of the parameter."""

    quantity: str
    parameter: str
    median: float
    worst: float
    x: int  # of the worst pixel
    y: int
    along: str  # the component of the parameter at which it is worst
    derivative: tuple[float, ...]
    difference: tuple[float, ...]
    pixels: int  # compared, once for each component
    off: int  # of these, by more than the tolerance
    left_out: int  # kinks, and pixels without surface or minimum on both sides
    verdict: Verdict  # "zero": derivatives and differences are all zero, so the row tests nothing
    step: float = 0.0  # by which differences move the median hit, in radii; 0: `Precision.step` of the parameter

    @property
    def agrees(self) -> bool:
        return self.verdict == "agrees"


@dataclass(frozen=True)
class GradientCheck:
    """All rows, the precision of the differences, and the number of evaluations of the field."""

    rows: tuple[GradientRow, ...]
    precision: Precision
    evaluations: int

    @property
    def agrees(self) -> bool:
        """Whether no row disagrees; a row of zeros counts as neither."""
        return not any(row.verdict == "disagrees" for row in self.rows)

    def verdicts(self) -> dict[Verdict, int]:
        """Returns how many rows have each verdict."""
        names: tuple[Verdict, ...] = get_args(Verdict)
        return {verdict: sum(row.verdict == verdict for row in self.rows) for verdict in names}


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

    It moves the camera's pose and intrinsics, the placement of the shape, and the `parameters`. Each parameter is a
    function from a number h (a tensor without axes) to the field changed by h. By default these are the weights of a
    network, or code and weights of a decoder's shape. The image has at most `size` pixels a side, in float64 where the
    field accepts it.

    Three kinds of pixels are left out and counted: kinks, where one-sided differences disagree; pixels whose surface
    is lost on one side; rays whose minimum lies on the bounds. A row agrees if at most STRAY of the other pixels are
    off. No derivative of a hit knows that an outline moves, so outlines are not part of this check.

    Footprint normals are compared at a few hits, kinks included, over steps of a part of the footprint (see
    `Footprints`). They agree up to a median error of ROUGHLY.

    Raises `ValueError` where the camera sees nothing of the shape, and for a size below 1.

    >>> import distrace as dt
    >>> camera = dt.Camera.orbit(30, 20, 4.97, height=16, width=16)
    >>> sphere = dt.primitives.sphere
    >>> dt.check_gradients(sphere(0.5), camera, parameters={"radius": lambda h: sphere(0.5 + h)}).agrees
    True
    """
    if size < 1:
        raise ValueError(f"an image of {size} pixels a side was given; at least 1 is needed")
    field = in_double(field)
    changes = own_changes(field) if parameters is None else parameters
    like = camera.intrinsics.double()
    changed = [change(like.new_zeros(())) for change in changes.values()]
    precision = DOUBLE if all(_accepts_double(sdf, like) for sdf in (field, *changed)) else SINGLE
    camera = camera.detach().resized(min(size / max(camera.height, camera.width), 1.0))
    intrinsics = camera.intrinsics.to(precision.dtype)
    camera = replace(camera, intrinsics=intrinsics, T_world_camera=camera.T_world_camera.to(precision.dtype))
    counted = Counted(field)
    moves = counted_moves(counted, camera, changes)
    view = Retraced.of(counted, camera, radius, precision)
    values = view.retraced(counted, camera)
    footprints = Footprints.of(view, counted, camera)
    rows: list[GradientRow] = []
    for parameter, components in moves.items():
        compared = [_compare_view(view, values, along, move) for along, move in components.items()]
        for quantity in compared[0]:
            pixels = view.passing if quantity == "clearance" else view.trace.hit
            rows.append(_row(quantity, parameter, [each[quantity] for each in compared], pixels, precision))
        step = footprints.step(of_field=parameter in changes)
        rows.append(_footprint_row(footprints, parameter, components, step))
    return GradientCheck(tuple(rows), precision, counted.evaluations)


def _accepts_double(sdf: SDF, like: Tensor) -> bool:
    """Whether a field takes float64 and returns it."""
    try:
        return sdf(like.new_zeros(1, 3)).dtype == torch.float64
    except RuntimeError:
        return False


def _compare_view(view: Retraced, values: Images, along: str, move: Move) -> dict[str, Compared]:
    """Returns the comparison of every quantity that has pixels."""
    like = values["distance"]
    slopes = image_derivatives(lambda h: view.attached(*move(h)), like)
    central, kinks = differences(lambda h: view.retraced(*move(h)), values, view.precision.step, like)
    return {
        name: compare(along, slopes[name], central[name], kinks[name], view.precision)
        for name in central
        if len(central[name])
    }


def compare(along: str, derivative: Tensor, difference: Tensor, kink: Tensor | None, precision: Precision) -> Compared:
    """Returns each pixel's relative error. `kink` is how far one-sided differences disagree; None keeps all pixels."""
    derivative = derivative.reshape(len(derivative), -1)
    difference = difference.reshape(len(difference), -1)
    size = difference.norm(dim=-1)
    scale = size.clamp_min(max(precision.least, LEAST_SCALE * float(size.nanmedian().nan_to_num())))
    disagreement = torch.zeros_like(size) if kink is None else kink.reshape(len(kink), -1).norm(dim=-1)
    left_out = size.isnan() | ~(disagreement <= precision.tolerance * scale)
    error = ((derivative - difference).norm(dim=-1) / scale).nan_to_num(torch.inf, posinf=torch.inf)
    return Compared(along, derivative, difference, error.masked_fill(left_out, torch.nan))


def _footprint_row(footprints: Footprints, parameter: str, moves: Mapping[str, Move], step: float) -> GradientRow:
    precision = footprints.view.precision
    compared = [compare(along, *footprints.slopes(move, step), None, precision) for along, move in moves.items()]
    row = replace(_row("footprint normal", parameter, compared, footprints.chosen, precision, ROUGHLY), step=step)
    return row if row.verdict == "zero" else replace(row, verdict="agrees" if row.median <= ROUGHLY else "disagrees")


def _row(
    quantity: str,
    parameter: str,
    compared: Sequence[Compared],
    pixels: Bool[Tensor, "height width"],
    precision: Precision,
    tolerance: float | None = None,
) -> GradientRow:
    """Returns the row of a parameter's components, compared at `pixels`; `tolerance` replaces that of the precision."""
    errors = torch.cat([component.error for component in compared])
    valid = ~errors.isnan()
    off = errors > (tolerance or precision.tolerance)
    at = int(errors.nan_to_num(-1.0, posinf=torch.inf).argmax())
    component, pixel = divmod(at, len(compared[0].error))
    worst = compared[component]
    y, x = pixels.nonzero()[pixel].tolist()
    agrees = bool(errors[at].isfinite() and off.sum() <= STRAY * valid.sum())
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
        pixels=int(valid.sum()),
        off=int(off.sum()),
        left_out=int((~valid).sum()),
        verdict="disagrees" if not agrees else "zero" if _all_zero(compared, precision) else "agrees",
    )


def _all_zero(compared: Sequence[Compared], precision: Precision) -> bool:
    """Whether derivatives and differences are zero within the precision at all but STRAY of the compared pixels."""
    sizes = torch.cat([torch.cat([each.derivative, each.difference], dim=-1).abs().amax(-1) for each in compared])
    valid = ~torch.cat([each.error for each in compared]).isnan()
    nonzero = sizes[valid] > precision.tolerance * precision.least
    return bool(nonzero.sum() <= STRAY * len(nonzero))
