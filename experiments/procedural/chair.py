"""Procedural chairs."""

import numpy as np

from experiments.procedural.foot import foot
from experiments.procedural.parts import Part, Point, bar, block, bowed, disc, post, rod, tilted
from experiments.procedural.shell import shell
from experiments.procedural.sofa import sofa


def chair(random: np.random.Generator) -> list[Part]:
    """Returns a seat on legs, a foot or a frame, with or without back and arms, sometimes upholstered or a shell."""
    if random.random() < 0.12:
        return sofa(random, wide=random.uniform(0.6, 0.95))
    wide = random.uniform(0.38, 0.62)
    deep = random.uniform(0.38, 0.58)
    high = random.uniform(0.4, 0.52)
    top = high + random.uniform(0.28, 0.65)
    if random.random() < 0.17:
        parts = shell(random, wide, deep, (high, top)) + base(random, 0.8 * wide, 0.8 * deep, high - 0.02)
        return parts + (arms(random, wide, deep, high, random.uniform(0.14, 0.28)) if random.random() < 0.2 else [])
    thick = random.choice([random.uniform(0.02, 0.05), random.uniform(0.05, 0.13)])
    parts = seat(random, wide, deep, high, thick)
    parts += base(random, wide, deep, high - thick / 2)
    if random.random() < 0.95:
        parts += back(random, wide * random.uniform(0.8, 1.0), deep, (high, top))
    if random.random() < 0.4:
        parts += arms(random, wide, deep, high, random.uniform(0.14, 0.28))
    return parts


def seat(random: np.random.Generator, wide: float, deep: float, high: float, thick: float) -> list[Part]:
    """Returns a board or cushion, a round seat, or slats on two bars."""
    style = random.choice(["board", "round", "slats"], p=[0.78, 0.1, 0.12])
    if style == "round":
        return [disc((0, high - thick, 0), wide / 2, thick, deep / wide)]
    if style == "board":
        return [
            block((-wide / 2, high - thick, -deep / 2), (wide / 2, high, deep / 2), thick * random.uniform(0.1, 0.48))
        ]
    half = deep / int(random.integers(4, 9)) / 2
    ends = np.arange(-deep / 2 + half, deep / 2, 2 * half)
    slats = [block((-wide / 2, high - 0.02, z - 0.8 * half), (wide / 2, high, z + 0.8 * half), 0.004) for z in ends]
    return slats + [
        bar((s * wide * 0.4, high - 0.03, -deep / 2), (s * wide * 0.4, high - 0.03, deep / 2), 0.015) for s in (-1, 1)
    ]


def base(random: np.random.Generator, wide: float, deep: float, high: float) -> list[Part]:
    """Returns what carries a seat whose underside is at `high`."""
    styles = ["legs", "foot", "sled", "cantilever", "crossed", "folding"]
    style = random.choice(styles, p=[0.5, 0.2, 0.08, 0.08, 0.07, 0.07])
    x = wide / 2 - random.uniform(0.015, 0.06)
    z = deep / 2 - random.uniform(0.015, 0.06)
    thin = random.uniform(0.008, 0.025)
    if style == "legs":
        return legs(random, (x, z), high, thin)
    if style == "foot":
        return foot(random, random.uniform(0.2, 0.34), high)
    if style == "folding":
        return folding(random, (x, z), high)
    parts = []
    for s in (-x, x):
        front = (s, thin, z)
        rear = (s, thin, -z)
        if style == "crossed":
            parts += [rod(front, (s, high, -z), thin, thin), rod(rear, (s, high, z), thin, thin)]
        else:
            parts += [rod(front, (s, high, z), thin, thin), rod(front, rear, thin, thin)]
            parts += [rod(rear if style == "sled" else (s, high, z), (s, high, -z), thin, thin)]
    return parts + [rod((-x, y, -z), (x, y, -z), thin, thin) for y in (thin, high)]


def folding(random: np.random.Generator, place: tuple[float, float], high: float) -> list[Part]:
    """Returns two frames that cross at the sides; the front one continues upwards behind the seat."""
    x, z = place
    thin = random.uniform(0.007, 0.015)
    inner = random.uniform(0.0, 0.03)
    rear = -z * random.uniform(0.6, 1.1)
    meets = z * random.uniform(0.1, 1.0)
    above = random.uniform(0.0, 0.45)
    slope = -2 * z * random.uniform(0.7, 1.0) / high
    parts = []
    ends = [((x, 0.0, z), (x, high + above, z + slope * (high + above)))]
    ends += [((x - inner, 0.0, rear), (x - inner, high, meets))]
    for begin, end in ends:
        y = random.uniform(0.03, 0.45) * high
        at = np.array(begin) + (np.array(end) - begin) * y / end[1]
        parts += [bar(np.array(begin) * (s, 1, 1), np.array(end) * (s, 1, 1), thin) for s in (-1, 1)]
        parts += [bar(at * (-1, 1, 1), at, 0.8 * thin), bar(np.array(end) * (-1, 1, 1), end, 0.8 * thin)]
    return parts


