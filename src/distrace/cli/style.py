"""The options of shaded pictures: rays a pixel, background and light."""

import math

import numpy as np
from jaxtyping import Float

from distrace.antialiasing import Style
from distrace.shading import WHITE, Colour
from distrace.viewpoint import orbiting

MOST_SAMPLES = 16  # along each side of a pixel


def parsed_style(samples: int, background: str, light: str | None) -> Style:
    """Returns the style of the options. Raises `ValueError`, in one sentence, for a value that is none."""
    if not 1 <= samples <= MOST_SAMPLES:
        raise ValueError(f"--samples {samples} was given; give a whole number from 1 to {MOST_SAMPLES}")
    return Style(samples, _colour(background), None if light is None else _direction(light))


def _colour(given: str) -> Colour | None:
    """Returns red, green and blue, or None for a transparent background."""
    if given == "transparent":
        return None
    if given == "white":
        return WHITE
    levels = [int(part) for part in given.split(",") if part.isdecimal()]
    if given.count(",") != 2 or len(levels) != 3 or max(levels) > 255:
        raise ValueError(f"--background {given} was given; give white, transparent, or R,G,B from 0 to 255")
    red, green, blue = levels
    return red, green, blue


def _direction(given: str) -> Float[np.ndarray, "3"]:
    """Returns the direction to a light at an azimuth and an elevation, as cameras count them."""
    try:
        azimuth, elevation = map(float, given.split(","))
    except ValueError:
        azimuth = elevation = math.nan
    if not (math.isfinite(azimuth) and math.isfinite(elevation)):
        raise ValueError(f"--light {given} was given; give AZIMUTH,ELEVATION in degrees, such as 30,45")
    return orbiting(azimuth, elevation, 1.0).double().numpy()
