"""What aircraft are put together from, one long and the nose to +z: shells between sections, and round things."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float

from experiments.procedural.parts import Part, Vector, rod

Section = Float[np.ndarray, "around 3"]
"""Points around a part, of which the part to the next section is the convex hull."""


def both_sides(parts: list[Part]) -> list[Part]:
    """Parts of one side, and their like on the other."""
    return [part * (side, 1, 1) for side in (1, -1) for part in parts]


def fuselage(random: np.random.Generator, wide: float, nose: float, rear: float, thick_end: float = 0.0) -> list[Part]:
    """Round, flattened or boxy; `nose` and `rear` are how long its ends are, which lift towards the tail."""
    tall, blunt, lift = wide * random.uniform(0.9, 1.3), random.uniform(0.25, 1.0), random.uniform(0.2, 0.8)
    last, slender = max(thick_end, random.uniform(0.06, 0.25)), random.uniform(0.8, 1.8)
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
    """A pair from the fuselage's axis outwards; its front edge begins at the height and place along that is given."""
    kink, middle = random.uniform(0.25, 0.45), random.choice([0.0, random.uniform(0.0, 0.25)])
    chords = [(0.0, 1.0), (kink, 1 - (1 - taper) * kink - middle * (1 - taper) * (1 - kink)), (1.0, taper)]

    def section(out: float, share: float) -> Section:
        front = front_edge(place, half * out, sweep, dihedral)
        return aerofoil(front, chord * share, thick * (1 - 0.3 * out))

    return both_sides(lofted([section(*rest) for rest in chords]))


def front_edge(place: tuple[float, float], out: float, sweep: float, dihedral: float) -> tuple[float, float, float]:
    """Where it is so far out, of a wing that begins at a height and a place along."""
    (y, z), (back, up) = place, np.tan(np.radians([sweep, dihedral]))
    return out, y + out * up, z - out * back


def winglets(place: tuple[float, float], half: float, chord: float, sweep: float, dihedral: float) -> list[Part]:
    """What stands up at the ends of a pair of wings whose root's front edge is at a place, `chord` long at the tips."""
    x, y, z = front_edge(place, half, sweep, dihedral)
    return both_sides([fin((x, y + 0.015, z), 0.35 * chord + 0.03, 0.8 * chord, 35, 0.2)])


def tip_tanks(place: tuple[float, float], half: float, size: float, sweep: float, dihedral: float) -> list[Part]:
    """Slender ones at the ends of a pair of wings."""
    x, y, z = front_edge(place, half, sweep, dihedral)
    sections = ((2.0, 0.1), (0.0, 0.9), (-1.5, 1.0), (-3.5, 0.7), (-5.5, 0.1))
    rings = [ring((x + 0.5 * size, y, z + t * size), share * size, share * size, 12) for t, share in sections]
    return both_sides([np.concatenate(rings)])


def tail(random: np.random.Generator, wide: float, sweep: float, on_top: bool) -> list[Part]:
    """A fin and a pair of stabilisers, on top of it or beside the fuselage's end."""
    high, chord, span = random.uniform(0.12, 0.2), random.uniform(0.12, 0.2), random.uniform(0.14, 0.22)
    base, z = 0.5 * wide, chord - 0.5 + random.uniform(0, 0.03)
    upright = fin((0, base, z), high, chord, sweep, 0)
    top = (base + high, z - high * np.tan(np.radians(sweep)) - 0.02)
    place, dihedral = (top, 0) if on_top else ((base, z - 0.03), 5)
    return [upright, *wing(random, place, span, 0.7 * chord, random.uniform(0.35, 0.8), 0.9 * sweep, dihedral, 0.1)]


def fin(place: Vector, high: float, chord: float, sweep: float, lean: float) -> Part:
    """An upright one from its foot's front edge; `lean` × its height its top is further out."""
    x, y, z = place
    across, back = np.array([1.0, -lean, 0.0]), np.tan(np.radians(sweep))
    top = aerofoil((x + lean * high, y + high, z - high * back), 0.5 * chord, 0.09, across)
    return np.concatenate([aerofoil((x, y - 0.02, z), chord, 0.1, across), top])


def gear(random: np.random.Generator, wide: float, at: float, often: float) -> list[Part]:
    """A wheel below the nose or the tail and a pair below the wings, if it is out at all."""
    if random.random() > often:
        return []
    size, low, out = random.uniform(0.012, 0.022), -wide - random.uniform(0.03, 0.08), random.uniform(0.8, 2.2) * wide
    third = 0.5 - random.uniform(0.1, 0.15) if random.random() < 0.75 else -0.45
    parts = []
    for x, z in ((0.0, third), (-out, at - 0.08), (out, at - 0.08)):
        parts.append(rod((x, low, z), (0.6 * x, -0.3 * wide, z), 0.4 * size, 0.4 * size, 8))
        parts.append(rod((x - 0.4 * size, low, z), (x + 0.4 * size, low, z), size, size, 16))
    return parts


def jet(place: Vector, size: float, long: float) -> Part:
    """A nacelle about a place, thickest in its first half."""
    x, y, z = place
    sections = ((0.5, 0.85), (0.25, 1.0), (-0.5, 0.6))
    return np.concatenate([ring((x, y, z + along * long), size * share, size * share) for along, share in sections])


def spinner(place: Vector, size: float, radius: float, random: np.random.Generator) -> list[Part]:
    """A propeller's hub, with two to four blades, or none where it turns too fast to be drawn."""
    x, y, z = place
    parts = [rod((x, y, z - 0.02), (x, y, z + 0.025), size, 0.2 * size)]
    blades, first = int(random.choice([0, 2, 3, 4])), random.uniform(0, np.pi)
    for angle in first + np.arange(blades) * 2 * np.pi / max(blades, 1):
        end = (x + radius * np.cos(angle), y + radius * np.sin(angle), z)
        parts.append(rod((x, y, z), end, 0.008, 0.004, 6))
    return parts


def canopy(random: np.random.Generator, wide: float, z: float) -> Part:
    """A glass hood on top of the fuselage."""
    long, y = random.uniform(0.07, 0.12), 0.55 * wide
    along = np.linspace(-0.95, 0.95, 7)
    sizes = np.sqrt(1 - along**2) * wide
    return np.concatenate([ring((0, y, z + t * long), 0.6 * size, 0.95 * size) for t, size in zip(along, sizes)])


def lofted(sections: list[Section]) -> list[Part]:
    """What lies between sections that follow each other."""
    return [np.concatenate(pair) for pair in pairwise(sections)]


def ring(middle: Vector, wide: float, tall: float, sides: int = 24, boxy: float = 2.0) -> Section:
    """An upright ellipse across the nose's direction; above 2, `boxy` is the exponent of a superellipse (Lamé 1818)."""
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    unit = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    across, up = (np.sign(unit) * np.abs(unit) ** (2 / boxy) * (wide, tall)).T
    return np.asarray(middle) + np.stack([across, up, 0 * up], axis=1)


def aerofoil(front: Vector, chord: float, thick: float, across: Vector = (0.0, 1.0, 0.0)) -> Section:
    """NACA's symmetric profile of four digits (Jacobs, Ward and Pinkerton 1933), from its front edge to the rear."""
    along = np.linspace(0, 1, 10) ** 1.5
    powers = along[:, None] ** np.array([0.5, 1, 2, 3, 4])
    half = 5 * thick * powers @ np.array([0.2969, -0.126, -0.3516, 0.2843, -0.1015]) * chord
    spine = np.asarray(front) - along[:, None] * (0, 0, chord)
    return np.concatenate([spine + half[:, None] * across, spine - half[:, None] * across])
