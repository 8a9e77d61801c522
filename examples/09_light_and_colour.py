"""Finds the light and the colour of a photograph of a known shape, and the shape's size, by `dt.shade`.

    python examples/09_light_and_colour.py

Writes out/light.png: at the start, at the end, and the photograph.
"""

import torch
from torch.nn.functional import normalize

import distrace as dt
from distrace import shading

camera = dt.Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=128, width=128)


# %% An image: Lambert's law, any function of points, normals and ray directions
def image(size, light, colour):
    def lambert(points, normals, directions):
        return colour * (0.1 + (normals @ normalize(light, dim=0)).clamp_min(0)[:, None])

    return dt.shade(dt.render(dt.primitives.torus(size, 0.2), camera), lambert, background=torch.ones(3))


photograph = image(torch.tensor(0.6), torch.tensor([1.0, 1.0, 0.2]), torch.tensor([0.8, 0.3, 0.2]))

# %% Its light, colour and size
size = torch.tensor(0.5, requires_grad=True)
light = torch.tensor([-0.5, 1.0, 1.0], requires_grad=True)
colour = torch.tensor([0.5, 0.5, 0.5], requires_grad=True)
adam = torch.optim.Adam([size, light, colour], lr=0.05)
pictures = []
for _ in range(30):
    adam.zero_grad()
    rendered = image(size, light, colour)
    (rendered - photograph).square().mean().backward()
    adam.step()
    pictures.append(shading.colour_picture(rendered))
print("found", [round(value, 2) for value in torch.cat([size[None], normalize(light, dim=0), colour]).tolist()])
shading.save_png("out/light.png", shading.side_by_side([pictures[0], pictures[-1], shading.colour_picture(photograph)]))
