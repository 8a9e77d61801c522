"""What can be set on the viewer's page: the picture, layers, the light, the shape, and buttons."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.prior import Prior, prior_of
from distrace.viewer.image import LAYERS

if TYPE_CHECKING:
    from viser import GuiEvent

    from distrace.viewer.viewer import Viewer

DIRECTIONS = 6  # of the prior, the leading ones, that have a slider
REACH = 3.0  # of a slider to both sides, in standard deviations of the training shapes
LIGHT = (-0.9, 1.1, 1.0)  # radii: where the light's handle is at first
NOTHING = "–"
MESH = "mesh"  # a choice beside the layers


class Controls:
    """The panel of a viewer. One thread does, in order, what takes a while; so the last choice is what stays."""

    def __init__(self, viewer: "Viewer") -> None:
        self.viewer = viewer
        self.worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix="distrace controls")
        self.mesh_due = Event()
        self.saving = False
        scene = viewer.scene
        gui = viewer.server.gui
        self.title = gui.add_markdown(f"**{scene.title}**")
        self.status = gui.add_markdown("")
        self.layer = gui.add_dropdown("layer", (*LAYERS, MESH))
        self.layer.on_update(lambda _: self._change_layer())
        self._add_light()
        for label, name in (("observed points", "/points"), ("cameras", "/cameras")):
            self._add_switch(label, name)
        if scene.model is not None:
            self._add_shapes(scene.model, prior_of(scene.model.codes))
        if scene.refit is not None:
            gui.add_button("refine this shape").on_click(lambda _: self._submit(self._refit))
        gui.add_button("save mesh, picture, code").on_click(lambda event: self._submit(lambda: self._save(event)))
        self.message = gui.add_markdown("")

    def close(self) -> None:
        """Drops what was not begun, and waits for what was; a fit ends at its next iteration."""
        self.worker.shutdown(wait=True, cancel_futures=True)

    def report(self, text: str) -> None:
        """Says how the picture was made."""
        self.status.content = text

    def _submit(self, task: Callable[[], None]) -> None:
        """Does a task after those that were given before; a failure becomes a sentence on the page."""

        def work() -> None:
            try:
                task()
            except ViewerClosed:
                pass
            except Exception as error:  # whatever a user's field raises
                self.message.content = f"That failed: {error}"

        if not self.viewer.closed:
            self.worker.submit(work)

    def _add_switch(self, label: str, name: str) -> None:
        """Adds a box that shows or hides a part of the page, where there is one."""
        node = self.viewer.server.scene.get_handle_by_name(name)
        if node is None:
            return
        box = self.viewer.server.gui.add_checkbox(label, True)
        box.on_update(lambda _: setattr(node, "visible", box.value))

    def _add_light(self) -> None:
        """Adds a movable light; while it is off, the light is over the camera's shoulder."""
        viewer = self.viewer
        box = viewer.server.gui.add_checkbox("movable light", False)
        handle = viewer.server.scene.add_transform_controls(
            "/light", scale=0.3, disable_rotations=True, position=LIGHT, visible=False
        )

        def update(_: object) -> None:
            handle.visible = box.value
            direction = np.array(handle.position)
            is_direction = box.value and np.linalg.norm(direction) > 0
            viewer.set_light(direction if is_direction else None)

        box.on_update(update)
        handle.on_update(update)

    def _add_shapes(self, model: Model, prior: Prior) -> None:
        """Adds a choice of training shapes, interpolation between two, and sliders along the prior's directions."""
        gui = self.viewer.server.gui
        with gui.add_folder("training shapes"):
            first = gui.add_dropdown("shape", (NOTHING, *model.shapes))
            second = gui.add_dropdown("towards", (NOTHING, *model.shapes))
            share = gui.add_slider("interpolation", 0.0, 1.0, 0.05, 0.0)
        with gui.add_folder("directions of the prior", expand_by_default=False):
            count = min(DIRECTIONS, prior.basis.shape[1])
            sliders = [gui.add_slider(f"direction {k + 1}", -REACH, REACH, 0.05, 0.0) for k in range(count)]
        self.sliders = sliders
        self.prior = prior
        self._set_sliders()

        def choose() -> None:
            if first.value == NOTHING:
                return
            code = model.code_of(first.value)
            title = first.value
            if second.value != NOTHING:
                code = code.lerp(model.code_of(second.value), share.value)
                title = f"{first.value}, {share.value:.0%} of the way to {second.value}"
            self._set_code(code, title)

        def move(number: int) -> None:
            code = self.viewer.scene.code
            assert code is not None
            w = prior.coordinates(code)
            w[number] = sliders[number].value
            self._set_code(prior.code(w), "a shape of the prior")

        for control in (first, second, share):
            control.on_update(lambda event: self._by_hand(event, choose))
        for number, slider in enumerate(sliders):
            slider.on_update(lambda event, number=number: self._by_hand(event, lambda: move(number)))

    def _by_hand(self, event: "GuiEvent", task: Callable[[], None]) -> None:
        """Does a task unless it was this program that moved the control."""
        if event.client is not None:
            self._submit(task)

    def _set_code(self, code: Float[Tensor, "length"], title: str) -> None:
        self.viewer.set_code(code, title)
        self.title.content = f"**{title}**"
        self._set_sliders()
        if self.layer.value == MESH:
            self._renew_mesh()

    def _set_sliders(self) -> None:
        code = self.viewer.scene.code
        assert code is not None
        for slider, value in zip(self.sliders, self.prior.coordinates(code).tolist(), strict=False):
            slider.value = round(min(max(value, -REACH), REACH), 2)

    def _change_layer(self) -> None:
        """Shows a traced layer at once, and the mesh when it is made."""
        if self.layer.value == MESH:
            self._renew_mesh()
        else:
            self.viewer.set_layer(self.layer.value)

    def _renew_mesh(self) -> None:
        """Has the mesh made again, once for all changes that are waiting."""
        if self.mesh_due.is_set():
            return
        self.mesh_due.set()
        self.report("extracting the mesh …")
        self._submit(self._make_mesh)

    def _make_mesh(self) -> None:
        self.mesh_due.clear()
        if self.layer.value == MESH:
            self.viewer.set_mesh()
        if self.layer.value != MESH:  # another was chosen meanwhile
            self.viewer.set_layer(self.layer.value)

    def _refit(self) -> None:
        scene = self.viewer.scene
        assert scene.refit is not None
        assert scene.code is not None
        code, verdict = scene.refit(scene.code, self._progress)
        self._set_code(code, "refined")
        self.message.content = verdict

    def _progress(self, done: int, total: int) -> None:
        if self.viewer.closed:
            raise ViewerClosed
        self.message.content = f"fitting: {done} of {total}"

    def _save(self, event: "GuiEvent") -> None:
        def report(text: str) -> None:
            self.message.content = f"saving: {text}"

        self.saving = True
        try:
            folder = self.viewer.save(None if event.client is None else event.client.camera, report)
        finally:
            self.saving = False
        self.message.content = f"wrote {folder.resolve()}"


class ViewerClosed(Exception):
    """The viewer was closed during a fit."""
