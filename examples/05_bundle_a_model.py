"""Writes a trained model in the small form of the bundled ones: half precision, with weight norm multiplied out.

    python examples/05_bundle_a_model.py EXPERIMENT OUT

The last line compares both forms on one view.
"""

import sys
from pathlib import Path

import torch

import distrace as dt
from distrace.metrics import depth_errors, iou

experiment, out = (Path(argument) for argument in sys.argv[1:3])
large = dt.load_model(experiment)
dt.save_model(out, large)
small = dt.load_model(out)
camera = dt.Camera.orbit(30, 20, 4.97, focal_mm=60, sensor_mm=32, height=256, width=256)
with torch.no_grad():
    first = dt.render(large.field(0), camera)
    second = dt.render(small.field(0), camera)
errors = depth_errors(first.depth, second.depth)
size = (out / "model.safetensors").stat().st_size / 1e6
print(f"{size:.1f} MB; IoU {iou(first.mask, second.mask):.5f}, mean error of depth {errors.mean():.1e}")
