"""Tables of completion trials, as rows and as pages: medians over instances, curves, and pictures."""

from collections.abc import Sequence
from statistics import median

import numpy as np
import torch

from distrace.camera import Camera
from distrace.data.solid import Solid
from distrace.report.page import Html, figure, page, paragraph, section, table
from distrace.shading import Picture, grid
from experiments.charts import steps_chart
from experiments.datasets.pictured import pictured
from experiments.tables.methods import observation_of
from experiments.tables.sparse_depth import DENSITIES, SIZE, Done, camera_of, observed, surface_of, true_solid
from experiments.tables.trials import Place, grouped

PUBLISHED = {  # medians of 200 shapes of ShapeNet a class, not our shapes (Liu et al., CVPR 2020, table 3)
    ("sofa", "DeepSDF"): (5.37, 5.56, 5.50, 5.93, 6.03, 7.63),
    ("sofa", "DIST"): (4.12, 5.75, 5.49, 5.72, 5.57, 6.95),
    ("sofa", "DIST + mask"): (4.12, 3.98, 4.31, 3.98, 4.30, 4.94),
    ("plane", "DeepSDF"): (3.71, 3.73, 4.29, 4.44, 4.40, 5.39),
    ("plane", "DIST"): (2.18, 4.08, 4.81, 4.44, 4.51, 5.30),
    ("plane", "DIST + mask"): (2.18, 2.08, 2.62, 2.26, 2.55, 3.60),
    ("table", "DeepSDF"): (12.93, 12.78, 11.67, 12.87, 13.76, 15.77),
    ("table", "DIST"): (5.37, 12.05, 11.42, 11.70, 13.76, 15.83),
    ("table", "DIST + mask"): (5.37, 5.15, 5.16, 5.26, 6.33, 7.62),
}
PICTURE = 176  # pixels
_BLANK = np.full((PICTURE, PICTURE, 3), 255, np.uint8)
AXES = {"sparse-depth": "density", "noise": "noise", "focal": "focal_ratio"}
LABELS = {"density": "depths", "noise": "noise on the depths", "focal_ratio": "focal length / 60 mm"}


def rows_of(results: Sequence[Done], axis: str) -> list[dict[str, object]]:
    """Returns one row for each class, method and step of the axis, in the order of the results."""
    groups = grouped(results, lambda each: (each.trial.category, each.trial.method, getattr(each.trial, axis)))
    return [
        {
            "class": category,
            "method": method,
            "density": group[0].trial.density,
            axis: step,
            "chamfer_median": median(each.chamfer for each in group),
            "chamfer_mean": sum(each.chamfer for each in group) / len(group),
            "to_median": median(each.chamfer_to for each in group),
            "from_median": median(each.chamfer_from for each in group),
            "seconds": median(each.seconds for each in group),
            "n": len(group),
        }
        for (category, method, step), group in groups.items()
    ]


def wide(rows: Sequence[dict[str, object]], axis: str) -> tuple[list[str], list[list[str]]]:
    """Returns the medians in the published layout: a line for each class and method, a column for each step."""
    steps = list(dict.fromkeys(row[axis] for row in rows))
    medians = {(row["class"], row["method"], row[axis]): row["chamfer_median"] for row in rows}
    lines = list(dict.fromkeys((row["class"], row["method"]) for row in rows))
    cells = [[*map(str, line), *(_two(medians.get((*line, step))) for step in steps)] for line in lines]
    return ["class", "method", *map(str, steps)], cells


def ratios(rows: Sequence[dict[str, object]], axis: str) -> dict[str, dict[str, float]]:
    """Returns each class's median by each method over DeepSDF's, averaged over the steps."""
    found: dict[str, dict[str, float]] = {}
    for category in dict.fromkeys(str(row["class"]) for row in rows):
        of_class = [row for row in rows if row["class"] == category]
        base = {row[axis]: float(str(row["chamfer_median"])) for row in of_class if row["method"] == "deepsdf"}
        for method in dict.fromkeys(str(row["method"]) for row in of_class):
            shares = [
                float(str(row["chamfer_median"])) / base[row[axis]]
                for row in of_class
                if row["method"] == method and row[axis] in base
            ]
            if shares and method != "deepsdf":
                found.setdefault(category, {})[method] = sum(shares) / len(shares)
    return found


