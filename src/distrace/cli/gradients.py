"""`check-gradients`: every derivative of an image of a model against finite differences."""

import sys
from dataclasses import asdict, dataclass, field
from pathlib import Path

import tyro

from distrace.checking.gradcheck import ROUGHLY, STRAY, GradientCheck, GradientRow, check_gradients
from distrace.checkpoints.codes import named_code
from distrace.cli.common import CodeName, ModelName, Orbit, opened, show_table
from distrace.cli.console import start


@dataclass(frozen=True)
class CheckGradients(Orbit):
    """Compare every derivative of an image with finite differences.

    The exit status is 1 where one disagrees.
    """

    model: tyro.conf.Positional[ModelName]
    out: Path = Path("out/check-gradients")
    code: CodeName = "0"
    size: int = field(default=48, kw_only=True)  # pixels along each side
    device: str = "cpu"

    def run(self) -> None:
        run = start(self.out, self.device)
        model = opened(self.model, run.device)
        camera = self.camera().to(run.device)
        found = check_gradients(model.field(named_code(model, self.code)), camera, size=self.size)
        show_table([_line(row) for row in found.rows])
        tolerances = {"tolerance": found.precision.tolerance, "stray": STRAY, "footprint_tolerance": ROUGHLY}
        facts = {"agrees": found.agrees, "verdicts": found.verdicts(), **tolerances, "evaluations": found.evaluations}
        rows = [{"model": self.model, **asdict(row)} for row in found.rows]
        run.finish({**facts, "rows": rows}, _summary(found))
        if not found.agrees:
            sys.exit(1)


def _summary(found: GradientCheck) -> str:
    counts = found.verdicts()
    agree = f"{counts['agrees']} of {len(found.rows)} agree, {counts['disagrees']} disagree"
    zeros = f"{counts['zero']} compare zero with zero and test nothing"
    how = f"to {found.precision.tolerance:g} at all but {STRAY:.0%} of the pixels, footprint normals to {ROUGHLY:g}"
    return f"{agree}, {zeros} ({how} in the median)"


def _line(row: GradientRow) -> dict[str, object]:
    """A row for the terminal; its two values are those of the worst pixel, and of that the worst channel."""
    pairs = zip(row.derivative, row.difference, strict=True)
    derivative, difference = max(pairs, key=lambda pair: abs(pair[0] - pair[1]))
    return {
        "of": row.quantity,
        "by": row.parameter,
        "median": row.median,
        "worst": row.worst,
        "pixel": f"{row.x}, {row.y}",
        "along": row.along,
        "autograd": derivative,
        "differences": difference,
        "compared": row.pixels,
        "off": row.off,
        "left out": row.left_out,
        "verdict": "DISAGREES" if row.verdict == "disagrees" else row.verdict,
    }
