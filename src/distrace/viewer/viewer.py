"""The page: a server on loopback, what it shows, and what it saves."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from distrace.camera import Camera
from distrace.checkpoints.codes import save_code
from distrace.files import save_json, save_text
from distrace.mesh import MeshConfig, extract_mesh, mesh_in_world, save_mesh
from distrace.optional import require
from distrace.shading import save_png
from distrace.viewer.image import Light
from distrace.viewer.live import MESH_CELLS, TRACING, LiveView, Shown, TracedField, browser_camera
from distrace.viewer.scene import Scene

if TYPE_CHECKING:
    import trimesh
    from viser import CameraHandle, ClientHandle

HOST = "127.0.0.1"  # only this machine can open the page
EYE = (2.35, 1.7, 4.05)  # of the first camera, in radii, in a window that is not narrow
FIELD_OF_VIEW = 0.52  # radians, from the bottom to the top
MARGIN = 1.05  # radii of the sphere about the shape that the first camera sees
SAVED_CELLS = 256  # along each side, of the mesh that is saved
SAVED_ROWS = 512  # of the saved picture
BLUE = (44, 104, 190)
POINT_SIZE = 0.012  # radii, of an observed point
ORANGE = (226, 112, 32)
CLAY = (203, 192, 180)


# In a page without a server: the same as `framing_position`. The client reads the first camera from the address.
FRAMED_SCRIPT = f"""<script>{{
const eye = {list(EYE)};
const half = Math.atan(Math.tan({FIELD_OF_VIEW} / 2) * innerWidth / innerHeight);
const scale = {MARGIN} / Math.sin(half) / Math.hypot(...eye);
if (scale > 1) history.replaceState(null, "", "?initialCameraPosition=" + eye.map(x => scale * x));
}}</script>"""


def framing_position(aspect: float) -> tuple[float, float, float]:
    """Returns where the first camera is: at `EYE`, or farther where a narrow window would cut the unit sphere."""
    half = math.atan(math.tan(FIELD_OF_VIEW / 2) * aspect)
    scale = max(1.0, MARGIN / math.sin(half) / math.hypot(*EYE))
    x, y, z = EYE
    return (scale * x, scale * y, scale * z)


@contextmanager
def quiet() -> Iterator[None]:
    """Keeps viser's own lines from the terminal."""
    import rich

    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before


