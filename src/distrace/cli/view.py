"""`view`: a shape in the browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from distrace.cli.common import CodeName, default
from distrace.cli.console import console, start
from distrace.files import file_in_the_way
from distrace.optional import require
from distrace.viewer.page import until_interrupted
from distrace.viewer.results import open_scene


@dataclass(frozen=True)
class ViewShape:
    """Show a shape in the browser: a model's, or what another command found.

    The shape is traced live while the camera moves. Ctrl-C ends the viewer. Only this machine can open the page.
    """

    shown: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="MODEL|RESULT")]]
    """a model, or the --out folder of complete, pose, multiview or reconstruct"""
    out: Path = Path("out/view")  # where the page's button saves
    code: Annotated[CodeName | None, default("the first shape", "CODE")] = None
    port: int = 8080  # or the next one that is free
    save: Annotated[Path | None, default("none", "PAGE.html")] = None
    """write a page that needs no server, with the mesh and what was observed, and end"""
    device: str = "cpu"

    def run(self) -> None:
        require("the viewer", "viser")
        if not 0 < self.port < 65536:
            raise ValueError(f"--port {self.port} was given; a number from 1 to 65535 is needed")
        if self.save is not None:
            check_page(self.save)
        if self.out.resolve() == Path(self.shown).resolve():
            raise ValueError(f"--out {self.out} is the folder that is shown; give another to save to")
        run = start(self.out, self.device)
        scene = open_scene(self.shown, self.code, run.device)
        from distrace.viewer.viewer import Viewer

        viewer = Viewer(scene, self.out, self.port)
        try:
            if self.save is not None:
                console.print(f"extracting the mesh of {scene.title} …", soft_wrap=True)
                viewer.save_page(self.save)
                run.finish({"shown": self.shown, "page": str(self.save)}, f"wrote {self.save}")
                return
            console.print(f"{viewer.address} shows {scene.title}; Ctrl-C ends it", soft_wrap=True)
            until_interrupted(viewer)
        finally:
            if viewer.controls.saving:
                console.print("finishing what was being saved …")
            viewer.close()
        run.finish({"shown": self.shown, "address": viewer.address})


def check_page(path: Path) -> None:
    """Raises `ValueError` where no page can be written to a path."""
    if path.suffix.lower() not in (".html", ".htm") or path.is_dir():
        raise ValueError(f"--save {path} was given; give the name of a page, which ends in .html")
    file = file_in_the_way(path.parent)
    if file is not None:
        raise ValueError(f"--save {path} cannot be written, for {file} is a file; give another place")
