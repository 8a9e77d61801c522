"""`shapes`: the training shapes of a model, by number and name."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro

from distrace.antialiasing import smooth_outline
from distrace.checkpoints.model import Model
from distrace.cli.common import ModelName, Orbit, opened_for
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
    """List the training shapes of a model by number and name; --thumbnails also draws them."""

    model: tyro.conf.Positional[ModelName]
    out: Path = Path("out/shapes")
    thumbnails: Annotated[int | Literal["all"], tyro.conf.arg(metavar="N|all")] = 0
    """number of shapes in the sheet shapes.png, the first ones; 0 for no sheet"""
    device: str = "cpu"

    def run(self) -> None:
        if self.thumbnails != "all" and self.thumbnails < 0:
            raise ValueError(f"--thumbnails {self.thumbnails} was given; give a number of shapes, or all")
        run = start(self.out, self.device)
        model = opened_for(run, self.model)
        for number, name in enumerate(model.shapes):
            console.print(f"{number:>4} {name}", soft_wrap=True, highlight=False)
        facts: dict[str, object] = {"shapes": model.shapes}
        count = len(model.shapes) if self.thumbnails == "all" else min(self.thumbnails, len(model.shapes))
        if count:
            with run.noticing():
                sheet, evaluations = _sheet(model, count)
            save_png(run.out / "shapes.png", sheet)
            facts |= {"thumbnails": count, "evaluations": evaluations}
        run.finish(facts, f"{len(model.shapes)} shapes")


@torch.no_grad()
def _sheet(model: Model, count: int) -> tuple[Picture, int]:
    """Returns the pictures of the first shapes with their names, and the number of evaluations."""
    camera = Orbit(size=SIDE).camera().to(model.codes.device)
    pictures: list[Picture] = []
    evaluations = 0
    with progress("drawing", count) as bar:
        for number in range(count):
            counted = Counted(model.field(number))
            picture = smooth_outline(render(counted, camera), camera)
            evaluations += counted.evaluations
            pictures.append(np.concatenate([picture, _label(str(number), model.shapes[number])]))
            bar.advance(model.shapes[number])
    return grid([pictures[first : first + COLUMNS] for first in range(0, count, COLUMNS)]), evaluations


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
