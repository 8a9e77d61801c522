"""`dt.view`: the viewer, for any field."""

import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from distrace.checkpoints.model import Model
from distrace.fields.base import SDF

if TYPE_CHECKING:
    from distrace.viewer.viewer import Viewer


def view(
    sdf: SDF | Model,
    *,
    radius: float = 1.0,
    port: int = 8080,
    out: str | Path = "out/view",
    wait: bool | None = None,
    device: torch.device | str = "cpu",
) -> "Viewer":
    """Shows a field in the browser, at http://127.0.0.1:8080 or the next free port, traced live by `render`.

    `sdf` is any function from points [N, 3] to distances [N], or a model, whose shapes can then be chosen. `radius` is
    that of the sphere about the origin that holds the surface, `device` where the field takes its points. The page's
    button saves to `out`. With `wait` the call returns at Ctrl-C, else at once, with the viewer (`close` ends it); by
    default it waits in scripts, not in notebooks or at a prompt. Needs the extra `view`. Raises `TypeError` for what is
    no field.

    >>> viewer = dt.view(dt.primitives.sphere(0.5), wait=False)  # doctest: +SKIP
    >>> viewer.close()  # doctest: +SKIP
    """
    from distrace.viewer.scene import field_scene
    from distrace.viewer.viewer import Viewer

    viewer = Viewer(field_scene(sdf, radius, device), out, port)
    print(f"distrace: {viewer.address}", flush=True)
    if wait is None:
        wait = not hasattr(sys, "ps1")
    if wait:
        until_interrupted(viewer)
        viewer.close()
    return viewer


def until_interrupted(viewer: "Viewer") -> None:
    """Returns at Ctrl-C."""
    with suppress(KeyboardInterrupt):
        while True:
            time.sleep(1)
