"""Procedural aircraft of length 1 with the nose to +z."""

import numpy as np

from experiments.procedural.airframe import (
    both_sides,
    canopy,
    fin,
    front_edge,
    fuselage,
    gear,
    jet,
    spinner,
    tail,
    tip_tanks,
    wing,
    winglets,
)
from experiments.procedural.parts import Part, block, rod


def plane(random: np.random.Generator) -> list[Part]:
    """Returns an airliner, a propeller aircraft, a fighter or a glider, sometimes on its wheels."""
    kinds = (airliner, propeller, fighter, glider)
    return kinds[random.choice(len(kinds), p=[0.38, 0.38, 0.2, 0.04])](random)


def airliner(random: np.random.Generator) -> list[Part]:
    """Returns low swept wings with jets below them, or with jets at the rear under a T-tail."""
    wide = random.uniform(0.04, 0.065)
    at = random.uniform(0.02, 0.14)
    span = random.uniform(0.75, 1.1)
    high = random.random() < 0.15
    rear = random.random() < 0.35
    y = (0.8 if high else -0.6) * wide
    sweep = random.uniform(22, 36)
    dihedral = random.uniform(-4, 1) if high else random.uniform(3, 8)
    chord = random.uniform(0.15, 0.22)
    taper = random.uniform(0.15, 0.35)
    parts = fuselage(random, wide, random.uniform(0.1, 0.16), random.uniform(0.28, 0.4))
    parts += wing(random, (y, at), span / 2, chord, taper, sweep, dihedral)
    parts += winglets((y, at), span / 2, taper * chord, sweep, dihedral) if random.random() < 0.25 else []
    parts += tail(random, wide, sweep + random.uniform(0, 12), on_top=high or rear or random.random() < 0.08)
    size = wide * random.uniform(0.35, 0.6)
    if rear:
        parts += jets_at_rear(random, wide, size)
    else:
        parts += jets_beneath(random, (y, at), span / 2, size, sweep, dihedral)
    return parts + gear(random, wide, at, 0.4)


def jets_at_rear(random: np.random.Generator, wide: float, size: float) -> list[Part]:
    """Returns a pair of jets at the fuselage's end, sometimes with a third at the foot of the fin."""
    out = wide + 0.9 * size
    y = 0.4 * wide
    parts = both_sides([jet((out, y, -0.26), size, random.uniform(0.1, 0.14))])
    parts.append(block((-out, y - 0.004, -0.29), (out, y + 0.004, -0.24), 0.003))
    if random.random() < 0.3:
        parts.append(jet((0, 1.3 * wide, -0.38), 0.5 * wide, 0.24))
    return parts


def jets_beneath(
    random: np.random.Generator, place: tuple[float, float], half: float, size: float, sweep: float, dihedral: float
) -> list[Part]:
    """Returns one or two jets on pylons below each wing; `place` is that of the root's front edge."""
    parts = []
    for x in half * (random.choice([0.33, 0.3]) + 0.3 * np.arange(random.choice([1, 2], p=[0.8, 0.2]))):
        _, high, edge = front_edge(place, x, sweep, dihedral)
        z = edge + random.uniform(0.02, 0.06)
        under = high - 1.15 * size
        parts.append(jet((x, under, z), size, random.uniform(0.08, 0.14)))
        parts.append(block((x - 0.004, under, z - 0.1), (x + 0.004, under + 1.3 * size, z), 0.003))
    return both_sides(parts)


