"""A trained experiment folder in the small form that is bundled: weight norm multiplied out, in half precision.

    python examples/05_bundle_a_model.py EXPERIMENT OUT

and how far the small form is from the large one, on one view.
"""

import sys
from pathlib import Path

import torch

import distrace as dt
from distrace.benchmarks.measuring import poster_view
from distrace.checkpoints.model import save_model
from distrace.metrics import depth_errors, iou

experiment, out = (Path(argument) for argument in sys.argv[1:3])
large = dt.load_model(experiment)
save_model(out, large)
small = dt.load_model(out)
with torch.no_grad():
    before, after = (dt.render(model.field(0), poster_view()) for model in (large, small))
errors = depth_errors(before.depth, after.depth)
size = (out / "model.safetensors").stat().st_size / 1e6
print(f"{size:.1f} MB; IoU {iou(before.mask, after.mask):.5f}, depth off by {errors.mean():.1e} in the mean")
