"""Shells to sit in: thin and curved, seat, back and sometimes arms in one piece."""

import numpy as np

from .parts import Part, sheet


def shell(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A bent board, or a tub, from the seat's height to the back's top."""
    return (tub if random.random() < 0.45 else bent)(random, wide, deep, heights)


def bent(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A board that turns from seat to back in a curve, its sides raised and brought forwards."""
    (low, top), bend, lean = heights, random.uniform(0.04, 0.16), np.radians(random.uniform(0, 22))
    angles = np.linspace(0, np.pi / 2 - lean, 6)
    corner = np.stack([low + bend * (1 - np.cos(angles)), -deep / 2 + bend * (1 - np.sin(angles))], axis=1)
    rise = max(top - corner[-1, 0], 0.1)
    edges = np.array([[low - random.uniform(0, 0.04), deep / 2], [low, deep / 2 - 0.06]])
    upper = corner[-1] + np.array([[0.5, -0.5 * np.tan(lean)], [1, -np.tan(lean)]]) * rise
    profile = np.concatenate([edges, corner, upper])  # heights and depths, from the front edge to the top
    shares = np.linspace(-1, 1, int(random.choice([2, 7])))
    waist, crown = random.uniform(0.7, 1.0), random.uniform(0.6, 1.05)
    half = wide / 2 * np.interp(np.arange(len(profile)), [0, 4, 7, len(profile) - 1], [1, waist, waist, crown])
    along, up = np.broadcast_arrays(shares, profile[:, :1])
    raised = random.uniform(0, 0.07) * along**2
    of_back = np.linspace(0, 1, len(profile))[:, None] ** 2
    grid = np.stack(
        [along * half[:, None], up + raised * (1 - of_back), profile[:, 1:] + raised * of_back * random.uniform(0, 2)],
        axis=-1,
    )
    return sheet(grid, random.uniform(0.012, 0.035))


def tub(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """A dish with a wall around its rear and sides, which falls towards the front."""
    low, top = heights
    reach = np.radians(random.uniform(80, 150))  # from the rear to either end of the wall
    turns, levels = np.linspace(-reach, reach, 17), np.linspace(0, 1, 5)[:, None]
    arm = random.uniform(0.0, 0.6) * (top - low)
    wall = arm + (top - low - arm) * np.clip(np.cos(turns * np.pi / 2 / reach), 0, 1) ** random.uniform(0.5, 2.5)
    flare, foot = random.uniform(0.0, 0.3), random.uniform(0.6, 0.95)
    out = foot + (1 - foot) * levels**0.5 + flare * levels * wall
    grid = np.stack(
        [wide / 2 * out * np.sin(turns), low + levels * wall, -deep / 2 * out * np.cos(turns) - 0.1 * levels * wall],
        axis=-1,
    )
    around = np.linspace(-np.pi, np.pi, 25)
    rim = foot * np.stack([wide / 2 * np.sin(around), np.zeros(25), -deep / 2 * np.cos(around)], axis=-1)
    dish = np.stack([share * rim + (0, low - 0.05 * (1 - share**2), 0) for share in (0.0, 0.4, 0.75, 1.0)])
    thick = random.uniform(0.012, 0.05)
    return sheet(grid, thick) + sheet(dish, thick * random.uniform(1, 2))