def propeller(random: np.random.Generator) -> list[Part]:
    """Returns straight wings, low, high, or a biplane's, with an engine in the nose or engines on the wings."""
    engines = int(random.choice([1, 2, 4], p=[0.55, 0.35, 0.1]))
    wide = random.uniform(0.05, 0.085) if engines == 1 else random.uniform(0.045, 0.065)
    at = random.uniform(0.08, 0.2)
    span = random.uniform(0.8, 1.45)
    high = random.random() < 0.5
    chord = random.uniform(0.13, 0.2)
    taper = random.uniform(0.4, 1.0)
    sweep = random.uniform(-2, 6)
    y = (0.9 if high else -0.7) * wide
    dihedral = random.uniform(0, 2) if high else random.uniform(2, 7)
    parts = fuselage(random, wide, random.uniform(0.06, 0.16), random.uniform(0.35, 0.6))
    parts += wing(random, (y, at), span / 2, chord, taper, sweep, dihedral)
    if random.random() < 0.1:
        parts += tip_tanks((y, at), span / 2, random.uniform(0.012, 0.022), sweep, dihedral)
    if engines == 1 and random.random() < 0.2:
        above = y + random.uniform(0.12, 0.2)
        out = 0.3 * span
        parts += wing(random, (above, at + 0.03), span / 2, chord, taper, sweep, dihedral)
        parts += both_sides([rod((out, y, at - 0.05), (out, above, at - 0.02), 0.004, 0.004, 6)])
    elif engines == 1 and high and random.random() < 0.6:
        parts += both_sides([rod((wide, -0.5 * wide, at - 0.06), (0.25, y, at - 0.06), 0.004, 0.005, 6)])
    parts += tail(random, wide, random.uniform(0, 30), on_top=engines > 1 and random.random() < 0.5)
    if engines == 1:
        parts += [canopy(random, wide, at - random.uniform(0.0, 0.08))] if random.random() < 0.7 else []
        return parts + spinner((0, 0, 0.5), 0.3 * wide, random.uniform(0.1, 0.15), random) + gear(random, wide, at, 0.7)
    return parts + on_wings(random, engines // 2, (y, at), chord, dihedral) + gear(random, wide, at, 0.4)


def on_wings(
    random: np.random.Generator, pairs: int, place: tuple[float, float], chord: float, dihedral: float
) -> list[Part]:
    """Returns engines with propellers on the wings; `place` is that of the root's front edge."""
    y, at = place
    up = np.tan(np.radians(dihedral))
    parts = []
    for x in np.arange(1, pairs + 1) * random.uniform(0.11, 0.15) + 0.02:
        size = random.uniform(0.018, 0.03)
        high = y + x * up
        parts.append(rod((x, high, at - chord), (x, high, at), 0.3 * size, size))
        parts.append(rod((x, high, at), (x, high, at + 0.07), size, 0.7 * size))
        parts += spinner((x, high, at + 0.07), 0.4 * size, 0.09, random)
    return both_sides(parts)


def fighter(random: np.random.Generator) -> list[Part]:
    """Returns short swept or delta wings at half height, intakes at the sides, a canopy, and one or two fins."""
    wide = random.uniform(0.04, 0.06)
    delta = random.random() < 0.4
    span = random.uniform(0.5, 0.8)
    chord = random.uniform(0.38, 0.5) if delta else random.uniform(0.22, 0.32)
    at = random.uniform(0.02, 0.12)
    sweep = random.uniform(45, 58) if delta else random.uniform(18, 45)
    y = random.uniform(-0.4, 0.6) * wide
    taper = random.uniform(0.05, 0.2) if delta else random.uniform(0.2, 0.4)
    parts = fuselage(random, wide, random.uniform(0.25, 0.35), random.uniform(0.15, 0.3), thick_end=0.7)
    parts += wing(random, (y, at), span / 2, chord, taper, sweep, random.uniform(-4, 2), thick=0.05)
    parts += [canopy(random, wide, random.uniform(0.2, 0.28))]
    intake = random.uniform(0.6, 1.0) * wide
    end = random.uniform(0.1, 0.2)
    parts += both_sides([block((0.6 * wide, -intake, -0.35), (1.4 * wide, 0.3 * intake, end), 0.012)])
    high = random.uniform(0.14, 0.2)
    sweep_of_fin = random.uniform(35, 50)
    if random.random() < 0.4:
        lean = random.uniform(0, 0.4)
        parts += both_sides([fin((wide, 0.5 * wide, -0.3), high, 0.17, sweep_of_fin, lean)])
    else:
        parts.append(fin((0, 0.5 * wide, -0.3), high, 0.17, sweep_of_fin, 0))
    if not delta:
        parts += wing(random, (0, -0.35), random.uniform(0.16, 0.24), 0.13, 0.3, random.uniform(30, 45), 0, thick=0.05)
    elif random.random() < 0.4:
        parts += wing(random, (0.3 * wide, 0.22), random.uniform(0.12, 0.18), 0.1, 0.2, 45, 0, thick=0.05)
    return parts + gear(random, wide, at - 0.1, 0.3)


def glider(random: np.random.Generator) -> list[Part]:
    """Returns long slender wings at half height, a thin rear, a canopy at the front, and no engine."""
    wide = random.uniform(0.035, 0.05)
    at = random.uniform(0.1, 0.18)
    span = random.uniform(1.5, 2.2)
    chord = random.uniform(0.09, 0.13)
    taper = random.uniform(0.3, 0.7)
    y = random.uniform(0.1, 0.7) * wide
    parts = fuselage(random, wide, random.uniform(0.15, 0.25), random.uniform(0.55, 0.65))
    parts += wing(random, (y, at), span / 2, chord, taper, random.uniform(-2, 3), random.uniform(1, 4))
    parts += tail(random, 0.5 * wide, random.uniform(5, 25), on_top=random.random() < 0.6)
    return [*parts, canopy(random, 0.9 * wide, random.uniform(0.25, 0.32))]
