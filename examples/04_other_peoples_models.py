"""Renders a shape of every DeepSDF experiment in a folder, or prints why it cannot be read.

    pip download --no-deps deepsdfstruct  # unit cells of lattices; Apache-2.0
    unzip deepsdfstruct-*.whl 'DeepSDFStruct/trained_models/*' -d out
    python examples/04_other_peoples_models.py out/DeepSDFStruct/trained_models out/models.png

`load_model` reads the dialects of DeepSDF's checkpoints. These decoders fill the cube [-1, 1]³, so the field is cut to
it. Their gradients reach 2.2, so the march steps by f alone.
"""

import sys
from pathlib import Path

import torch

import distrace as dt
from distrace.fields.primitives import box, intersection
from distrace.shading import save_png, shaded_picture, side_by_side

source, out = map(Path, sys.argv[1:])
camera = dt.Camera.orbit(30, 20, 6.8, height=256, width=256)
march = dt.TraceConfig(steps=200, step_scale=1.0, coarse_levels=0)
pictures = []
for folder in sorted(source.iterdir()):
    try:
        model = dt.load_model(folder)
    except ValueError as error:
        print(f"{folder.name}: {error}")
        continue
    field = intersection(model.field(0), box(torch.ones(3)))
    buffers = dt.render(field, camera, radius=3**0.5, config=march)
    pictures.append(shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions))
    print(f"{folder.name}: {len(model.codes)} codes, {int(buffers.mask.sum())} pixels")
save_png(out, side_by_side(pictures))