def depth_page(name: str, results: Sequence[Done], place: Place) -> str:
    """Returns the page: table, curves, and pictures of the best, the median and the worst completion."""
    axis = AXES[name]
    rows = rows_of(results, axis)
    header, cells = wide(rows, axis)
    counts = [int(str(row["n"])) for row in rows]
    count = f"{counts[0]}" if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"
    lead = (
        "Median Chamfer distance × 1000, both directions summed, 30,000 points a side, in the frame of the unit sphere;"
        f" {count} instances a cell. The shapes are held out; Embree renders the depths of their meshes."
    )
    mean_ratios = [
        f"{category}: " + ", ".join(f"{method} {ratio:.2f}" for method, ratio in methods.items())
        for category, methods in ratios(rows, axis).items()
    ]
    against = (
        [paragraph("Relative to DeepSDF, averaged over columns: " + "; ".join(mean_ratios))] if mean_ratios else []
    )
    parts = [
        section("Table", table(header, cells), *against),
        *(_curves(category, rows, axis) for category in dict.fromkeys(str(row["class"]) for row in rows)),
        *_instances(results, place),
    ]
    if name == "sparse-depth":
        parts.append(_published())
    return page(f"Shapes from one view: {name}", lead, parts)


def _published() -> Html:
    cells = [[*line, *map(str, values)] for line, values in PUBLISHED.items()]
    about = (
        "The published table (Liu et al., CVPR 2020) has 200 other shapes of ShapeNet a class, so it is not comparable."
    )
    return section("Published", paragraph(about), table(["class", "method", *DENSITIES], cells))


def _curves(category: str, rows: Sequence[dict[str, object]], axis: str) -> Html:
    series: dict[str, dict[str, float]] = {}
    for row in rows:
        if row["class"] == category:
            series.setdefault(str(row["method"]), {})[str(row[axis])] = float(str(row["chamfer_median"]))
    return section(category, steps_chart(series, LABELS[axis], "median Chamfer × 1000"))


def _instances(results: Sequence[Done], place: Place) -> list[Html]:
    """Returns pictures of each class at the fourth step, ranked by ours with the mask or by the last method."""
    parts = []
    for category in dict.fromkeys(each.trial.category for each in results):
        of_class = [each for each in results if each.trial.category == category]
        conditions = list(dict.fromkeys(_condition(each) for each in of_class))
        condition = conditions[min(3, len(conditions) - 1)]
        methods = list(dict.fromkeys(each.trial.method for each in of_class))
        ranking = "ours+mask" if "ours+mask" in methods else of_class[-1].trial.method
        ranked = sorted(
            (each for each in of_class if _condition(each) == condition and each.trial.method == ranking),
            key=lambda each: each.chamfer,
        )
        chosen = {"best": ranked[0], "median": ranked[len(ranked) // 2], "worst": ranked[-1]}
        caption = "; ".join(f"{word}: {each.trial.shape}, {each.chamfer:.2f}" for word, each in chosen.items())
        picture = grid([_strip(each, of_class, methods, place) for each in chosen.values()])
        head = f"{category}, {', '.join(map(str, condition))}: the truth, then {', '.join(methods)}"
        parts.append(section(head, figure(picture, f"By {ranking}: {caption}")))
    return parts


def _condition(each: Done) -> tuple:
    return each.trial.density, each.trial.noise, each.trial.focal_ratio


def _strip(one: Done, results: Sequence[Done], methods: Sequence[str], place: Place) -> list[Picture]:
    """Returns the true shape, and each method's completion of the same view."""
    camera = camera_of(one.trial.view, one.trial.focal_ratio).resized(PICTURE / SIZE)
    completions = {
        each.trial.method: each
        for each in results
        if (each.trial.shape, each.trial.view, _condition(each)) == (one.trial.shape, one.trial.view, _condition(one))
    }
    truth = pictured(true_solid(place.meshes, one.trial.category, one.trial.shape), camera)
    return [
        truth,
        *(_shaded(completions[method], camera, place) if method in completions else _BLANK for method in methods),
    ]


def _shaded(each: Done, camera: Camera, place: Place) -> Picture:
    observation = observation_of(observed(each.trial, place.meshes), each.trial.method)
    surface = surface_of(place, each.trial, observation, torch.tensor(each.code))
    return _BLANK if surface is None else pictured(Solid(surface, surface), camera)


def _two(value: object) -> str:
    return "–" if value is None else f"{float(str(value)):.2f}"