class Viewer:
    """A page on http://127.0.0.1 that shows a scene; it works in threads of its own until `close`."""

    def __init__(self, scene: Scene, out: str | Path = "out/view", port: int = 8080) -> None:
        require("the viewer", "viser")
        import viser

        from distrace.viewer.controls import Controls

        self.out = Path(out)
        self.shown = Shown(TracedField(scene))
        self.views: dict[int, LiveView] = {}
        self.changing = Lock()
        self.closed = False
        with quiet():
            self.server = viser.ViserServer(host=HOST, port=port, label="distrace", verbose=False)
        self._add_observation(scene)
        self.controls = Controls(self)
        self.server.on_client_connect(self._connected)
        self.server.on_client_disconnect(self._disconnected)

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server.get_port()}"

    @property
    def scene(self) -> Scene:
        """What is shown."""
        return self.shown.field.scene

    def close(self) -> None:
        """Stops the server and all threads; a save that was begun is finished first."""
        self.closed = True
        self.controls.close()
        for view in list(self.views.values()):
            view.close()
        with quiet():
            self.server.stop()

    def set_layer(self, layer: str) -> None:
        """Shows a traced layer in all browsers."""
        self._show(lambda shown: replace(shown, layer=layer, mesh=False))

    def set_light(self, light: Light) -> None:
        """Shows the shape in the light from a direction; None: over the camera's shoulder."""
        self._show(lambda shown: replace(shown, light=light))

    def set_code(self, code: Float[Tensor, "length"], title: str) -> None:
        """Shows another shape of the model."""
        scene = self.scene
        assert scene.model is not None
        moved = replace(scene, title=title, code=code, sdf=scene.model.field(code))
        self._show(lambda shown: replace(shown, field=TracedField(moved)))

    def set_mesh(self) -> None:
        """Shows the mesh of the shape in all browsers, instead of a traced layer."""
        mesh = _mesh(self.scene, MESH_CELLS)
        self.server.scene.add_mesh_simple("/mesh", np.asarray(mesh.vertices), np.asarray(mesh.faces), color=CLAY)
        self._show(lambda shown: replace(shown, mesh=True))

    def save(self, handle: "CameraHandle | None", report: Callable[[str], None] = lambda _: None) -> Path:
        """Writes the mesh, the code, its placement, and the picture of a browser's camera into a new folder.

        The mesh is in the frame of the input, and the folder can be opened again. `report` takes what is being done.
        """
        shown = self.shown
        scene = shown.field.scene
        folder = _fresh(self.out)
        report(f"extracting the mesh, {SAVED_CELLS} cells along each side …")
        save_mesh(folder / "mesh.ply", mesh_in_world(_mesh(scene, SAVED_CELLS), scene.place))
        if scene.code is not None:
            save_code(folder, scene.code, scene.place)
        if handle is not None:
            report("tracing the picture …")
            picture, _ = shown.picture(shown.field.image(browser_camera(handle, SAVED_ROWS)))
            save_png(folder / "picture.png", picture)
        save_json(folder / "result.json", {"model": scene.source, "title": scene.title})
        return folder

    def save_page(self, path: str | Path) -> None:
        """Writes a page that needs no server: the mesh, the observed points and the cameras."""
        self.set_mesh()
        page = self.server.scene.as_html()
        save_text(path, page.replace("</head>", f"{FRAMED_SCRIPT}</head>", 1))

    def _show(self, change: Callable[[Shown], Shown]) -> None:
        with self.changing:
            self.shown = change(self.shown)
            mesh = self.server.scene.get_handle_by_name("/mesh")
            if mesh is not None:
                mesh.visible = self.shown.mesh
        for view in list(self.views.values()):
            view.changed.set()

    def _add_observation(self, scene: Scene) -> None:
        """Places the first camera, and what the shape was fitted to."""
        stage = self.server.scene
        stage.set_up_direction("+y")
        stage.configure_environment_map(None)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)  # sharing would leave the machine
        start = self.server.initial_camera
        start.position = EYE
        start.look_at = (0.0, 0.0, 0.0)
        start.fov = FIELD_OF_VIEW
        if scene.points is not None:
            points = scene.points.cpu().numpy()
            stage.add_point_cloud("/points", points, ORANGE, point_size=POINT_SIZE, point_shape="circle")
        if scene.cameras:
            stage.add_frame("/cameras", show_axes=False)
        for number, camera in enumerate(scene.cameras):
            self._add_camera(f"/cameras/{number}", camera)

    def _add_camera(self, name: str, camera: Camera) -> None:
        from viser.transforms import SO3

        pose = camera.T_world_camera.cpu().double().numpy()
        self.server.scene.add_camera_frustum(
            name,
            fov=2 * float(np.arctan(camera.height / 2 / float(camera.intrinsics[1, 1]))),
            aspect=camera.width / camera.height,
            scale=0.15,
            color=BLUE,
            wxyz=SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3],
        )

    def _connected(self, client: "ClientHandle") -> None:
        position = framing_position(client.camera.aspect)
        if position != EYE:
            client.camera.position = position
            client.camera.look_at = (0.0, 0.0, 0.0)
        view = LiveView(client, lambda: self.shown, self.controls.report)
        self.views[client.client_id] = view
        if client.client_id not in self.server.get_clients():  # it left meanwhile
            self._disconnected(client)

    def _disconnected(self, client: "ClientHandle") -> None:
        view = self.views.pop(client.client_id, None)
        if view is not None:
            view.close()


def _mesh(scene: Scene, cells: int) -> "trimesh.Trimesh":
    """Returns a shape's mesh in the unit sphere. Raises `ValueError` where it has no surface."""
    with TRACING:
        return extract_mesh(scene.sdf, MeshConfig(cells, device=scene.device))


def _fresh(folder: Path) -> Path:
    """Makes the first of `saved-1`, `saved-2` … that does not exist."""
    number = 1
    while True:
        path = folder / f"saved-{number}"
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            number += 1
        else:
            return path
