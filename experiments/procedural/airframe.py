"""Parts of aircraft of length 1 with the nose to +z: shells between sections, and round parts."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from experiments.procedural.parts import Part, Vector, rod

Section = Float[np.ndarray, "around 3"]
"""Points around a part; the convex hull of two sections is the part between them."""


def both_sides(parts: list[Part]) -> list[Part]:
    """Returns parts and their mirror images."""
    return [part * (side, 1, 1) for side in (1, -1) for part in parts]


def fuselage(random: np.random.Generator, wide: float, nose: float, rear: float, thick_end: float = 0.0) -> list[Part]:
    """Returns a round, flattened or boxy fuselage that rises to the tail; `nose` and `rear` are lengths of its ends."""
    tall = wide * random.uniform(0.9, 1.3)
    blunt = random.uniform(0.25, 1.0)
    lift = random.uniform(0.2, 0.8)
    last = max(thick_end, random.uniform(0.06, 0.25))
    slender = random.uniform(0.8, 1.8)
    boxy = random.choice([2.0, random.uniform(2.0, 5.0)])
    fore = [(0.5 - nose * t, (1 - (1 - t) ** 2) ** blunt, -0.25 * (1 - t) ** 2) for t in np.linspace(0.01, 1, 8)]
    thinned = [(t, (1 - last) * t**slender) for t in np.linspace(0, 1, 7)]
    aft = [(rear * (1 - t) - 0.5, 1 - less, lift * less) for t, less in thinned]
    rings = [ring((0, rise * tall, z), wide * share, tall * share, boxy=boxy) for z, share, rise in fore + aft]
    return lofted(rings)


def wing(
    random: np.random.Generator,
    place: tuple[float, float],
    half: float,
    chord: float,
    taper: float,
    sweep: float,
    dihedral: float,
    thick: float = 0.12,
) -> list[Part]:
    """Returns a pair of wings; `place` is the height and the position along of the root's front edge."""
    kink = random.uniform(0.25, 0.45)
    middle = random.choice([0.0, random.uniform(0.0, 0.25)])
    chords = [(0.0, 1.0), (kink, 1 - (1 - taper) * kink - middle * (1 - taper) * (1 - kink)), (1.0, taper)]

    def section(out: float, share: float) -> Section:
        front = front_edge(place, half * out, sweep, dihedral)
        return aerofoil(front, chord * share, thick * (1 - 0.3 * out))

    return both_sides(lofted([section(*rest) for rest in chords]))


def front_edge(place: tuple[float, float], out: float, sweep: float, dihedral: float) -> tuple[float, float, float]:
    """Returns the front edge of a wing at a distance `out` from the axis."""
    y, z = place
    back, up = np.tan(np.radians([sweep, dihedral]))
    return out, y + out * up, z - out * back


def winglets(place: tuple[float, float], half: float, chord: float, sweep: float, dihedral: float) -> list[Part]:
    """Returns winglets at the tips of a pair of wings; `chord` is that of the tips."""
    x, y, z = front_edge(place, half, sweep, dihedral)
    return both_sides([fin((x, y + 0.015, z), 0.35 * chord + 0.03, 0.8 * chord, 35, 0.2)])


def tip_tanks(place: tuple[float, float], half: float, size: float, sweep: float, dihedral: float) -> list[Part]:
    """Returns slender tanks at the tips of a pair of wings."""
    x, y, z = front_edge(place, half, sweep, dihedral)
    sections = ((2.0, 0.1), (0.0, 0.9), (-1.5, 1.0), (-3.5, 0.7), (-5.5, 0.1))
    rings = [ring((x + 0.5 * size, y, z + t * size), share * size, share * size, 12) for t, share in sections]
    return both_sides([np.concatenate(rings)])


def tail(random: np.random.Generator, wide: float, sweep: float, on_top: bool) -> list[Part]:
    """Returns a fin and a pair of stabilisers, on top of it or at the fuselage's end."""
    high = random.uniform(0.12, 0.2)
    chord = random.uniform(0.12, 0.2)
    span = random.uniform(0.14, 0.22)
    base = 0.5 * wide
    z = chord - 0.5 + random.uniform(0, 0.03)
    upright = fin((0, base, z), high, chord, sweep, 0)
    top = (base + high, z - high * np.tan(np.radians(sweep)) - 0.02)
    place, dihedral = (top, 0) if on_top else ((base, z - 0.03), 5)
    return [upright, *wing(random, place, span, 0.7 * chord, random.uniform(0.35, 0.8), 0.9 * sweep, dihedral, 0.1)]


