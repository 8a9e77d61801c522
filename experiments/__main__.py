"""The one entry: `python -m experiments NAME`, from the repository's root."""

from distrace.cli import run_commands
from experiments.commands.cameras import CamerasTable
from experiments.commands.clip import Clip
from experiments.commands.colours import Colours
from experiments.commands.costs import BoundaryGradients, Fields, Gradients, Growth, Memory, Solvers
from experiments.commands.depth import Focal, Multiview, Noise, SparseDepth, Spread
from experiments.commands.foreign_models import ForeignModels
from experiments.commands.photographs import Photographs
from experiments.commands.placement import Placement
from experiments.commands.placement_network import TrainPlacement
from experiments.commands.procedural import Procedural
from experiments.commands.real_scans import RealScans
from experiments.commands.tables import Completion, HeldOut, Pose, Training
from experiments.commands.training_data import Card, Choices, Splits
from experiments.commands.views import Views

COMMANDS = {
    "views": Views,
    "fields": Fields,
    "gradients": Gradients,
    "boundary-gradients": BoundaryGradients,
    "growth": Growth,
    "memory": Memory,
    "solvers": Solvers,
    "training": Training,
    "held-out": HeldOut,
    "completion": Completion,
    "sparse-depth": SparseDepth,
    "noise": Noise,
    "focal": Focal,
    "spread": Spread,
    "pose": Pose,
    "placement": Placement,
    "train-placement": TrainPlacement,
    "real-scans": RealScans,
    "multiview": Multiview,
    "colours": Colours,
    "photographs": Photographs,
    "cameras": CamerasTable,
    "foreign-models": ForeignModels,
    "splits": Splits,
    "choices": Choices,
    "card": Card,
    "clip": Clip,
    "procedural": Procedural,
}
ABOUT = "Experiments and training data of distrace. Results go to the folder --out."


def main() -> None:
    run_commands(COMMANDS, "python -m experiments", ABOUT)


if __name__ == "__main__":
    main()
