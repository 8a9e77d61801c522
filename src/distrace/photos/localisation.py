"""Where photographs let an object be, before anything is known of its shape."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from distrace.data.photograph import Photograph
from distrace.fields.base import SDF
from distrace.photos.colour_segmentation import Regions
from distrace.photos.stage import Stage
from distrace.photos.visual_hull import allowed
from distrace.pose import Similarity
from distrace.render import render

CELLS = 64  # along each axis of the cube around the unit sphere
CLEARLY = 0.6  # the probability from which a pixel counts: a background's is below one half
COARSE = 96  # pixels along the longer side, of masks of typical shapes: at 48 thin legs were lost
WIDEST = 4.0  # × larger or smaller is a mark on the object, or the background
VIEWS = 12  # at most, of those that make hulls


def whereabouts(stage: Stage, typical: Sequence[SDF], like: Similarity) -> Similarity:
    """Where typical shapes must lie for their visual hulls to be as large as the object's, and in the same middle.

    Masks make the hull, or else looks that are rarer outside the unit sphere's image. What views leave open, as that
    below objects seen from above, is in all hulls. The place stays turned as it was; where there is no hull, or one of
    quite another size, as it is.
    """
    masked = [
        view if view.mask is not None else replace(view, mask=likely)
        for view, likely in zip(stage.photographs, _likely(stage), strict=True)
    ]
    some = masked[:: -(-len(masked) // VIEWS)]
    coarse = [each.at_most(COARSE) for each in some]
    known = _Extent.typical([_Extent.of([_silhouette(each, sdf, like) for each in coarse], like) for sdf in typical])
    told = _Extent.of(some, like)
    if known is None or told is None:
        return like
    growth = told.radius / known.radius
    if not 1 / WIDEST < growth < WIDEST:
        return like
    return replace(
        like, translation=told.middle - growth * (known.middle - like.translation), scale=like.scale * growth
    )


@dataclass(frozen=True)
class _Extent:
    """Of a hull: the middle of the box around it, along an object's axes, and the radius about that; in the world."""

    middle: Float[Tensor, "3"]
    radius: Float[Tensor, ""]

    @staticmethod
    def of(views: Sequence[Photograph], like: Similarity) -> "_Extent | None":
        places, solid = allowed(views, CELLS)
        if solid.sum() < 2:
            return None
        turned_back = places[solid] @ like.rotation
        middle = (turned_back.amin(0) + turned_back.amax(0)) / 2
        return _Extent(like.turned(middle), (turned_back - middle).norm(dim=-1).max())

    @staticmethod
    def typical(extents: "Sequence[_Extent | None]") -> "_Extent | None":
        """The medians of those that there are: a single shape may have lost its legs."""
        found = [each for each in extents if each is not None]
        if not found:
            return None
        middles, radii = (torch.stack([getattr(each, name) for each in found]) for name in ("middle", "radius"))
        return _Extent(middles.median(0).values, radii.median())


@torch.no_grad()
def _silhouette(view: Photograph, sdf: SDF, place: Similarity) -> Photograph:
    """The view with a shape's mask."""
    return replace(view, mask=render(sdf, place.camera_in_object(view.camera)).mask)


def _likely(stage: Stage) -> list[Bool[Tensor, "height width"]]:
    """Pixels that look as hardly any do whose rays miss the unit sphere."""
    looks = torch.cat([each.reshape(-1, 4) for each in stage.looks])
    meets = torch.cat(list(stage.meets))
    regions = Regions.of(looks, meets)
    likely = [regions.smooth_probability(each) > CLEARLY for each in stage.looks]
    return [some & meets.reshape(some.shape) for some, meets in zip(likely, stage.meets, strict=True)]
