"""Writes a strip of a model's shapes: shaded above, normals below.

python examples/02_picture_strip.py [MODEL] [OUT.png]
"""

import sys
from pathlib import Path

import torch

import distrace as dt
from distrace import shading

name = sys.argv[1] if len(sys.argv) > 1 else "sofas"
out = Path(sys.argv[2] if len(sys.argv) > 2 else "out/strip.png")
model = dt.load_model(name)
originals = [number for number, shape in enumerate(model.shapes) if "~" not in shape]  # no mirrored or warped copies
camera = dt.Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=256, width=256)
camera = camera.cropped(40, 0, 176, 256)
shaded = []
normals = []
with torch.no_grad():
    for number in originals[:: max(len(originals) // 5, 1)][:5]:
        buffers = dt.render(model.field(number), camera)
        shaded.append(shading.shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions))
        normals.append(shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera))
shading.save_png(out, shading.grid([shaded, normals]))
