"""The ways to complete a shape that are compared: DeepSDF's, and ours from what more and more is known of."""

from collections.abc import Iterator

from distrace.checkpoints.model import Model
from distrace.data.cloud import Cloud
from distrace.data.observation import View
from distrace.fitting.continuation import CodeFitConfig
from distrace.fitting.fit import FitConfig, fit_shape
from distrace.fitting.fit_code import fit_code, fit_points
from distrace.fitting.fit_samples import SampleFitConfig, around_points, fit_samples, on_surface
from distrace.fitting.free_space import MARGIN
from distrace.fitting.multistart import Step
from distrace.prior import Prior, prior_of

METHODS = ("deepsdf", "ours", "ours+mask")  # of the published table
CLOUDS = ("points", "points+normals")  # ours, not knowing the camera
DEEPSDF = SampleFitConfig(samples=500)  # where the original has 8,000 in an iteration: docs/from_the_paper.md


def told(view: View, method: str) -> View | Cloud:
    """What a method is told of a view, which has normals where the method takes them.

    Raises `ValueError` for another method.
    """
    if method not in METHODS + CLOUDS:
        raise ValueError(f"there is no method {method!r}; give some of {', '.join(METHODS + CLOUDS)}")
    if method in ("ours", "ours+mask"):
        return view.without("normal") if method == "ours+mask" else view.without("normal", "mask")
    cloud = Cloud(view.points(), None if view.normal is None else view.normal[view.seen])
    return cloud.without("normal") if method == "points" else cloud


def steps_of(model: Model, seen: View | Cloud, method: str, config: FitConfig | CodeFitConfig) -> Iterator[Step]:
    """What a method is told, completed by it; the last step is the result."""
    if method != "deepsdf":
        return completing(model, seen, config)
    cloud = seen.to(model.codes.device)
    assert isinstance(cloud, Cloud)
    assert cloud.normals is not None, "DeepSDF is given the true normals"
    return fit_samples(model.decoder, around_points(cloud.points, cloud.normals), DEEPSDF)


def settings_of(method: str, config: FitConfig | CodeFitConfig) -> tuple[object, ...]:
    """What a method follows."""
    return (DEEPSDF,) if method == "deepsdf" else (config, MARGIN)


def completing(
    model: Model, seen: View | Cloud, config: FitConfig | CodeFitConfig, prior: Prior | None = None
) -> Iterator[Step]:
    """Ours: from a view by either solver, from points by Levenberg–Marquardt; a prior replaces that of the codes.

    On the model's device, wherever what was seen is.
    """
    seen = seen.to(model.codes.device)
    prior = prior_of(model.codes) if prior is None else prior
    if isinstance(seen, Cloud):
        samples = on_surface(seen.points) if seen.normals is None else around_points(seen.points, seen.normals)
        settings = config if isinstance(config, CodeFitConfig) else CodeFitConfig(seed=config.seed)
        return fit_points(model.decoder, samples, prior, settings)
    if isinstance(config, CodeFitConfig):
        return fit_code(model.decoder, [seen], prior, config)
    return fit_shape(model.decoder, [seen], prior, config)
