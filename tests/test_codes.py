"""Codes by number, name and file."""

from pathlib import Path

import numpy as np
import pytest

import distrace as dt
from distrace.checkpoints.codes import named_code


@pytest.mark.parametrize(("given", "shape"), [("1", 1), ("beige-sofa-2-seats", 0)])
def test_codes_by_number_and_name(given: str, shape: int) -> None:
    model = dt.load_model("sofas")
    assert named_code(model, given).equal(model.codes[shape])


def test_codes_that_are_none_end_in_a_sentence(tmp_path: Path) -> None:
    model = dt.load_model("sofas")
    np.save(tmp_path / "short.npy", np.zeros(3))
    for given, said in (("9999", "9999"), ("sofaa", "no shape"), (str(tmp_path / "short.npy"), "256 values")):
        with pytest.raises(ValueError, match=said):
            named_code(model, given)
    with pytest.raises(ValueError, match=r"absent\.npy"):
        named_code(model, str(tmp_path / "absent.npy"))
