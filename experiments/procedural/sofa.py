"""Procedural sofas."""

from collections.abc import Sequence

import numpy as np

from experiments.procedural.parts import Part, block, rod, row, tilted


def sofa(random: np.random.Generator, wide: float | None = None) -> list[Part]:
    """Returns seats for one to five in a row, with or without back, arms, feet, loose cushions and a chaise longue."""
    wide = wide or random.uniform(0.9, 2.7)
    deep = random.uniform(0.7, 1.1)
    floor = random.choice([0.0, random.uniform(0.03, 0.2)])
    seat = random.uniform(0.34, 0.5)
    cushion = random.uniform(0.06, 0.2)
    high = random.uniform(0.62, 1.0)
    thick = random.uniform(0.06, 0.28)
    arm = random.choice([0.0, random.uniform(0.04, 0.3)], p=[0.15, 0.85])
    inner = wide / 2 - arm
    base = max(seat - cushion, floor + 0.04)
    seats = int(random.integers(1, max(round(wide / 0.5), 1) + 1))
    soft = random.uniform(0.01, cushion / 2.2)
    gap = cushion_gap(random)

    parts = [block((-wide / 2, floor, -deep / 2), (wide / 2, base, deep / 2), random.uniform(0.005, 0.04))]
    begin = -deep / 2 + thick / 2
    end = deep / 2 + random.uniform(-0.03, 0.03)
    parts += row(seats, (-inner, base - 0.02, begin), (inner, seat, end), soft, gap=gap)
    if random.random() < 0.92:
        parts += back(random, inner if random.random() < 0.5 else wide / 2, seats, deep, (base, seat, high), thick)
    if arm:
        parts += arms(random, wide, arm, deep, (floor, seat, random.uniform(seat + 0.04, high)))
    if random.random() < 0.3 and wide > 1.3:
        parts += chaise(random, wide, deep, (floor, base, seat, high), thick, soft)
    if floor:
        parts += feet(random, wide, deep, floor)
    for _ in range(random.integers(0, 4) if random.random() < 0.35 else 0):
        half = np.array([random.uniform(0.15, 0.26), random.uniform(0.13, 0.24), random.uniform(0.04, 0.09)])
        place = (random.uniform(-0.8, 0.8) * max(inner - half[0], 0), seat + half[1] * 0.9, -deep / 2 + thick + 0.13)
        parts.append(tilted(block(-half, half, half[2] * 0.9), random.uniform(-25, -5)) + place)
    return parts


def cushion_gap(random: np.random.Generator) -> float:
    """Returns the gap between the cushions of a row, zero for half of the rows."""
    return random.choice([0.0, random.uniform(0.003, 0.02)])


def back(
    random: np.random.Generator, half: float, seats: int, deep: float, heights: Sequence[float], thick: float
) -> list[Part]:
    """Returns boards, cushions, both or slats, leaning backwards."""
    base, seat, high = heights
    rear = -deep / 2
    lean = random.uniform(-18, 0)
    hinge = (0.0, base, rear + thick / 2)
    style = random.choice(["board", "cushions", "both", "slats"], p=[0.3, 0.3, 0.3, 0.1])
    parts: list[Part] = []
    if style in ("board", "both"):
        depth = thick if style == "board" else thick * random.uniform(0.3, 0.6)
        radius = random.uniform(0.01, max(depth / 2.1, 0.01))
        parts.append(block((-half, base, rear), (half, high, rear + depth), radius))
    if style == "slats":
        bars = int(random.integers(4, 14))
        parts.append(block((-half, high - 0.06, rear), (half, high, rear + 0.04), 0.01))
        width = random.uniform(0.2, 0.6) * half / bars
        parts += [
            block((x - width, base, rear), (x + width, high - 0.02, rear + 0.035), 0.005)
            for x in np.linspace(-half + width, half - width, bars)
        ]
    if style in ("cushions", "both"):
        begin = rear if style == "cushions" else rear + thick * 0.25
        top = high - random.uniform(-0.08, 0.1)
        number = int(random.choice([seats, max(seats - 1, 1), seats + 1]))
        soft = thick * random.uniform(0.15, 0.48)
        parts += row(number, (-half, seat - 0.05, begin), (half, top, begin + thick), soft, gap=cushion_gap(random))
        parts.append(block((-half, base, rear), (half, seat, rear + thick), 0.01))
    return [tilted(part - hinge, lean) + hinge for part in parts]


