"""The configuration of a training run."""

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class TrainConfig:
    """The schedule: a short warm-up, a constant rate, and a straight line down to zero at `steps`."""

    steps: int = 36_000
    samples_per_step: int = 2048  # half of them outside; small and many steps beat large and few, minute for minute
    shapes_per_step: int = 64
    learning_rate: float = 1e-3
    code_learning_rate: float = 2e-3
    warm_up: int = 500  # steps
    cool_down: float = 0.4  # share of the steps; a run can be prolonged until it begins
    clamp: float = 0.1  # distances are clamped to ± this
    wrong_sign: float = 1.0  # weight of samples whose predicted sign is wrong; raise it when thin parts vanish
    large: float = math.inf  # errors above it count by their squares; 0.02 keeps gaps open
    dwell: int = 1  # oversampling where the initial network has signs wrong
    keep: float = 0.0  # weight of the distillation loss at codes between training shapes
    code_penalty: float = 1e-4
    code_bound: float = 1.0
    code_deviation: float = 0.05  # standard deviation of the initial codes' entries
    variant_weight: float = 0.5  # how often a variant (~ in its name) is drawn, relative to an original
    bfloat16: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        if self.steps < 1 or self.samples_per_step < 1 or not 0 <= self.seed < 2**31:
            given = f"{self.steps} steps of {self.samples_per_step} samples with seed {self.seed}"
            raise ValueError(f"{given} were given; at least one of each, and a seed from 0 to 2³¹ − 1, are needed")
        if not (self.wrong_sign > 0 and self.large > 0):
            given = f"wrong_sign={self.wrong_sign:g} and large={self.large:g}"
            raise ValueError(f"{given} were given; both must be above 0")
        if not (0 < self.learning_rate < math.inf and 0 < self.variant_weight <= 1 and self.dwell >= 1):
            given = f"learning_rate={self.learning_rate:g}, variant_weight={self.variant_weight:g}, dwell={self.dwell}"
            needed = "a rate above 0, a weight above 0 and up to 1, and a whole number from 1"
            raise ValueError(f"{given} were given; {needed} are needed")
        if not 0 <= self.keep < math.inf:
            raise ValueError(f"keep={self.keep:g} was given; 0 or a number above is needed")
