"""Small motions of photographs' cameras: few are calibrated to a pixel, and no surface pleases views that disagree."""

from dataclasses import replace

import roma
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from distrace.data.photograph import Photograph


def motions(steps: Float[Tensor, "views 6"]) -> Float[Tensor, "views 4 4"]:
    """Each turns about the middle of the unit sphere, by an axis times an angle, and then shifts."""
    turn: Tensor = roma.rotvec_to_rotmat(steps[:, :3])  # pyright: ignore[reportAssignmentType]
    last = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(steps).expand(len(steps), 1, 4)
    return torch.cat([torch.cat([turn, steps[:, 3:, None]], dim=2), last], dim=1)


def relative(steps: Float[Tensor, "views 6"]) -> Float[Tensor, "views 6"]:
    """Without what all of them share: that would move the object, and leave other views behind."""
    return steps - steps.mean(0)


def between(
    steps: Float[Tensor, "views 6"], eyes: Float[Tensor, "views 3"], eye: Float[Tensor, "3"]
) -> Float[Tensor, "6"]:
    """The step of one more camera, as the two nearest have theirs, by angles about the middle of the unit sphere: what
    a gantry or a turntable is off by changes little from view to view."""
    apart = torch.acos(cosine_similarity(eyes, eye, dim=-1).clamp(-1, 1))
    nearest, rows = apart.topk(min(2, len(eyes)), largest=False)
    shares = 1 / nearest.clamp_min(1e-6)
    return (shares / shares.sum()) @ steps[rows]


def moved(photograph: Photograph, motion: Float[Tensor, "4 4"]) -> Photograph:
    """The photograph with its camera moved."""
    camera = photograph.camera
    pose = motion.to(camera.T_world_camera) @ camera.T_world_camera
    return replace(photograph, camera=replace(camera, T_world_camera=pose))


def drift(before: Photograph, after: Photograph) -> float:
    """By how many pixels a camera that moved shows points elsewhere: the mean over six within the unit sphere."""
    points = torch.cat([torch.eye(3), -torch.eye(3)]).to(before.camera.intrinsics) / 2
    (here, _), (there, _) = (each.camera.project(points) for each in (before, after))
    return float((there - here).norm(dim=-1).mean())