def arms(random: np.random.Generator, wide: float, arm: float, deep: float, heights: Sequence[float]) -> list[Part]:
    """Returns a pair of arms: blocks, blocks with rolled tops, wedges, or open frames."""
    floor, seat, high = heights
    rear = -deep / 2
    front = deep / 2 * random.uniform(0.85, 1.0)
    style = random.choice(["block", "rolled", "wedge", "frame"], p=[0.45, 0.2, 0.2, 0.15])
    parts: list[Part] = []
    for side in (-1, 1):
        outer = side * wide / 2
        inner = side * (wide / 2 - arm)
        low = min(outer, inner)
        far = max(outer, inner)
        if style == "frame":
            bar = min(arm, 0.07)
            x = outer - side * bar / 2
            parts.append(block((low, high - 0.04, rear), (far, high, front), 0.012))
            parts += [rod((x, 0.0, z), (x, high, z), bar / 2, bar / 2) for z in (rear + bar, front - bar)]
        elif style == "wedge":
            lower = block((low, floor, rear), (far, floor + 0.1, front), 0.02)
            slope = side * random.uniform(0.0, 0.12)
            parts.append(
                np.concatenate([lower, block((low + slope, high - 0.1, rear), (far + slope, high, front), 0.02)])
            )
            parts.append(block((low, floor, rear), (far, seat, front), 0.01))
        else:
            parts.append(block((low, floor, rear), (far, high, front), random.uniform(0.01, arm / 2.1)))
        if style == "rolled":
            x = (low + far) / 2 + side * arm * 0.2
            radius = arm * random.uniform(0.5, 0.75)
            parts.append(rod((x, high - radius / 2, rear), (x, high - radius / 2, front), radius, radius, 24))
    return parts


def chaise(
    random: np.random.Generator,
    wide: float,
    deep: float,
    heights: Sequence[float],
    thick: float,
    soft: float,
) -> list[Part]:
    """Returns a chaise at one end; half of them have a back along their side."""
    floor, base, seat, high = heights
    side = random.choice([-1, 1])
    across = random.uniform(0.55, 0.95)
    long = random.uniform(0.4, 1.2)
    outer = side * wide / 2
    inner = side * (wide / 2 - across)
    low = min(outer, inner)
    far = max(outer, inner)
    begin = deep / 2 - 0.1
    end = deep / 2 + long
    parts = [block((low, floor, begin), (far, base, end), 0.02)]
    parts += row(int(random.integers(1, 3)), (low, base - 0.02, begin), (far, seat, end), soft, axis=2)
    if random.random() < 0.5:
        x = outer - side * thick
        lower = min(outer, x)
        upper = max(outer, x)
        parts.append(block((lower, floor, -deep / 2), (upper, random.uniform(seat + 0.1, high), end), thick / 3))
    elif floor:
        parts += [rod((x, 0, end - 0.06), (x, floor + 0.02, end - 0.06), 0.02, 0.03) for x in (low + 0.06, far - 0.06)]
    return parts


def feet(random: np.random.Generator, wide: float, deep: float, high: float) -> list[Part]:
    """Returns four or six feet, or two bars along the depth."""
    x = wide / 2 - random.uniform(0.04, 0.15)
    z = deep / 2 - random.uniform(0.04, 0.12)
    thin = random.uniform(0.012, 0.04)
    if random.random() < 0.15:
        return [block((s * x - 0.04, 0, -z), (s * x + 0.04, high + 0.02, z), 0.005) for s in (-1, 1)]
    across = np.linspace(-x, x, 2 if wide < 1.6 else int(random.integers(2, 4)))
    splay = random.choice([0.0, random.uniform(0, 0.06)])
    return [
        rod(
            (a + np.sign(a) * splay, 0, b + np.sign(b) * splay),
            (a, high + 0.03, b),
            thin,
            thin * random.uniform(1, 1.8),
        )
        for a in across
        for b in (-z, z)
    ]
