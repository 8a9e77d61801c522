"""`shapes`: the training shapes of a model, by number and name."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro

from distrace.antialiasing import smooth_outline
from distrace.checkpoints.model import Model, original
from distrace.cli.common import Flag, ModelName, Orbit, default, opened_for
from distrace.cli.console import console, progress, start
from distrace.fields.base import Counted
from distrace.render import render
from distrace.shading import INK, Picture, grid, save_png

SIDE = 96  # pixels of a thumbnail
LABEL = 30  # pixels below it, for the number and the name
LETTER = 10  # pixels
COLUMNS = 12


@dataclass(frozen=True)
class Shapes:
    """List the training shapes of a model by number and name; --thumbnails also draws them.

    Names with ~ are listed with --all: NAME~mirrored and NAME~warped1 are variants of the mesh NAME; CLASS~1, CLASS~2 …
    are procedural shapes, which a program made.
    """

    model: tyro.conf.Positional[ModelName]
    out: Path = Path("out/shapes")
    all: Flag = False  # also list variants and procedural shapes
    name: Annotated[str | None, default("any", "PART")] = None  # list shapes with this part in their names
    thumbnails: Annotated[int | Literal["all"], tyro.conf.arg(metavar="N|all")] = 0
    """number of the listed shapes in the sheet shapes.png, the first ones; 0 for no sheet"""
    device: str = "cpu"

    def run(self) -> None:
        if self.thumbnails != "all" and self.thumbnails < 0:
            raise ValueError(f"--thumbnails {self.thumbnails} was given; give a number of shapes, or all")
        run = start(self.out, self.device)
        model = opened_for(run, self.model)
        listed = self._listed(model.shapes)
        for number in listed:
            console.print(f"{number:>4} {model.shapes[number]}", soft_wrap=True, highlight=False)
        facts: dict[str, object] = {"shapes": model.shapes}
        drawn = listed if self.thumbnails == "all" else listed[: self.thumbnails]
        if drawn:
            with run.noticing():
                sheet, evaluations = _sheet(model, drawn)
            save_png(run.out / "shapes.png", sheet)
            facts |= {"thumbnails": len(drawn), "evaluations": evaluations}
        run.finish(facts, f"{len(listed)} shapes are listed{_kinds(model.shapes)}")

    def _listed(self, shapes: Sequence[str]) -> list[int]:
        """Returns the numbers of the listed shapes. Raises `ValueError` where no name has the part that was given."""
        part = (self.name or "").lower()
        named = [number for number, shape in enumerate(shapes) if part in shape.lower()]
        listed = [number for number in named if self.all or original(shapes[number]) == shapes[number]]
        if part and not listed:
            hint = f"; --all lists {len(named)} variants and procedural shapes" if named else ""
            raise ValueError(f"--name {self.name} was given, and no listed shape has it in its name{hint}")
        return listed


def _kinds(shapes: Sequence[str]) -> str:
    """Returns how many shapes of each kind there are, unless all are of training meshes."""
    originals = {shape for shape in shapes if original(shape) == shape}
    variants = sum(original(shape) in originals for shape in shapes) - len(originals)
    procedural = len(shapes) - len(originals) - variants
    if len(originals) == len(shapes):
        return ""
    return (
        f"; the model has {len(originals)} of meshes, {variants} variants of these (NAME~mirrored, NAME~warped1 …) and"
        f" {procedural} procedural ones (CLASS~1 …), which --all lists"
    )


@torch.no_grad()
def _sheet(model: Model, numbers: Sequence[int]) -> tuple[Picture, int]:
    """Returns the pictures of shapes with their names, and the number of evaluations."""
    camera = Orbit(size=SIDE).camera().to(model.codes.device)
    pictures: list[Picture] = []
    evaluations = 0
    with progress("drawing", len(numbers)) as bar:
        for number in numbers:
            counted = Counted(model.field(number))
            picture = smooth_outline(render(counted, camera), camera)
            evaluations += counted.evaluations
            pictures.append(np.concatenate([picture, _label(str(number), model.shapes[number])]))
            bar.advance(model.shapes[number])
    return grid([pictures[first : first + COLUMNS] for first in range(0, len(numbers), COLUMNS)]), evaluations


def _label(number: str, name: str) -> Picture:
    """Returns a number and a name on white; a name that is too long ends in an ellipsis."""
    from PIL import Image, ImageDraw, ImageFont

    canvas = Image.new("RGB", (SIDE, LABEL), "white")
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(LETTER)
    shown = name
    while draw.textlength(shown, font) > SIDE:
        shown = shown.removesuffix("…")[:-1] + "…"
    for line, text in enumerate((number, shown)):
        draw.text((SIDE / 2, (line + 0.5) * LABEL / 2), text, INK, font, anchor="mm")
    return np.array(canvas)
