"""A solid texture: value noise of several octaves (Ebert et al., *Texturing and Modeling*, 1994)."""

import numpy as np
from jaxtyping import Float

PERIOD = 64  # of the lattice of random values
FIRST = 5.0  # cells per unit of length in the coarsest octave
OCTAVES = 4
DARKEST = 0.12  # so that black materials show the noise, too
BRIGHTEST = 0.9  # so that white ones do
STRENGTH = 0.5  # of the noise in log brightness
TINT = 0.15  # of the noise in each colour channel


def mottled(points: Float[np.ndarray, "n 3"], colours: Float[np.ndarray, "n 3"], seed: int) -> Float[np.ndarray, "n 3"]:
    """Returns colours (sRGB, 0 to 1) whose brightness and hue vary over space."""
    brightness = value_noise(points, seed)[:, None]
    hue = np.stack([value_noise(points, seed + channel) for channel in (1, 2, 3)], axis=1)
    base = np.clip(colours, 0.3, 0.75)
    return np.clip(base * np.exp(STRENGTH * brightness + TINT * hue), DARKEST, BRIGHTEST)


def value_noise(points: Float[np.ndarray, "n 3"], seed: int) -> Float[np.ndarray, "n"]:
    """Returns smooth random values of about unit variance, a function of place and seed."""
    values = np.random.default_rng(seed).normal(size=(PERIOD, PERIOD, PERIOD))
    total = np.zeros(len(points))
    for octave in range(OCTAVES):
        total += 0.75**octave * _interpolated(values, points * FIRST * 2**octave + 17.3 * octave)
    return 1.6 * total / np.sqrt(sum(0.75 ** (2 * octave) for octave in range(OCTAVES)))


def _interpolated(values: Float[np.ndarray, "p p p"], places: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n"]:
    cell = np.floor(places).astype(int)
    part = places - cell
    part = part * part * (3 - 2 * part)
    total = np.zeros(len(places))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, part, 1 - part).prod(1)
        total += weight * values[tuple(((cell + corner) % PERIOD).T)]
    return total
