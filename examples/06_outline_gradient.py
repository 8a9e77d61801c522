"""Moves a black sphere on white to where an image shows it, without a mask: by the gradient of its outline.

    python examples/06_outline_gradient.py

Every pixel is black or white, so only the outline has a derivative. It is first compared with its closed form.
"""

import math

import torch

import distrace as dt

# %% A black sphere on white
torch.set_default_dtype(torch.float64)
camera = dt.Camera.orbit(0, 0, 4.97, focal_mm=60, sensor_mm=32, height=48, width=48, dtype=torch.float64)
march = dt.TraceConfig(tolerance=1e-5, coarse_levels=0)


def image(centre, radius):
    buffers = dt.render(lambda points: (points - centre).norm(dim=-1) - radius, camera, config=march)
    return dt.shade(buffers, lambda points, normals, directions: torch.zeros_like(points[:, :1]), torch.ones(1))


# %% The derivative of its outline
radius = torch.tensor(0.5, requires_grad=True)
image(torch.zeros(3), radius).mean().backward()
closed_form = -2 * math.pi * (60 / 32) ** 2 * 0.5 * 4.97**2 / (4.97**2 - 0.5**2) ** 2
print(f"d mean / d radius: {radius.grad:.4f}, closed form {closed_form:.4f}")

# %% A sphere that moves to where the image shows it
target = image(torch.tensor([0.25, -0.1, 0.0]), 0.45).detach()
sphere = torch.tensor([-0.15, 0.15, 0.3], requires_grad=True)  # x, y, radius
adam = torch.optim.Adam([sphere], lr=0.03)
for _ in range(60):
    adam.zero_grad()
    loss = (image(torch.cat([sphere[:2], torch.zeros(1)]), sphere[2]) - target).square().mean()
    loss.backward()
    adam.step()
print("found x, y, radius:", [round(value, 3) for value in sphere.tolist()], "of 0.25, -0.1, 0.45")
