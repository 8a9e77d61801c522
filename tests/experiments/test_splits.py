"""The splits of the bundled models."""

import pytest

from experiments.datasets.splits import CLASSES, read_split


@pytest.mark.parametrize("name", CLASSES)
def test_in_a_bundled_split_each_design_is_on_one_side_and_each_shape_is_free(name: str) -> None:
    shapes = read_split(name)
    assert len({shape.name for shape in shapes}) == len(shapes)
    assert len({shape.path for shape in shapes}) == len(shapes)
    assert {shape.split for shape in shapes} >= {"train", "test"}
    assert all(bool(shape.note) == (shape.split == "out") for shape in shapes), "what is left out says why"
    shapes = [shape for shape in shapes if shape.split != "out"]
    assert [shape.split for shape in shapes].count("test") >= 0.2 * len(shapes)
    sides = {
        design: {shape.split for shape in shapes if shape.design == design} for design in {s.design for s in shapes}
    }
    assert [design for design, splits in sides.items() if len(splits) > 1] == []
    free = ("GPL-2.0-or-later",) if name == "planes" else ("CC0", "CC-BY")
    assert all(shape.licence.startswith(free) and shape.creator for shape in shapes)
    assert not any("NC" in shape.licence or "ND" in shape.licence for shape in shapes)


def test_of_parked_planes_none_is_of_a_held_out_design_and_what_is_left_out_says_why() -> None:
    """They are learnt beside the split `planes`, which holds designs out."""
    planes, parked = read_split("planes"), read_split("parked-planes")
    learnt = [shape for shape in parked if shape.split == "train"]
    assert {shape.split for shape in parked} == {"train", "out"}
    assert not {shape.design for shape in learnt} & {shape.design for shape in planes if shape.split == "test"}
    assert not {shape.name for shape in learnt} & {shape.name for shape in planes}
    assert all(bool(shape.note) == (shape.split == "out") for shape in parked)
    assert {shape.licence for shape in parked} == {"GPL-2.0-or-later"}
    assert len({shape.path for shape in parked}) == len(parked)


def test_the_sofas_are_sixteen_to_train_on_and_at_least_five_held_out() -> None:
    splits = [shape.split for shape in read_split("sofas")]
    assert splits.count("train") == 16
    assert splits.count("test") >= 5
