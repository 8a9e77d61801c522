"""Images of a held-out shape from all around, by an independent renderer."""

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from distrace.cli.console import console, origin, progress, start
from distrace.data.solid import mesh_of
from experiments.clips import clip, mitsuba_scene
from experiments.clips.patches import Patch, has_images, load_patches, painted, placed
from experiments.datasets.splits import Meshes


@dataclass(frozen=True)
class Clip:
    """Film a held-out shape from all around with Mitsuba, for `multiview`; goes on where it was stopped."""

    shape: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="SHAPE")]]
    split: str = "sofas"  # a bundled one, or a CSV file
    meshes: Meshes = Path("out")
    out: Path | None = None  # by default out/clips/SHAPE
    frames: int = 24
    size: int = 256
    background: clip.Background = "plain"
    texture: clip.Texture | None = None  # by default the mesh's own where it has images, else a noise of ours
    samples: int = 64  # light paths per pixel

    def run(self) -> None:
        clip.check(self.frames, self.size, self.samples)
        shape = clip.held_out(self.split, self.shape)
        version = mitsuba_scene.mitsuba().__version__
        path = mesh_of(shape, self.meshes)
        patches = load_patches(path)
        wanted = clip.Clip(
            shape=shape.name,
            split=self.split,
            background=self.background,
            frames=self.frames,
            size=self.size,
            samples=self.samples,
            texture=self._texture(patches, path),
            mesh=shape.path,
            creator=shape.creator,
            licence=shape.licence,
            mitsuba=version,
        )
        run = start(self.out or Path("out/clips") / shape.name)
        clip.begin(run.out, wanted)
        rendered, took = filmed(wanted, patches, shape.turn, run.out)
        per_frame = {"seconds_per_frame": took / rendered} if rendered else {}
        run.finish({"frames": wanted.frames, "rendered": rendered, **per_frame, "cores": os.cpu_count(), **origin()})

    def _texture(self, patches: list[Patch], path: Path) -> clip.Texture:
        own = has_images(patches)
        if self.texture == "own" and not own:
            raise ValueError(f"{path} has no images of its own to speak of; use --texture procedural")
        return self.texture or ("own" if own else "procedural")


def filmed(wanted: clip.Clip, patches: list[Patch], turn: float, folder: Path) -> tuple[int, float]:
    """Renders the frames that are missing; their number and the seconds that they took."""
    frames = clip.missing(folder, wanted)
    if not frames:
        clip.save_views(folder, wanted)
        return 0, 0.0
    console.print(f"{wanted.shape} in its {'own' if wanted.texture == 'own' else 'procedural'} texture", markup=False)
    shown = placed(patches, turn)
    if wanted.texture == "procedural":
        shown = [painted(patch, wanted.seed) for patch in shown]
    stage = mitsuba_scene.staged(shown, wanted.background, wanted.seed)
    began = time.perf_counter()
    with progress("rendering", wanted.frames) as bar:
        for frame in frames:
            mask, depth = mitsuba_scene.truth(stage, wanted.cameras[frame])
            image = mitsuba_scene.photograph(stage, wanted.cameras[frame], wanted.samples, wanted.seed + frame)
            clip.save_frame(folder, frame, image, mask, depth)
            bar.advance(to=frame + 1)
    clip.save_views(folder, wanted)
    return len(frames), time.perf_counter() - began
