"""What only a GPU can show; where there is none, `test_device.py` finds what would meet on two devices."""

from dataclasses import replace

import pytest
import torch
from test_train import CONFIG, SPECS, spheres

from distrace.training import trainer as training
from distrace.training.config import TrainConfig
from distrace.training.trainer import start_training, train

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no GPU")


def losses(config: TrainConfig) -> list[float]:
    device, samples = torch.device("cuda"), spheres(0.3, 0.6)
    run = train(samples.to(device), start_training(len(samples.names), SPECS, config, device), config)
    return [step.loss for step in run]


@pytest.mark.parametrize("bfloat16", [False, True])
def test_recorded_steps_are_those_that_were_recorded(bfloat16: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(CONFIG, bfloat16=bfloat16, warm_up=1)
    recorded = losses(config)
    monkeypatch.setattr(training, "GraphedStep", lambda step: step)
    assert recorded == losses(config)
    assert recorded[-1] < recorded[0]
