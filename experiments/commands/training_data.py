"""Training data of the models, and pictures of the models."""

from dataclasses import asdict, dataclass
from pathlib import Path

from distrace.cli.common import ModelName, opened, show_table
from distrace.cli.console import console, progress, start
from distrace.files import save_json, save_text
from distrace.shading import save_png
from experiments.datasets.splits import CLASSES, Meshes, read_split
from experiments.tables.card import pairs_picture, shapes_table, walks_picture
from experiments.tables.splits import nearest_rows, used
from experiments.tables.training_choices import choice_rows, choices_with


@dataclass(frozen=True)
class Splits:
    """Measure the distance of each shape of a split to the others, to find near-variants."""

    splits: tuple[str, ...] = CLASSES  # bundled ones, or CSV files
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")

    def run(self) -> None:
        run = start(self.out)
        rows = []
        for split in self.splits:
            shapes = used(read_split(split))
            with progress(split, len(shapes)) as bar:
                nearest = nearest_rows(shapes, self.meshes, bar.advance)
            rows += [{"class": split, **asdict(row)} for row in nearest]
        show_table(rows)
        run.finish({"rows": rows})


@dataclass(frozen=True)
class Choices:
    """Compare training sets and losses: small networks trained on a class and on more and more variants."""

    samples: Path = Path("out/samples")  # of the split, with `--mirror --variants 4`
    split: str = "chairs"
    others: tuple[Path, ...] = ()  # folders of samples of other classes, for two more choices
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")
    steps: int = 6000  # of each
    resolution: int = 128  # of the meshes that are compared

    def run(self) -> None:
        run = start(self.out)
        rows = []
        tried = choice_rows(self.samples, self.split, self.meshes, self.steps, self.resolution, self.others)
        with progress("choices", len(choices_with(self.others))) as bar:
            for row in tried:
                rows.append(asdict(row))
                save_json(run.out / "rows.json", rows)
                bar.advance(f"{row.choice}: {row.held_out_median:.2f}")
        show_table(rows)
        run.finish({"rows": rows})


@dataclass(frozen=True)
class Card:
    """Make a model card: pictures of each shape next to the true one, walks between codes, and the table of shapes."""

    model: ModelName = "sofas"
    split: str | None = None  # by default that of the model's name
    meshes: Meshes = Path("out")
    out: Path = Path("out/evaluate")

    def run(self) -> None:
        run = start(self.out)
        shapes = read_split(self.split or self.model)
        model = opened(self.model, run.device)
        save_png(run.out / "walks.png", walks_picture(model, shapes))
        save_png(run.out / "shapes.png", pairs_picture(model, shapes, self.meshes))
        save_text(run.out / "shapes.md", shapes_table(shapes))
        console.print(f"{len(model.codes)} codes of {len(shapes)} shapes")
        run.finish({"codes": len(model.codes)})
