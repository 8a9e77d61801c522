"""A black sphere on white: how the mean of its image falls as it grows, and a sphere that finds its place by it.

    python examples/06_outline_gradient.py

Every pixel is black or white and stays so, whatever is hit: only the outline moves. Its derivative is compared with the
closed form, and with a finite difference of an image of eight times the resolution. Then a sphere moves to where an
image shows another one, without any mask.
"""

import math

import torch

import distrace as dt

SIZE, DISTANCE, FOCAL = 48, 4.97, 60 / 32
march = dt.TraceConfig(tolerance=1e-5, coarse_levels=0)
white = torch.ones(1, dtype=torch.float64)


def black(points, normals, directions):
    return torch.zeros_like(points[:, :1])


def image(centre, radius, size=SIZE):
    def sphere(points):
        return (points - centre).norm(dim=-1) - radius

    camera = dt.Camera.orbit(0, 0, DISTANCE, height=size, width=size, dtype=torch.float64)
    return dt.shade(dt.render(sphere, camera, config=march), black, white)


middle = torch.zeros(3, dtype=torch.float64)
radius = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
image(middle, radius).mean().backward()
with torch.no_grad():
    larger, smaller = (image(middle, radius + step, 8 * SIZE).mean() for step in (0.01, -0.01))
closed = -2 * math.pi * FOCAL**2 * 0.5 * DISTANCE**2 / (DISTANCE**2 - 0.5**2) ** 2
print(
    f"d mean / d radius: {radius.grad:.4f}, finite difference {(larger - smaller) / 0.02:.4f}, closed form {closed:.4f}"
)

target = image(torch.tensor([0.25, -0.1, 0], dtype=torch.float64), 0.45).detach()
place = torch.tensor([-0.15, 0.15, 0.3], dtype=torch.float64, requires_grad=True)  # x, y, radius
adam = torch.optim.Adam([place], lr=0.03)
for _ in range(60):
    adam.zero_grad()
    loss = (image(torch.cat([place[:2], middle[2:]]), place[2]) - target).square().mean()
    loss.backward()
    adam.step()
print("found x, y, radius:", [round(value, 3) for value in place.tolist()], "of 0.25, -0.1, 0.45")
