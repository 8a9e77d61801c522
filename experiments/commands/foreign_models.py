"""Models that other people trained, rendered or refused, such as those of `pip download --no-deps deepsdfstruct`.

These decoders fill the cube [-1, 1]³, so their fields are cut to it. Some decode mirrored tiles, with a code that
varies over space.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image, ImageDraw

import distrace as dt
from distrace.antialiasing import clay_picture
from distrace.cli.common import show_table
from distrace.cli.console import start
from distrace.fields.primitives import box, intersection
from distrace.shading import Picture, save_png, side_by_side

CAUTIOUS = dt.TraceConfig(steps=200, step_scale=1.0, coarse_levels=0)  # gradients reach 2.2: longer steps diverge
SIZE = 128  # pixels


@dataclass(frozen=True)
class ForeignModels:
    """Render a shape of every DeepSDF experiment in a folder, or record why it cannot be read."""

    source: tyro.conf.Positional[Path]  # a folder of experiments, such as DeepSDFStruct/trained_models
    out: Path = Path("out/foreign-models")

    def run(self) -> None:
        run = start(self.out)
        pictures: list[Picture] = []
        rows = [_row(folder, pictures) for folder in sorted(self.source.iterdir())]
        if pictures:
            save_png(run.out / "foreign-models.png", side_by_side(pictures))
        show_table(rows)
        evaluations = sum(int(row.get("evaluations", 0)) for row in rows)
        run.finish({"rows": rows, "evaluations": evaluations})


def tiled(model: dt.Model, tiles: int) -> dt.SDF:
    """Returns the field of tiles³ mirrored cells, whose code is interpolated between the corners of the cells."""
    grid = model.codes[: (tiles + 1) ** 3].T.reshape(1, -1, tiles + 1, tiles + 1, tiles + 1)  # the first shape

    def field(points: torch.Tensor) -> torch.Tensor:
        codes = torch.nn.functional.grid_sample(grid, points.reshape(1, -1, 1, 1, 3), align_corners=True)
        local = 1 - 2 * (tiles * (points + 1) / 2 % 2 - 1).abs()  # every other tile is a mirror image
        return model.decoder(local, codes[0, :, :, 0, 0].T.reshape(*points.shape[:-1], -1))

    return dt.chunked(field, 4096)


def _row(folder: Path, pictures: list[Picture]) -> dict[str, str | int]:
    try:
        model = dt.load_model(folder)
    except ValueError as error:
        return {"name": folder.name, "refused": str(error)}
    tiling = json.loads((folder / "specs.json").read_text()).get("Tiling")
    field = intersection(tiled(model, tiling[0]) if tiling else model.field(0), box(torch.ones(3)))
    camera = dt.Camera.orbit(30, 20, 6.8, height=SIZE, width=SIZE)
    buffers = dt.render(field, camera, radius=3**0.5, config=CAUTIOUS)
    picture = Image.fromarray(clay_picture(buffers))
    ImageDraw.Draw(picture).text(
        (SIZE / 2, SIZE - 1), folder.name.removeprefix("test_experiment_"), "black", anchor="ms"
    )
    pictures.append(np.array(picture))
    counts = {"code_length": model.codes.shape[1], "codes": len(model.codes), "layers": model.decoder.depth}
    evaluations = buffers.trace.total_evaluations
    return {"name": folder.name, **counts, "hits": int(buffers.mask.sum()), "evaluations": evaluations}
