"""The camera of one more photograph, brought to agree with a finished reconstruction; the surface stays as it is.

Views that are held out have errors of calibration of their own, which say nothing of the surface (Lin et al., *BARF*,
ICCV 2021, section 4.2, judges after the same step).
"""

from copy import deepcopy

import torch

from distrace.data.photograph import Photograph
from distrace.reconstruction.camera_refinement import motions, moved
from distrace.reconstruction.matching import Matching
from distrace.reconstruction.reconstruct import ReconstructConfig, Reconstruction
from distrace.reconstruction.terms import Pool, terms_of

STEPS, RAYS, RATE = 100, 1024, 1e-3
SHARPNESS = 400.0  # of the outline, per radius


def registered(state: Reconstruction, photograph: Photograph, config: ReconstructConfig) -> Photograph:
    """The photograph with its camera turned and shifted until colours and outline fit best: six numbers.

    Raises `ValueError` for a photograph without a mask.
    """
    device, view = state.surface.last.weight.device, photograph.at_most(config.sizes[-1])
    pool, alone = Pool.of([view]), Matching.of([view], device)
    surface, colour = deepcopy(state.surface).requires_grad_(False), deepcopy(state.colour).requires_grad_(False)
    step = torch.zeros(1, 6, device=device, requires_grad=True)
    optimiser = torch.optim.Adam([step])
    for count in range(STEPS):
        optimiser.param_groups[0]["lr"] = RATE * (1 - count / STEPS)
        random = torch.Generator().manual_seed((config.seed << 32) + count)
        some = pool.drawn(RAYS, random).to(device).moved(motions(step))
        terms = terms_of(some, alone, surface, colour, random, True, SHARPNESS)
        loss = config.colour * terms["colour"] + config.outline * terms["outline"]
        (step.grad,) = torch.autograd.grad(loss, [step])
        optimiser.step()
    return moved(photograph, motions(step.detach())[0])
