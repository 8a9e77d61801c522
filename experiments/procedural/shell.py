"""Shells to sit in: thin and curved, seat, back and sometimes arms in one piece."""

import numpy as np
from jaxtyping import Float

from experiments.procedural.parts import Part, sheet


def shell(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A bent board, or a tub, from the seat's height to the back's top."""
    return (tub if random.random() < 0.45 else bent)(random, wide, deep, heights)


def bent(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A board that turns from seat to back in a curve, its sides raised and brought forwards."""
    profile = _profile(random, deep, heights)
    along = np.linspace(-1, 1, int(random.choice([2, 7])))
    waist, crown, last = random.uniform(0.7, 1.0), random.uniform(0.6, 1.05), len(profile) - 1
    half = wide / 2 * np.interp(np.arange(last + 1), [0, 4, 7, last], [1, waist, waist, crown])
    raised, of_back = random.uniform(0, 0.07) * along**2, np.linspace(0, 1, last + 1)[:, None] ** 2
    up, forwards = raised * (1 - of_back), raised * of_back * random.uniform(0, 2)
    grid = np.stack([along * half[:, None], profile[:, :1] + up, profile[:, 1:] + forwards], axis=-1)
    return sheet(grid, random.uniform(0.012, 0.035))


def _profile(random: np.random.Generator, deep: float, heights: tuple[float, float]) -> Float[np.ndarray, "points 2"]:
    """Heights and depths, from the seat's front edge through the bend to the top of the back, which leans."""
    (low, top), bend, lean = heights, random.uniform(0.04, 0.16), np.radians(random.uniform(0, 22))
    angles = np.linspace(0, np.pi / 2 - lean, 6)
    corner = np.stack([low + bend * (1 - np.cos(angles)), -deep / 2 + bend * (1 - np.sin(angles))], axis=1)
    edges = np.array([[low - random.uniform(0, 0.04), deep / 2], [low, deep / 2 - 0.06]])
    upper = np.array([[0.5, -0.5 * np.tan(lean)], [1, -np.tan(lean)]]) * max(top - corner[-1, 0], 0.1)
    return np.concatenate([edges, corner, corner[-1] + upper])


def tub(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A dish with a wall around its rear and sides, which falls towards the front."""
    low, top = heights
    reach = np.radians(random.uniform(80, 150))  # from the rear to either end of the wall
    turns, levels = np.linspace(-reach, reach, 17), np.linspace(0, 1, 5)[:, None]
    arm = random.uniform(0.0, 0.6) * (top - low)
    wall = arm + (top - low - arm) * np.clip(np.cos(turns * np.pi / 2 / reach), 0, 1) ** random.uniform(0.5, 2.5)
    flare, foot, up = random.uniform(0.0, 0.3), random.uniform(0.6, 0.95), levels * wall
    out = foot + (1 - foot) * levels**0.5 + flare * up
    sides = [wide / 2 * out * np.sin(turns), low + up, -deep / 2 * out * np.cos(turns) - 0.1 * up]
    thick = random.uniform(0.012, 0.05)
    dish = _dish(foot * wide / 2, foot * deep / 2, low, thick * random.uniform(1, 2))
    return sheet(np.stack(sides, axis=-1), thick) + dish


def _dish(wide: float, deep: float, low: float, thick: float) -> list[Part]:
    """Of these half-axes; its middle is lower than its rim."""
    around = np.linspace(-np.pi, np.pi, 25)
    rim = np.stack([wide * np.sin(around), np.zeros(25), -deep * np.cos(around)], axis=-1)
    return sheet(np.stack([share * rim + (0, low - 0.05 * (1 - share**2), 0) for share in (0, 0.4, 0.75, 1)]), thick)
