"""Procedural tables."""

import numpy as np

from experiments.procedural.chair import legs
from experiments.procedural.foot import foot
from experiments.procedural.parts import Part, bar, block, disc


def table(random: np.random.Generator) -> list[Part]:
    """Returns a top on legs, a foot, sides or trestles, with or without shelf and drawers."""
    wide = random.uniform(0.45, 2.2)
    deep = wide * random.uniform(0.35, 1.0) if wide < 1.1 else random.uniform(0.45, 1.1)
    high = random.uniform(0.35, 0.8)
    thick = random.uniform(0.012, 0.08)
    round_top = random.random() < 0.3
    parts = [top(random, wide, deep, high, thick, round_top)]
    inset = 0.7 if round_top else 1.0
    under = high - thick / 2
    half = (inset * wide / 2, inset * deep / 2)
    style = random.choice(["legs", "foot", "sides", "frames", "trestles"], p=[0.55, 0.15, 0.1, 0.1, 0.1])
    if round_top and style not in ("legs", "foot"):
        style = "foot"
    if style == "legs":
        edge = random.uniform(0.03, 0.12)
        parts += legs(random, (half[0] - edge, half[1] - edge), under, random.uniform(0.012, 0.045))
    elif style == "foot":
        parts += foot(random, min(half) * random.uniform(0.55, 0.9), under)
    else:
        parts += ends(random, style, half, under)
    return parts + extras(random, half, under, round_top)


def top(random: np.random.Generator, wide: float, deep: float, high: float, thick: float, round_top: bool) -> Part:
    if round_top:
        return disc((0, high - thick, 0), wide / 2, thick, deep / wide if random.random() < 0.5 else 1.0)
    low = (-wide / 2, high - thick, -deep / 2)
    far = (wide / 2, high, deep / 2)
    return block(low, far, thick * random.uniform(0.02, 0.4))


def ends(random: np.random.Generator, style: str, half: tuple[float, float], high: float) -> list[Part]:
    """Returns a pair of boards, closed frames, or trestles shaped like T, A or X, with a beam between."""
    x, z = (half[0] * random.uniform(0.6, 0.97), half[1] * random.uniform(0.6, 0.97))
    thin = random.uniform(0.012, 0.035)
    shape = random.choice(["T", "A", "X"])
    beam = high * random.uniform(0.2, 0.8)
    parts: list[Part] = []
    for s in (-x, x):
        corners = [(s, thin, -z), (s, thin, z), (s, high, z), (s, high, -z)]
        if style == "sides":
            parts.append(block((s - thin, 0, -z), (s + thin, high, z), 0.004))
        elif style == "frames":
            parts += [bar(a, b, thin) for a, b in zip(corners, corners[1:] + corners[:1])]
        elif shape == "X":
            parts += [bar(corners[0], corners[2], thin), bar(corners[1], corners[3], thin)]
        elif shape == "A":
            parts += [bar(corners[k], (s, high, 0.15 * corners[k][2]), thin) for k in (0, 1)]
        else:
            parts += [bar(corners[0], corners[1], thin), bar((s, 0.02, 0), (s, high, 0), 1.5 * thin)]
            parts.append(bar(corners[2], corners[3], thin))
    if style == "trestles" or random.random() < 0.4:
        parts.append(bar((-x, beam, 0), (x, beam, 0), thin))
    return parts


def extras(random: np.random.Generator, half: tuple[float, float], high: float, round_top: bool) -> list[Part]:
    """Returns a shelf below the top, or drawers under one end or both, or nothing."""
    x, z = half
    parts = []
    if random.random() < 0.2:
        y = high * random.uniform(0.15, 0.5)
        edge = random.uniform(0.03, 0.1)
        parts.append(block((-x + edge, y, -z + edge), (x - edge, y + 0.025, z - edge), 0.005))
    if not round_top and random.random() < 0.2:
        wide = min(random.uniform(0.3, 0.5), x)
        low = high * random.choice([0.0, 0.1, 0.5, 0.75])
        for side in [(-1,), (1,), (-1, 1)][random.integers(3)]:
            left, right = sorted((side * (x - 0.03), side * (x - wide)))
            parts.append(block((left, low, -z + 0.04), (right, high, z - 0.04), 0.008))
    if not round_top and random.random() < 0.06:
        parts.append(block((-x, high, -z), (x, high + random.uniform(0.15, 0.5), -z + 0.03), 0.005))
    return parts
