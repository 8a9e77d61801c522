"""Corrections of cameras: few are calibrated to a pixel, and no surface fits views that disagree."""

from copy import deepcopy
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from distrace.data.photograph import Photograph
from distrace.pose import exp_se3
from distrace.reconstruction.losses import PixelSampler, loss_terms
from distrace.reconstruction.matching import PatchMatching
from distrace.reconstruction.state import ReconstructConfig, Reconstruction

STEPS = 100  # of a registration, …
RAYS = 1024  # … the rays of each, …
LEARNING_RATE = 1e-3  # … the rate of the first, in radians and radii, …
SHARPNESS = 400.0  # … and the sharpness of outlines, per radius


def moved(photograph: Photograph, motion: Float[Tensor, "4 4"]) -> Photograph:
    """The photograph with its camera moved."""
    camera = photograph.camera
    pose = motion.to(camera.T_world_camera) @ camera.T_world_camera
    return replace(photograph, camera=replace(camera, T_world_camera=pose))


def pixel_shift(before: Photograph, after: Photograph) -> float:
    """The mean distance, in pixels, between the projections of six points in the unit sphere by both cameras."""
    points = torch.cat([torch.eye(3), -torch.eye(3)]).to(before.camera.intrinsics) / 2
    shift = after.camera.project(points)[0] - before.camera.project(points)[0]
    return float(shift.norm(dim=-1).mean())


def interpolated_step(
    steps: Float[Tensor, "views 6"], eyes: Float[Tensor, "views 3"], eye: Float[Tensor, "3"]
) -> Float[Tensor, "6"]:
    """The step of one more camera, by those of the two nearest in angle about the unit sphere's centre.

    The calibration error of a gantry or a turntable changes little from view to view.
    """
    angles = torch.acos(cosine_similarity(eyes, eye, dim=-1).clamp(-1, 1))
    nearest, rows = angles.topk(min(2, len(eyes)), largest=False)
    weights = 1 / nearest.clamp_min(1e-6)
    return (weights / weights.sum()) @ steps[rows]


def registered(state: Reconstruction, photograph: Photograph, config: ReconstructConfig) -> Photograph:
    """The photograph with its camera registered to a finished surface, which stays: six numbers.

    Held-out views have calibration errors of their own, which say nothing about the surface (Lin et al., *BARF*, ICCV
    2021, section 4.2, evaluates after the same step). Raises `ValueError` for a photograph without a mask.
    """
    view = photograph.at_most(config.sizes[-1])
    sampler = PixelSampler.of([view])
    matching = PatchMatching.of([view], state.device)
    surface = deepcopy(state.surface).requires_grad_(False)
    colour = deepcopy(state.colour).requires_grad_(False)
    step = torch.zeros(1, 6, device=state.device, requires_grad=True)
    optimiser = torch.optim.Adam([step])
    for count in range(STEPS):
        optimiser.param_groups[0]["lr"] = LEARNING_RATE * (1 - count / STEPS)
        random = torch.Generator().manual_seed((config.seed << 32) + count)
        observed = sampler.sample(RAYS, random).to(state.device).moved(exp_se3(step[:, :3], step[:, 3:]))
        terms = loss_terms(observed, matching, surface, colour, random, True, SHARPNESS)
        loss = config.colour * terms["colour"] + config.outline * terms["outline"]
        (step.grad,) = torch.autograd.grad(loss, [step])
        optimiser.step()
    step = step.detach()[0]
    return moved(photograph, exp_se3(step[:3], step[3:]))
