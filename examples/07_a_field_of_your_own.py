"""Renders a field of your own: any function from points [N, 3] to distances [N], negative inside.

    python examples/07_a_field_of_your_own.py

Writes out/field.png: a gyroid cut to a ball, and a tower that is put together from primitives.
"""

import torch

import distrace as dt
from distrace import shading
from distrace.fields.primitives import box, difference, smooth_union, sphere, torus

camera = dt.Camera.orbit(azimuth=30, elevation=20, distance=4.97, focal_mm=60, sensor_mm=32, height=256, width=256)


# %% A formula. Its values need no unit slope: the tracer measures the Lipschitz constant.
def gyroid(points):
    x, y, z = (8 * points).unbind(-1)
    sheet = (x.sin() * y.cos() + y.sin() * z.cos() + z.sin() * x.cos()).abs() / 8 - 0.05
    return torch.maximum(sheet, points.norm(dim=-1) - 0.8)


first = dt.render(gyroid, camera)
first  # a notebook shows the images


# %% Fields made of fields. Numbers may be tensors that require grad.
size = torch.tensor(0.35, requires_grad=True)
tower = smooth_union(box([0.3, 0.7, 0.3]), torus(0.5, 0.15), 0.2)
second = dt.render(difference(tower, sphere(size, [0.1, 0.3, 0.35])), camera)
second.depth[second.mask].mean().backward()
print(f"{int(first.mask.sum())} and {int(second.mask.sum())} pixels; d mean depth / d size {size.grad:.4f}")

# %% A picture of both
views = [shading.shaded_picture(view.normal, view.mask, view.rays.directions) for view in (first, second)]
shading.save_png("out/field.png", shading.side_by_side(views))
