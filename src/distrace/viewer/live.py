"""Live pictures: a thread for each browser, which traces coarse images first, and again when anything moves."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import TYPE_CHECKING

import numpy as np
import torch

from distrace.camera import Camera
from distrace.render import Buffers, render
from distrace.shading import Picture
from distrace.tracing.bounds import Occupancy
from distrace.viewer.image import BAND, LAYERS, SHADED, Image, Light
from distrace.viewer.scene import Scene

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle

HEIGHTS = (64, 128, 512)  # rows of the pictures, one after the other, while nothing moves; at last the browser's own
MOST_ROWS = 1024
SHARPER = 1.5  # times as many rows as the picture before; for fewer a picture is not worth its time
FAR = 100.0  # depth of the background in radii: behind everything
MESH_CELLS = 96  # along each side, of the mesh on the page
MESH_LEGEND = f"a mesh by marching cubes, {MESH_CELLS} cells along each side"
TRACING = Lock()  # one band at a time: each uses all cores


class TracedField:
    """A scene's field, which is measured at the first picture, and then traced from any camera."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.occupancy: Occupancy | None = None

    @torch.no_grad()
    def trace(self, camera: Camera) -> Buffers:
        """Traces an image, or a band of one."""
        with TRACING:
            buffers = render(self.scene.sdf, camera.to(self.scene.device), occupancy=self.occupancy)
        self.occupancy = buffers.occupancy
        return buffers

    def image(self, camera: Camera) -> Image:
        """Traces a whole image."""
        return Image([self.trace(band) for band in camera.bands(BAND)])


@dataclass(frozen=True)
class Shown:
    """What all browsers see: a shape, a layer and the direction to a light. A change is a new object."""

    field: TracedField
    layer: str = SHADED
    light: Light = None
    mesh: bool = False  # instead of a traced picture: both on one page would hide parts of each other

    @torch.no_grad()
    def picture(self, image: Image) -> tuple[Picture, str]:
        """Returns the layer's picture and its legend."""
        return LAYERS[self.layer](image, self.light)


def browser_camera(handle: "CameraHandle", height: int) -> Camera:
    """Returns a browser's camera, with so many rows of pixels."""
    from viser.transforms import SO3

    width = max(1, round(height * handle.aspect))
    focal = height / 2 / math.tan(handle.fov / 2)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(SO3(np.asarray(handle.wxyz)).as_matrix())
    pose[:3, 3] = torch.from_numpy(np.array(handle.position))
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera.from_matrices(intrinsics, pose, height, width)


def picture_heights(rows: int) -> list[int]:
    """Returns the rows of each picture of a browser with so many rows of pixels, the coarsest first."""
    most = min(max(rows, HEIGHTS[0]), MOST_ROWS)
    return [*(height for height in HEIGHTS if height * SHARPER <= most), most]


class LiveView:
    """Keeps the background of one browser's page at what is shown, as its camera sees it."""

    def __init__(self, client: "ClientHandle", shown: Callable[[], Shown], report: Callable[[str], None]) -> None:
        self.client = client
        self.shown = shown
        self.report = report
        self.changed = Event()
        self.closed = False
        self.finished: tuple[TracedField, Camera, Image] | None = None  # the last whole picture
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
            try:
                self._draw()
            except Exception as error:  # a user's field may raise anything; the page goes on
                self.report(f"This view cannot be traced: {error}")

    def _draw(self) -> None:
        """Sends ever finer pictures until anything moves; draws the last one again where only its colours change."""
        shown = self.shown()
        if shown.mesh:
            self.client.scene.set_background_image(None)
            self.report(MESH_LEGEND)
            return
        heights = picture_heights(self.client.camera.image_height)
        if self.finished is not None:
            field, camera, image = self.finished
            if field is shown.field and camera == browser_camera(self.client.camera, camera.height):
                self._send(shown, camera, image, 0.0)
                heights = [height for height in heights if height > camera.height]
        for height in heights:
            camera = browser_camera(self.client.camera, height)
            began = time.perf_counter()
            image = self._traced(shown, camera)
            if image is None:
                return
            self._send(shown, camera, image, time.perf_counter() - began)
            self.finished = (shown.field, camera, image)
            if self.changed.is_set():
                return

    def _traced(self, shown: Shown, camera: Camera) -> Image | None:
        """Traces a picture; None where the camera or the shape moved meanwhile, unless it is the coarsest."""
        traced: list[Buffers] = []
        for band in camera.bands(BAND):
            traced.append(shown.field.trace(band))
            if self.closed or (self.changed.is_set() and camera.height > HEIGHTS[0]):
                return None
        return Image(traced)

    @torch.no_grad()  # a depth with a gradient would evaluate the field once more
    def _send(self, shown: Shown, camera: Camera, image: Image, seconds: float) -> None:
        picture, legend = shown.picture(image)
        depth = np.nan_to_num(image.depth, posinf=FAR)
        self.client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90, depth=depth)
        words = [f"{camera.width} × {camera.height} pixels", f"{image.total_evaluations:,} evaluations"]
        if seconds:
            words.append(f"{seconds:.2f} s")
        if image.doubtful:
            words.append(f"{image.doubtful} rays without a reliable answer")
        self.report(", ".join(words) + f"  \n{legend}")
