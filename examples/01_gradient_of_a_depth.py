"""Render a sofa, and ask what its depth would have to do for the sofa to stand a little nearer.

    python examples/01_gradient_of_a_depth.py [OUT.png]

The same lines as in the README. The gradient is exact: its last line compares it with a finite difference.
"""

import sys
from pathlib import Path

import torch

import distrace as dt
from distrace import shading

model = dt.load_model("sofas")
code = model.codes[0].clone().requires_grad_()
camera = dt.Camera.orbit(azimuth=30, elevation=20, distance=4.97, focal_mm=60, sensor_mm=32, height=256, width=256)
buffers = dt.render(model.field(code), camera)
seen = buffers.mask
target = buffers.depth.detach() - 0.01
loss = (buffers.depth - target)[seen].abs().mean()
loss.backward()
print(
    seen.sum().item(), "pixels,", buffers.trace.total_evaluations, "evaluations, |dL/dcode| =", code.grad.norm().item()
)

direction = 1e-3 * code.grad / code.grad.norm()
with torch.no_grad():
    far, near = (dt.render(model.field(code + sign * direction), camera).depth for sign in (1, -1))
change = (far - near) / 2
smooth = change.abs() < 0.01  # an outline that moved across a pixel is no derivative of its depth
expected = torch.autograd.grad(dt.render(model.field(code), camera).depth[smooth].mean(), code)[0] @ direction
print("along the gradient:", expected.item(), "finite difference:", change[smooth].mean().item())

images = [
    shading.shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions),
    shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera),
    shading.depth_picture(buffers.depth),
]
shading.save_png(Path(sys.argv[1] if len(sys.argv) > 1 else "out/example.png"), shading.side_by_side(images))
