"""The benchmark of gradients: exact and DIST's, against finite differences."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checking.differences import Images, derivatives, differences
from distrace.checking.dist_gradient import Queries, attach_dist, march
from distrace.checking.gradcheck import Compared, compare
from distrace.checking.moves import Change, Move, Tally, all_moves, decoder_changes
from distrace.checking.retrace import DOUBLE, Retraced
from distrace.checkpoints.model import Model
from distrace.fields.base import SDF
from distrace.fields.primitives import box, sphere
from distrace.rays import meet_sphere
from distrace.render import Buffers

EXACT, QUERIES = "exact", (1, 3, 5)
RADIUS = 0.5
HALF = (0.5, 0.3, 0.3)
COUNT = 9 * (1 + len(QUERIES))  # of rows
SIZE = 64  # pixels along each side
SHARE = 0.1  # of the median derivative: no ratio is taken to a smaller one

See = Callable[[SDF, Camera], Images]


@dataclass(frozen=True)
class RatioRow:
    """How the derivatives of depth by a parameter relate to finite differences, over the pixels of an image."""

    field: str
    parameter: str
    method: str
    relative_error: float  # the median
    worst: float
    ratio: float  # of derivative to difference, the median
    ratio_low: float  # and of a tenth of the pixels at either end
    ratio_high: float
    pixels: int
    left_out: int  # a kink, or DIST's march ended without a hit


@dataclass(frozen=True)
class Subject:
    """A field that is seen, and what moves."""

    field: str
    sdf: SDF
    camera: Camera
    moves: dict[str, Move]
    tally: Tally

    @staticmethod
    def of(field: str, sdf: SDF, camera: Camera, changes: dict[str, Change], parameters: tuple[str, ...]) -> "Subject":
        """A parameter with several components moves along the first of them."""
        tally, moves = Tally(), all_moves(sdf, camera, changes)
        counted = {name: tally.move(next(iter(moves[name].values()))) for name in parameters}
        return Subject(field, tally.field(sdf), camera, counted, tally)


def subjects(model: Model, code: int, size: int) -> list[Subject]:
    """A sphere, a box that shows a face at 6° from its plane, and a decoder; all in float64."""
    like = torch.zeros(3, dtype=torch.float64)
    half, place = like.new_tensor(HALF), ("camera translation", "focal length")
    view, aside, wider = (
        Camera.orbit(*at, 4.97, focal_mm=focal_mm, height=size, width=size, dtype=like.dtype)
        for at, focal_mm in (((30, 20), 130), ((81, 8), 130), ((30, 20), 75))  # each shape fills its image
    )
    decoder, latent = deepcopy(model.decoder).double().cpu(), model.codes[code].detach().double().cpu()
    return [
        Subject.of("sphere", sphere(RADIUS), view, {"radius": lambda h: sphere(RADIUS + h)}, ("radius", place[0])),
        Subject.of("box", box(half), aside, {"size": lambda h: box(half + h)}, ("size", *place)),
        Subject.of(
            "decoder", decoder.field(latent), wider, decoder_changes(decoder, latent), ("code", "weights", *place)
        ),
    ]


def ratio_rows(subject: Subject) -> Iterator[tuple[RatioRow, Float[Tensor, "height width"]]]:
    """Each parameter by each method, with the image of the ratio; NaN where there is none."""
    view, rays = Retraced.of(subject.sdf, subject.camera, 1.0, DOUBLE), subject.camera.rays()
    marched = march(subject.sdf, rays, meet_sphere(rays), queries=max(QUERIES))
    missed = marched.distance[view.trace.hit].isinf()
    here = view.retraced_hits(subject.sdf, subject.camera)
    for parameter, move in subject.moves.items():
        central, bend = differences(partial(_moved, view.retraced_hits, move), here, DOUBLE.step, here["depth"])
        kinked = bend["depth"].masked_fill(missed, torch.nan)
        for method, seen in _methods(view, marched).items():
            slopes = derivatives(partial(_moved, seen, move), here["depth"])
            compared = compare(parameter, slopes["depth"], central["depth"], kinked, DOUBLE)
            yield _ratio_row(view, (subject.field, parameter, method), compared)


def _moved(seen: See, move: Move, h: Tensor) -> Images:
    return seen(*move(h))


def _methods(view: Retraced, marched: Queries) -> dict[str, See]:
    """Ways to a differentiable depth."""
    hit = view.trace.hit

    def exact(sdf: SDF, camera: Camera) -> Images:
        return {"depth": Buffers(sdf, camera.rays(), camera.cosines(), view.trace, view.radius).depth[hit]}

    def dist(queries: int, sdf: SDF, camera: Camera) -> Images:
        return {"depth": camera.depth(attach_dist(sdf, camera.rays(), marched, queries))[hit]}

    return {EXACT: exact} | {f"DIST, k = {k}": partial(dist, k) for k in QUERIES}


def _ratio_row(view: Retraced, names: tuple[str, str, str], compared: Compared) -> tuple[RatioRow, Tensor]:
    error, (derivative, difference) = compared.error, (compared.derivative[:, 0], compared.difference[:, 0])
    kept = ~error.isnan()
    told = kept & (difference.abs() > SHARE * difference.abs().nanmedian())
    ratio = (derivative / difference).masked_fill(~told, torch.nan)
    low, middle, high = ratio[told].quantile(ratio.new_tensor([0.1, 0.5, 0.9])).tolist()
    errors, counts = (float(error.nanmedian()), float(error[kept].max())), (int(kept.sum()), int((~kept).sum()))
    image = torch.full_like(view.trace.distance, torch.nan).masked_scatter(view.trace.hit, ratio)
    return RatioRow(*names, *errors, middle, low, high, *counts), image
