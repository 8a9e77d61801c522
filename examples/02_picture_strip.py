"""A strip of pictures of a model's shapes: shaded above, normals below.

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
plain = [number for number, shape in enumerate(model.shapes) if "~" not in shape]
camera = dt.Camera.orbit(30, 20, 4.97, focal_px=480, height=256, width=256)
rows: list[list[shading.Picture]] = [[], []]
with torch.no_grad():
    for number in plain[:: max(len(plain) // 5, 1)][:5]:
        buffers = dt.render(model.field(number), camera)
        rows[0].append(shading.shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions)[40:216])
        rows[1].append(shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera)[40:216])
shading.save_png(out, shading.grid(rows))