def fin(place: Vector, high: float, chord: float, sweep: float, lean: float) -> Part:
    """Returns an upright fin from its foot's front edge; the top is `lean` × its height further out."""
    x, y, z = place
    across = np.array([1.0, -lean, 0.0])
    back = np.tan(np.radians(sweep))
    top = aerofoil((x + lean * high, y + high, z - high * back), 0.5 * chord, 0.09, across)
    return np.concatenate([aerofoil((x, y - 0.02, z), chord, 0.1, across), top])


def gear(random: np.random.Generator, wide: float, at: float, often: float) -> list[Part]:
    """Returns a wheel below the nose or the tail and a pair below the wings, or nothing."""
    if random.random() > often:
        return []
    size = random.uniform(0.012, 0.022)
    low = -wide - random.uniform(0.03, 0.08)
    out = random.uniform(0.8, 2.2) * wide
    third = 0.5 - random.uniform(0.1, 0.15) if random.random() < 0.75 else -0.45
    parts = []
    for x, z in ((0.0, third), (-out, at - 0.08), (out, at - 0.08)):
        parts.append(rod((x, low, z), (0.6 * x, -0.3 * wide, z), 0.4 * size, 0.4 * size, 8))
        parts.append(rod((x - 0.4 * size, low, z), (x + 0.4 * size, low, z), size, size, 16))
    return parts


def jet(place: Vector, size: float, long: float) -> Part:
    """Returns a nacelle around a place, thickest in its first half."""
    x, y, z = place
    sections = ((0.5, 0.85), (0.25, 1.0), (-0.5, 0.6))
    return np.concatenate([ring((x, y, z + along * long), size * share, size * share) for along, share in sections])


def spinner(place: Vector, size: float, radius: float, random: np.random.Generator) -> list[Part]:
    """Returns a propeller's hub with two to four blades, or none."""
    x, y, z = place
    parts = [rod((x, y, z - 0.02), (x, y, z + 0.025), size, 0.2 * size)]
    blades = int(random.choice([0, 2, 3, 4]))
    first = random.uniform(0, np.pi)
    for angle in first + np.arange(blades) * 2 * np.pi / max(blades, 1):
        end = (x + radius * np.cos(angle), y + radius * np.sin(angle), z)
        parts.append(rod((x, y, z), end, 0.008, 0.004, 6))
    return parts


def canopy(random: np.random.Generator, wide: float, z: float) -> Part:
    """Returns a canopy on top of the fuselage."""
    long = random.uniform(0.07, 0.12)
    y = 0.55 * wide
    along = np.linspace(-0.95, 0.95, 7)
    sizes = np.sqrt(1 - along**2) * wide
    return np.concatenate([ring((0, y, z + t * long), 0.6 * size, 0.95 * size) for t, size in zip(along, sizes)])


def lofted(sections: list[Section]) -> list[Part]:
    """Returns the parts between consecutive sections."""
    return [np.concatenate(pair) for pair in pairwise(sections)]


def ring(middle: Vector, wide: float, tall: float, sides: int = 24, boxy: float = 2.0) -> Section:
    """Returns a superellipse (Lamé 1818) across the nose's direction; `boxy` is its exponent, 2 for an ellipse."""
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across, up = (np.sign(unit) * np.abs(unit) ** (2 / boxy) * (wide, tall)).T
    return np.asarray(middle) + np.stack([across, up, 0 * up], axis=1)


def aerofoil(front: Vector, chord: float, thick: float, across: Vector = (0.0, 1.0, 0.0)) -> Section:
    """Returns NACA's symmetric four-digit profile (Jacobs, Ward and Pinkerton 1933), from front edge to rear."""
    along = np.linspace(0, 1, 10) ** 1.5
    powers = along[:, None] ** np.array([0.5, 1, 2, 3, 4])
    half = 5 * thick * powers @ np.array([0.2969, -0.126, -0.3516, 0.2843, -0.1015]) * chord
    spine = np.asarray(front) - along[:, None] * (0, 0, chord)
    return np.concatenate([spine + half[:, None] * across, spine - half[:, None] * across])
