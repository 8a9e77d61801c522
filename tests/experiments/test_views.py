"""References of random views, which the experiment keeps between runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_random_views import BALL, CAUTIOUS

from distrace.benchmarks.agreement import measure_view
from distrace.fields.primitives import sphere
from experiments.commands.views import FieldPlan


def test_a_reference_is_kept_and_read_again(tmp_path: Path) -> None:
    kept = FieldPlan(("sofas",), 1, (16, 16), 0, None, tmp_path).reference
    first = measure_view(BALL, "cautious", CAUTIOUS, kept)
    (path,) = tmp_path.iterdir()
    with np.load(path) as content:
        assert content["depth"].shape == first.truth.shape
    np.savez(path, depth=first.truth.numpy() + 1, seconds=np.float32(7))
    again = measure_view(BALL, "cautious", CAUTIOUS, kept)
    assert again.row.reference_seconds == 7
    torch.testing.assert_close(again.truth, first.truth + 1)
    other = replace(BALL, sdf=sphere(0.4))
    assert measure_view(other, "cautious", CAUTIOUS, kept).row.pixels < first.row.pixels
    path.write_bytes(b"no archive")
    with pytest.raises(ValueError, match="holds no reference"):
        measure_view(BALL, "cautious", CAUTIOUS, kept)
