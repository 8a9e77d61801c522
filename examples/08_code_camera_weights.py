"""Optimises a shape's code, a camera, and a network's weights, each by the depths of one view.

python examples/08_code_camera_weights.py
"""

import torch

import distrace as dt

STEPS = 5  # few, to be quick
model = dt.load_model("sofas")
camera = dt.Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=48, width=48)
with torch.no_grad():
    observed = dt.render(model.field(0), camera)


def minimise(name, parameters, rate, rendered):
    adam = torch.optim.Adam(parameters, lr=rate)
    for step in range(STEPS):
        adam.zero_grad()
        loss = dt.losses.depth_loss(rendered(), observed.depth)
        loss.backward()
        adam.step()
        if step in (0, STEPS - 1):
            print(f"{name}, step {step + 1}: loss {loss.item():.4f}")


# %% The code of another sofa
code = model.codes[1].clone().requires_grad_()
minimise("code", [code], 0.01, lambda: dt.render(model.field(code), camera))

# %% A camera that is off by 4° and 3°
angles = torch.tensor([34.0, 23.0], requires_grad=True)  # azimuth, elevation
size = {"height": camera.height, "width": camera.width}
minimise("camera", [angles], 0.8, lambda: dt.render(model.field(0), dt.Camera.orbit(*angles, 4.97, **size)))

# %% The weights, with another sofa's code
weights = list(model.decoder.requires_grad_().parameters())
minimise("weights", weights, 1e-4, lambda: dt.render(model.field(1), camera))
