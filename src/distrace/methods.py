"""The ways to complete a shape that are compared: DeepSDF's, and ours from what more and more is known of."""

from collections.abc import Iterator
from dataclasses import replace

from distrace.checkpoint import Model
from distrace.data.view import View
from distrace.fit import FitConfig, fit_shape
from distrace.fit_code import CodeFitConfig, fit_code, fit_points
from distrace.fit_samples import SampleFitConfig, around_points, fit_samples, on_surface
from distrace.prior import prior_of
from distrace.starts import Step

METHODS = ("deepsdf", "ours", "ours+mask")  # of the published table
CLOUDS = ("points", "points+normals")  # ours, not knowing the camera
SAMPLES = 2000  # of each of DeepSDF's iterations, where the original has 8,000: docs/from_the_paper.md


def steps_of(model: Model, view: View, method: str, config: FitConfig | CodeFitConfig) -> Iterator[Step]:
    """A view completed by a method; the last step is the result. The view has normals where the method takes them.

    Raises `ValueError` for another method.
    """
    prior, points = prior_of(model.codes), view.points()
    if method == "deepsdf":
        return fit_samples(model.decoder, around_points(points, _normals(view)), SampleFitConfig(samples=SAMPLES))
    if method in CLOUDS:
        samples = on_surface(points) if method == "points" else around_points(points, _normals(view))
        settings = config if isinstance(config, CodeFitConfig) else CodeFitConfig(seed=config.seed)
        return fit_points(model.decoder, samples, prior, settings)
    if method not in METHODS:
        raise ValueError(f"there is no method {method!r}; give some of {', '.join(METHODS + CLOUDS)}")
    known = replace(view, normal=None, mask=view.mask if method == "ours+mask" else None)
    if isinstance(config, CodeFitConfig):
        return fit_code(model.decoder, [known], prior, config)
    return fit_shape(model.decoder, [known], prior, config)


def _normals(view: View):
    assert view.normal is not None, "this method is given the true normals"
    return view.normal[view.seen]
