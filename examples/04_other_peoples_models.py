"""Decoders that somebody else trained: every DeepSDF experiment of a folder is rendered, or refused in one sentence.

    pip download --no-deps deepsdfstruct  # unit cells of lattices; Apache-2.0
    unzip deepsdfstruct-*.whl 'DeepSDFStruct/trained_models/*' -d out
    python examples/04_other_peoples_models.py out/DeepSDFStruct/trained_models out

`load_model` knows the dialects. These decoders fill the cube [-1, 1]³, which no file tells: they are cut to it. The
`primitives_cl…` decode 8 × 8 × 8 mirrored tiles, with a code that varies over space; `tiled` makes a field of them.
"""

import json
import platform
import sys
from importlib.metadata import version
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw

import distrace as dt
from distrace.fields.primitives import box, intersection
from distrace.shading import Picture, save_png, shaded_picture, side_by_side

CAUTIOUS = dt.TraceConfig(steps=200, step_scale=1.0, coarse_levels=0)  # slopes reach 2.2: longer steps would not settle


def tiled(model: dt.Model, tiles: int) -> dt.SDF:
    grid = model.codes[: (tiles + 1) ** 3].T.reshape(1, -1, tiles + 1, tiles + 1, tiles + 1)  # the first shape

    def field(points: torch.Tensor) -> torch.Tensor:
        codes = torch.nn.functional.grid_sample(grid, points.reshape(1, -1, 1, 1, 3), align_corners=True)
        local = 1 - 2 * (tiles * (points + 1) / 2 % 2 - 1).abs()  # every other tile is a mirror image
        return model.decoder(local, codes[0, :, :, 0, 0].T.reshape(*points.shape[:-1], -1))

    return dt.chunked(field, 4096)


def show(folder: Path, pictures: list[Picture]) -> dict[str, str | int]:
    try:
        model = dt.load_model(folder)
    except ValueError as error:
        return {"name": folder.name, "refused": str(error)}
    tiling = json.loads((folder / "specs.json").read_text()).get("Tiling")
    field = intersection(tiled(model, tiling[0]) if tiling else model.field(0), box(torch.ones(3)))
    seen = dt.render(field, dt.Camera.orbit(30, 20, 6.8, height=128, width=128), radius=3**0.5, config=CAUTIOUS)
    picture = Image.fromarray(shaded_picture(seen.normal, seen.mask, seen.rays.directions))
    ImageDraw.Draw(picture).text((64, 127), folder.name.removeprefix("test_experiment_"), "black", anchor="ms")
    pictures.append(np.array(picture))
    counts = {"code_length": model.codes.shape[1], "codes": len(model.codes), "layers": model.decoder.depth}
    return {"name": folder.name, **counts, "hits": int(seen.mask.sum()), "evaluations": seen.trace.total_evaluations}


source, out = map(Path, sys.argv[1:]) if len(sys.argv) == 3 else sys.exit(__doc__)
pictures: list[Picture] = []
rows = [show(folder, pictures) for folder in sorted(source.iterdir())]
head = {"command": " ".join(["python", *sys.argv]), "machine": platform.platform(), "version": version("distrace")}
save_png(out / "foreign-models.png", side_by_side(pictures))
(out / "foreign-models.json").write_text(json.dumps({**head, "rows": rows}, indent=1))
