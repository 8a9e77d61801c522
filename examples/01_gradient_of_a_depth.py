"""Renders a bundled sofa, and prints the gradient of a loss on its depth by the shape's code.

    python examples/01_gradient_of_a_depth.py

Writes out/example.png. The lines up to `print` are the README's.
"""

import torch

import distrace as dt
from distrace import shading

# %% The README's example
model = dt.load_model("sofas")
code = model.codes[0].clone().requires_grad_()
camera = dt.Camera.orbit(azimuth=30, elevation=20, distance=4.97, focal_mm=60, sensor_mm=32, height=256, width=256)
buffers = dt.render(model.field(code), camera)
target = buffers.depth.detach() - 0.01  # the sofa, a little closer to the camera
loss = (buffers.depth - target)[buffers.mask].abs().mean()
loss.backward(retain_graph=True)
print(f"{buffers.mask.sum()} pixels, {buffers.trace.total_evaluations} evaluations, |dL/dcode| {code.grad.norm():.3f}")

# %% A derivative against a finite difference
step = 1e-3 * code.grad / code.grad.norm()
with torch.no_grad():
    after = dt.render(model.field(code + step), camera).depth
    before = dt.render(model.field(code - step), camera).depth
difference = (after - before) / 2
smooth = difference.abs() < 0.01  # excludes pixels that an outline crosses
derivative = torch.autograd.grad(buffers.depth[smooth].mean(), code)[0] @ step
print("derivative:", derivative.item(), "finite difference:", difference[smooth].mean().item())

# %% Pictures
images = [
    shading.shaded_picture(buffers.normal, buffers.mask, buffers.rays.directions),
    shading.normal_picture(buffers.normal, buffers.mask, camera.T_world_camera),
    shading.depth_picture(buffers.depth),
]
shading.save_png("out/example.png", shading.side_by_side(images))
