"""Seat shells: thin and curved, with seat, back and sometimes arms in one piece."""

import numpy as np
from jaxtyping import Float

from experiments.procedural.parts import Part, sheet


def shell(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """Returns a bent board or a tub, from the seat's height to the back's top."""
    return (tub if random.random() < 0.45 else bent)(random, wide, deep, heights)


def bent(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """Returns a board curved from seat to back, with its sides raised and moved forwards."""
    profile = _profile(random, deep, heights)
    along = np.linspace(-1, 1, int(random.choice([2, 7])))
    waist = random.uniform(0.7, 1.0)
    crown = random.uniform(0.6, 1.05)
    last = len(profile) - 1
    half = wide / 2 * np.interp(np.arange(last + 1), [0, 4, 7, last], [1, waist, waist, crown])
    raised = random.uniform(0, 0.07) * along**2
    of_back = np.linspace(0, 1, last + 1)[:, None] ** 2
    up = raised * (1 - of_back)
    forwards = raised * of_back * random.uniform(0, 2)
    grid = np.stack([along * half[:, None], profile[:, :1] + up, profile[:, 1:] + forwards], axis=-1)
    return sheet(grid, random.uniform(0.012, 0.035))


def _profile(random: np.random.Generator, deep: float, heights: tuple[float, float]) -> Float[np.ndarray, "points 2"]:
    """Returns heights and depths, from the seat's front edge through the bend to the top of the leaning back."""
    low, top = heights
    bend = random.uniform(0.04, 0.16)
    lean = np.radians(random.uniform(0, 22))
    angles = np.linspace(0, np.pi / 2 - lean, 6)
    corner = np.stack([low + bend * (1 - np.cos(angles)), -deep / 2 + bend * (1 - np.sin(angles))], axis=1)
    edges = np.array([[low - random.uniform(0, 0.04), deep / 2], [low, deep / 2 - 0.06]])
    upper = np.array([[0.5, -0.5 * np.tan(lean)], [1, -np.tan(lean)]]) * max(top - corner[-1, 0], 0.1)
    return np.concatenate([edges, corner, corner[-1] + upper])


def tub(random: np.random.Generator, wide: float, deep: float, heights: tuple[float, float]) -> list[Part]:
    """Returns a dish with a wall around its rear and sides that falls towards the front."""
    low, top = heights
    reach = np.radians(random.uniform(80, 150))  # from the rear to either end of the wall
    turns = np.linspace(-reach, reach, 17)
    levels = np.linspace(0, 1, 5)[:, None]
    arm = random.uniform(0.0, 0.6) * (top - low)
    wall = arm + (top - low - arm) * np.clip(np.cos(turns * np.pi / 2 / reach), 0, 1) ** random.uniform(0.5, 2.5)
    flare = random.uniform(0.0, 0.3)
    foot = random.uniform(0.6, 0.95)
    up = levels * wall
    out = foot + (1 - foot) * levels**0.5 + flare * up
    sides = [wide / 2 * out * np.sin(turns), low + up, -deep / 2 * out * np.cos(turns) - 0.1 * up]
    thick = random.uniform(0.012, 0.05)
    dish = _dish(foot * wide / 2, foot * deep / 2, low, thick * random.uniform(1, 2))
    return sheet(np.stack(sides, axis=-1), thick) + dish


def _dish(wide: float, deep: float, low: float, thick: float) -> list[Part]:
    """Returns a dish with half-axes `wide` and `deep`; its middle is lower than its rim."""
    around = np.linspace(-np.pi, np.pi, 25)
    rim = np.stack([wide * np.sin(around), np.zeros(25), -deep * np.cos(around)], axis=-1)
    return sheet(np.stack([share * rim + (0, low - 0.05 * (1 - share**2), 0) for share in (0, 0.4, 0.75, 1)]), thick)
