"""What samples say of a field (Park et al., CVPR 2019, section 4.1)."""

import torch
from torch import Tensor

from distrace.training.config import TrainConfig


def training_loss(values: Tensor, distances: Tensor, config: TrainConfig) -> Tensor:
    """The clamped loss where samples that matter for the shape, but are few, count more.

    Those with a wrong sign are what thin parts are lost by (cf. Duan et al., *Curriculum DeepSDF*, ECCV 2020, section
    3.2); large errors, of a reverse Huber loss (Laina et al., 3DV 2016, section 3.2), what gaps are filled by.
    """
    off, limit = clamped_error(values, distances, config.clamp), config.large
    if limit < torch.inf:
        off = torch.where(off > limit, (off.square() + limit**2) / (2 * limit), off)
    return (torch.where(values * distances < 0, config.wrong_sign, 1.0) * off).mean()


def clamped_loss(values: Tensor, distances: Tensor, clamp: float) -> Tensor:
    """Mean |clamp(f) − clamp(d)| (Park et al. 2019, eq. 4)."""
    return clamped_error(values, distances, clamp).mean()


def clamped_error(values: Tensor, distances: Tensor, clamp: float) -> Tensor:
    return (values.clamp(-clamp, clamp) - distances.clamp(-clamp, clamp)).abs()
