"""Live pictures: a thread for each browser, which traces coarse images first, and anew when anything moves."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float

from distrace.camera import Camera
from distrace.render import Buffers, render
from distrace.shading import Picture
from distrace.tracing.bounds import Occupancy
from distrace.viewer.image import LAYERS, SHADED, Image, bands
from distrace.viewer.scene import Scene

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

HEIGHTS = (64, 128, 256, 512)  # rows of the pictures, one after the other, while nothing moves
FAR = 100.0  # depth of the background in radii: behind everything
TRACING = Lock()  # one picture at a time: each uses all cores


@dataclass
class Shown:
    """What all browsers see: a shape, a layer and a light. A change is a new object."""

    scene: Scene
    layer: str = SHADED
    light: Float[np.ndarray, "3"] | None = None
    occupancy: list[Occupancy] = field(default_factory=list)  # at most one, of the scene's field

    @torch.no_grad()
    def trace(self, camera: Camera) -> Buffers:
        """Traces an image, or a band of one; the field is measured only for the first one."""
        known = self.occupancy[0] if self.occupancy else None
        buffers = render(self.scene.sdf, camera.to(self.scene.device), radius=self.scene.radius, occupancy=known)
        if buffers.occupancy is not None:
            self.occupancy[:] = [buffers.occupancy]
        return buffers

    def image(self, camera: Camera) -> Image:
        """Traces a whole image."""
        return Image([self.trace(band) for band in bands(camera)])

    @torch.no_grad()
    def picture(self, image: Image) -> tuple[Picture, str]:
        """Returns the layer's picture and its legend."""
        return LAYERS[self.layer](image, self.light)


def camera_of(handle: "CameraHandle", height: int) -> Camera:
    """Returns a browser's camera, with so many rows of pixels."""
    from viser.transforms import SO3

    width = max(1, round(height * handle.aspect))
    focal = height / 2 / math.tan(handle.fov / 2)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(SO3(np.asarray(handle.wxyz)).as_matrix())
    pose[:3, 3] = torch.from_numpy(np.array(handle.position))
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera.from_matrices(intrinsics, pose, height, width)


class LiveView:
    """Keeps the background of one browser's page at what is shown, as its camera sees it."""

    def __init__(self, client: "ClientHandle", shown: Callable[[], Shown], report: Callable[[str], None]) -> None:
        self.client = client
        self.shown = shown
        self.report = report
        self.changed = Event()
        self.closed = False
        client.camera.on_update(lambda _: self.changed.set())
        self.thread = Thread(target=self._run, name=f"distrace view {client.client_id}", daemon=True)
        self.changed.set()
        self.thread.start()

    def close(self) -> None:
        """Ends the thread after the band that it is at."""
        self.closed = True
        self.changed.set()
        self.thread.join()

    def _run(self) -> None:
        while self.changed.wait() and not self.closed:
            self.changed.clear()
            for height in HEIGHTS:
                if height > max(self.client.camera.image_height, HEIGHTS[0]):
                    break
                self._trace(height)
                if self.changed.is_set():
                    break

    def _trace(self, height: int) -> None:
        """Sends one picture, unless the camera or the shape moves meanwhile; the coarsest one in any case."""
        shown = self.shown()
        camera = camera_of(self.client.camera, height)
        began = time.perf_counter()
        traced: list[Buffers] = []
        try:
            for band in bands(camera):
                with TRACING:
                    traced.append(shown.trace(band))
                if self.closed or (self.changed.is_set() and height > HEIGHTS[0]):
                    return
            image = Image(traced)
            picture, legend = shown.picture(image)
        except (ValueError, RuntimeError) as error:
            self.report(f"This view cannot be traced: {error}")
            return
        seconds = time.perf_counter() - began
        depth = np.nan_to_num(image.depth, posinf=FAR)
        self.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90, depth=depth)
        size = f"{camera.width} × {camera.height}"
        self.report(f"{size} pixels, {image.total_evaluations:,} evaluations, {seconds:.2f} s  \n{legend}")
