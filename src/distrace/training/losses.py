"""The loss of a field at signed samples (Park et al., CVPR 2019, section 4.1), and its history over a run."""

import torch
from torch import Tensor

from distrace.training.config import TrainConfig

STEPS_PER_LOSS = 100  # steps whose mean loss is one entry of the history; the last entry may have fewer


def training_loss(values: Tensor, distances: Tensor, config: TrainConfig) -> Tensor:
    """The clamped loss, with weights for the few samples that decide the shape.

    Samples whose sign is wrong count `config.wrong_sign` times: they are where thin parts vanish (cf. Duan et al.,
    *Curriculum DeepSDF*, ECCV 2020, section 3.2). Errors above `config.large` count by their squares, as in a reverse
    Huber loss (Laina et al., 3DV 2016, section 3.2): they are where gaps close.
    """
    off = clamped_error(values, distances, config.clamp)
    limit = config.large
    if limit < torch.inf:
        off = torch.where(off > limit, (off.square() + limit**2) / (2 * limit), off)
    return (torch.where(values * distances < 0, config.wrong_sign, 1.0) * off).mean()


def clamped_loss(values: Tensor, distances: Tensor, clamp: float) -> Tensor:
    """Mean |clamp(f) − clamp(d)| (Park et al. 2019, eq. 4)."""
    return clamped_error(values, distances, clamp).mean()


def clamped_error(values: Tensor, distances: Tensor, clamp: float) -> Tensor:
    return (values.clamp(-clamp, clamp) - distances.clamp(-clamp, clamp)).abs()


def record(history: list[float], step: int, value: float) -> None:
    """Adds the loss of step number `step`, counted from 0, to the history."""
    done = step % STEPS_PER_LOSS
    if not done:
        history.append(0.0)
    history[-1] += (value - history[-1]) / (done + 1)
