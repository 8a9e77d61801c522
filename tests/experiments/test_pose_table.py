"""The protocol of finding cameras again: its trials, its rows, and going on after a stop."""

from pathlib import Path

import pytest
import torch

from distrace.pose import pose_error
from experiments.tables.pose import (
    DISTURBANCES,
    FOCAL,
    OBSERVATIONS,
    SIGMA,
    Found,
    Trial,
    all_trials,
    disturbed,
    pose_page,
    random_camera,
    read_trials,
    rows_of,
    write_trials,
)


def found(k: int, degrees: float, observation: str = "depth", disturbance: str = "10°") -> Found:
    return Found(Trial(observation, disturbance, k), degrees, 0.1, 0.0, 0.0, 1, 2.0, 1000)


def test_the_protocol_has_every_pair_for_every_camera() -> None:
    trials = all_trials(10)
    assert len(trials) == len(set(trials)) == 10 * (len(OBSERVATIONS) * len(DISTURBANCES) + 1)
    assert {trial.camera for trial in trials if trial.observation == FOCAL} == set(range(10))


@pytest.mark.parametrize("degrees", [10, 20, 40, 60])
def test_a_start_is_off_by_what_it_says_and_a_tenth_of_the_distance(degrees: int) -> None:
    random = torch.Generator().manual_seed(3)
    camera = random_camera(random)
    angle, percent = pose_error(disturbed(camera, f"{degrees}°", random), camera)
    assert angle == pytest.approx(degrees, abs=1e-2)
    assert percent == pytest.approx(10, abs=1e-3)


def test_noise_on_quaternions_turns_by_twenty_degrees_or_so() -> None:
    angles = []
    for seed in range(40):
        random = torch.Generator().manual_seed(seed)
        camera = random_camera(random)
        angles.append(pose_error(disturbed(camera, SIGMA, random), camera)[0])
    assert 12 < sum(angles) / len(angles) < 28


def test_a_row_counts_whom_it_found() -> None:
    (row,) = rows_of("sofas", [found(0, 0.1), found(1, 0.2), found(2, 0.6), found(3, 50.0)])
    assert (row["success"], row["n"]) == (0.5, 4)
    assert row["rotation_median_degrees"] == pytest.approx(0.4)
    assert "0.5" in pose_page("sofas", [row])


def test_trials_are_read_again(tmp_path: Path) -> None:
    done, path = [found(0, 0.1), found(1, 0.7, "normal", SIGMA)], tmp_path / "trials.json"
    assert read_trials(path, "sofas") == []
    write_trials(path, "sofas", done)
    assert read_trials(path, "sofas") == done
    with pytest.raises(ValueError, match="holds trials of sofas, not of planes; give another --out"):
        read_trials(path, "planes")
    path.write_text('{"model": "sofas", "trials": [{"observation": "depth"')
    with pytest.raises(ValueError, match="holds no trials; remove it"):
        read_trials(path, "sofas")
