"""What can be set on the viewer's page: the picture, layers, the light, the shape, and buttons."""

from collections.abc import Callable
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from distrace.checkpoints.model import Model
from distrace.prior import Prior
from distrace.viewer.image import LAYERS

if TYPE_CHECKING:
    from viser import GuiEvent

    from distrace.viewer.viewer import Viewer

DIRECTIONS = 6  # of the prior, the leading ones, that have a slider
REACH = 3.0  # of a slider to both sides, in standard deviations of the training shapes
LIGHT = (-0.9, 1.1, 1.0)  # radii: where the light's handle is at first
NOTHING = "–"


class Controls:
    """The panel of a viewer."""

    def __init__(self, viewer: "Viewer") -> None:
        self.viewer = viewer
        self.working = Lock()  # one mesh, fit or save at a time
        scene = viewer.shown.scene
        gui = viewer.server.gui
        self.title = gui.add_markdown(f"**{scene.title}**")
        self.status = gui.add_markdown("")
        layer = gui.add_dropdown("picture", tuple(LAYERS))
        layer.on_update(lambda _: viewer.show(layer=layer.value))
        self._add_light()
        self.mesh = gui.add_checkbox("mesh", False)
        self.mesh.on_update(lambda _: self._work(self._update_mesh))
        for label, name in (("observed points", "/points"), ("cameras", "/cameras")):
            self._add_switch(label, name)
        if scene.model is not None and viewer.prior is not None and scene.code is not None:
            self._add_shapes(scene.model, viewer.prior, scene.code)
        if scene.refit is not None:
            gui.add_button("fit again from this shape").on_click(lambda _: self._work(self._refit))
        gui.add_button("save mesh, picture, code").on_click(lambda event: self._work(lambda: self._save(event)))
        self.message = gui.add_markdown("")

    def report(self, text: str) -> None:
        """Says how the picture was made."""
        self.status.content = text

    def _work(self, task: Callable[[], None]) -> None:
        """Runs what takes a while; a failure becomes a sentence on the page."""
        with self.working:
            try:
                task()
            except (ValueError, RuntimeError, OSError) as error:
                self.message.content = f"That failed: {error}"

    def _add_switch(self, label: str, name: str) -> None:
        """Adds a box that shows or hides a part of the page, where there is one."""
        node = self.viewer.server.scene.get_handle_by_name(name)
        if node is None:
            return
        box = self.viewer.server.gui.add_checkbox(label, True)
        box.on_update(lambda _: setattr(node, "visible", box.value))

    def _add_light(self) -> None:
        """Adds a light that can be dragged; while it is off, the light is over the camera's shoulder."""
        viewer = self.viewer
        radius = viewer.shown.scene.radius
        box = viewer.server.gui.add_checkbox("light to drag", False)
        handle = viewer.server.scene.add_transform_controls(
            "/light",
            scale=0.3 * radius,
            disable_rotations=True,
            position=tuple(radius * np.array(LIGHT)),
            visible=False,
        )

        def update(_: object) -> None:
            handle.visible = box.value
            direction = np.array(handle.position)
            is_direction = box.value and np.linalg.norm(direction) > 0
            viewer.show(light=direction if is_direction else None)

        box.on_update(update)
        handle.on_update(update)

    def _add_shapes(self, model: Model, prior: Prior, code: Float[Tensor, "length"]) -> None:
        """Adds a choice of training shapes, the way from one to another, and sliders along the prior's directions."""
        gui = self.viewer.server.gui
        with gui.add_folder("training shapes"):
            first = gui.add_dropdown("shape", (NOTHING, *model.shapes))
            second = gui.add_dropdown("towards", (NOTHING, *model.shapes))
            share = gui.add_slider("share of the way", 0.0, 1.0, 0.05, 0.0)
        with gui.add_folder("directions of the prior", expand_by_default=False):
            labels = [f"direction {k + 1}" for k in range(min(DIRECTIONS, prior.basis.shape[1]))]
            sliders = [gui.add_slider(label, -REACH, REACH, 0.05, 0.0) for label in labels]
        self.sliders = sliders
        self._set_sliders(prior, code)

        def choose(event: "GuiEvent") -> None:
            if event.client is None or first.value == NOTHING:
                return
            chosen = model.code_of(first.value)
            title = first.value
            if second.value != NOTHING:
                chosen = chosen.lerp(model.code_of(second.value), share.value)
                title = f"{first.value}, {share.value:.0%} of the way to {second.value}"
            self._show_code(chosen, title)
            self._set_sliders(prior, chosen)

        def move(event: "GuiEvent") -> None:
            shown = self.viewer.shown.scene.code
            if event.client is None or shown is None:
                return
            w = prior.coordinates(shown)
            w[: len(sliders)] = torch.tensor([slider.value for slider in sliders]).to(w)
            self._show_code(prior.code(w), "a shape of the prior")

        for control in (first, second, share):
            control.on_update(choose)
        for slider in sliders:
            slider.on_update(move)

    def _set_sliders(self, prior: Prior, code: Float[Tensor, "length"]) -> None:
        for slider, value in zip(self.sliders, prior.coordinates(code).tolist(), strict=False):
            slider.value = round(min(max(value, -REACH), REACH), 2)

    def _show_code(self, code: Float[Tensor, "length"], title: str) -> None:
        self.viewer.show_code(code, title)
        self.title.content = f"**{title}**"
        if self.mesh.value:
            self._work(self._update_mesh)

    def _update_mesh(self) -> None:
        self.viewer.set_mesh(self.mesh.value)

    def _refit(self) -> None:
        scene = self.viewer.shown.scene
        assert scene.refit is not None
        assert scene.code is not None
        assert self.viewer.prior is not None
        code = scene.refit(scene.code, self._progress)
        self.viewer.show_code(code, "fitted again")
        self.title.content = "**fitted again**"
        self._set_sliders(self.viewer.prior, code)
        self._update_mesh()

    def _progress(self, done: int, total: int) -> None:
        self.message.content = f"fitting: {done} of {total}"

    def _save(self, event: "GuiEvent") -> None:
        self.message.content = "saving …"
        names = self.viewer.save(None if event.client is None else event.client.camera)
        self.message.content = f"wrote {', '.join(names)} in {self.viewer.out.resolve()}"