def legs(random: np.random.Generator, place: tuple[float, float], high: float, thin: float) -> list[Part]:
    """Returns four legs, round or square, upright or splayed, with or without stretchers."""
    x, z = place
    splay = random.choice([0.0, random.uniform(0.01, 0.09)])
    taper = random.uniform(1.0, 1.7)
    square = random.random() < 0.4

    def at(a: float, b: float, y: float) -> Point:
        out = 1 - y / high
        return (a * x + np.sign(a) * splay * out, y, b * z + np.sign(b) * splay * out)

    corners = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    parts = [(post if square else rod)(at(a, b, 0), at(a, b, high), thin, thin * taper) for a, b in corners]
    if random.random() < 0.45:
        y = high * random.uniform(0.2, 0.6)
        parts += [bar(at(s, -1, y), at(s, 1, y), thin * 0.7) for s in (-1, 1)]
        across = random.choice([0, 1, 2])
        middles = [[], [(0.0, 0.0)], [(-1.0, -1.0), (1.0, 1.0)]][across]
        parts += [bar(at(-1, front, y), at(1, rear, y), thin * 0.7) for front, rear in middles]
    if random.random() < 0.4:
        parts += [block((-x, high - 0.06, s * z - thin / 2), (x, high, s * z + thin / 2), 0.003) for s in (-1, 1)]
        parts += [block((s * x - thin / 2, high - 0.06, -z), (s * x + thin / 2, high, z), 0.003) for s in (-1, 1)]
    return parts


def back(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """Returns a board, straight or bowed, or a frame with slats, rungs or a cushion, leaning backwards."""
    seat_top, top = heights
    rear = -deep / 2
    half = wide / 2
    style = random.choice(["board", "bowed", "upright", "ladder", "frame"], p=[0.3, 0.2, 0.2, 0.2, 0.1])
    thin = random.uniform(0.01, 0.022)
    hinge = np.array([0.0, seat_top, rear + 0.02])
    low = seat_top + random.choice([-0.03, random.uniform(0.02, 0.5) * (top - seat_top)])
    posts = [
        rod((s * (half - thin), seat_top - 0.04, rear + 0.02), (s * (half - thin), top, rear + 0.02), thin, thin)
        for s in (-1, 1)
    ]
    lean = random.uniform(-22, 0)
    if style in ("board", "bowed"):
        thick = random.uniform(0.015, 0.09)
        bow = random.uniform(0.03, 0.14) if style == "bowed" else 0.0
        parts = bowed((-half, low, rear), (half, top, rear + thick), bow, thick * random.uniform(0.1, 0.45))
        parts += posts if low > seat_top else []
    else:
        parts = [
            *posts,
            bar((-half, top - thin, rear + 0.02), (half, top - thin, rear + 0.02), thin * random.uniform(1, 2)),
        ]
    if style == "upright":
        number = int(random.integers(2, 9))
        parts += [
            bar((x, seat_top - 0.02, rear + 0.02), (x, top, rear + 0.02), thin * 0.6)
            for x in np.linspace(-half, half, number + 2)[1:-1]
        ]
    if style == "ladder":
        tall = (top - seat_top) / int(random.integers(2, 6))
        for y in np.arange(top - tall, seat_top + tall / 3, -tall):
            parts.append(
                block((-half, y, rear + 0.012), (half, y + tall * random.uniform(0.3, 0.7), rear + 0.03), 0.004)
            )
    if style == "frame":
        parts.append(block((-half, low, rear), (half, top - 0.02, rear + 0.05), 0.015))
    return [tilted(part - hinge, lean) + hinge for part in parts]


def arms(random: np.random.Generator, wide: float, deep: float, seat_top: float, above: float) -> list[Part]:
    """Returns a pair of rails on posts, at the front or in the middle, or closed sides."""
    thick = random.uniform(0.012, 0.03)
    x = wide / 2 + random.uniform(-0.01, 0.04)
    front = deep / 2 * random.uniform(0.4, 1.0)
    y = seat_top + above
    if random.random() < 0.2:
        return [
            block((s * x - thick, seat_top - 0.1, -deep / 2), (s * x + thick, y, front), thick * 0.6) for s in (-1, 1)
        ]
    rails = [
        block((s * x - 1.3 * thick, y - thick, -deep / 2 - 0.02), (s * x + 1.3 * thick, y, front), thick * 0.4)
        for s in (-1, 1)
    ]
    stand = random.choice([0.9, 0.4]) * front
    posts = [
        rod((s * (x - 0.02), seat_top - 0.06, stand), (s * x, y - thick / 2, stand), thick * 0.6, thick * 0.6)
        for s in (-1, 1)
    ]
    return rails + posts
