"""Feet: one column under a seat or a top."""

from itertools import pairwise

import numpy as np

from experiments.procedural.parts import Part, Point, block, disc, rod


def foot(random: np.random.Generator, radius: float, high: float) -> list[Part]:
    """Returns a column, sometimes in a sleeve, on a disc or on a star with or without castors."""
    thin = random.uniform(0.012, 0.03)
    column = [rod((0, 0.04, 0), (0, high, 0), thin * random.uniform(1, 1.4), thin)]
    if random.random() < 0.35:
        return [*column, disc((0, 0, 0), radius, random.uniform(0.012, 0.04)), *skirt(random, radius, thin)]
    if random.random() < 0.4:
        column.append(rod((0, 0.04, 0), (0, high * random.uniform(0.4, 0.75), 0), thin + 0.008, thin + 0.006))
    if random.random() < 0.4:
        half = random.uniform(0.06, 0.13)
        column.append(block((-half, high - 0.03, -half), (half, high, half), 0.005))
    return column + star(random, radius)


def skirt(random: np.random.Generator, radius: float, thin: float) -> list[Part]:
    """Returns the widening from the column to the disc, in ever smaller steps."""
    wide = random.uniform(0.3, 0.9) * radius
    tall = random.uniform(0.03, 0.14)
    heights = np.linspace(0, 1, 5)
    steepness = random.uniform(1, 3)
    radii = thin + (wide - thin) * (1 - heights) ** steepness
    rings = [((0, 0.01 + tall * h, 0), r) for h, r in zip(heights, radii)]
    return [rod(low, up, r, s, 24) for (low, r), (up, s) in pairwise(rings)]


def star(random: np.random.Generator, radius: float) -> list[Part]:
    """Returns four or five equal arms, straight or bent downwards, on equal feet."""
    arms = int(random.choice([4, 5], p=[0.35, 0.65]))
    wheels = random.random() < 0.6
    low = random.uniform(0.055, 0.085) if wheels else random.uniform(0.012, 0.025)
    hub = low + random.uniform(0.0, 0.07)
    bend = random.choice([1.0, random.uniform(0.6, 0.9)])
    thick = random.uniform(0.014, 0.03)
    slim = thick * random.uniform(0.5, 1.0)
    wheel = Wheel(random, low)
    parts = [rod((0, hub - 0.03, 0), (0, hub + 0.04, 0), 0.03, 0.028)]
    for angle in np.arange(arms) * 2 * np.pi / arms + random.uniform(0, 2 * np.pi):
        x = radius * np.sin(angle)
        z = radius * np.cos(angle)
        knees = [((bend * x, hub - (hub - low) * 0.3, bend * z), slim)] if bend < 1 else []
        joints = [((0.0, hub, 0.0), thick), *knees, ((x, low, z), slim)]
        parts += [rod(begin, end, first, last) for (begin, first), (end, last) in pairwise(joints)]
        parts += wheel.at((x, low, z), random.uniform(0, 2 * np.pi)) if wheels else []
    return parts


class Wheel:
    """Returns a castor: a stem, and one or two wheels."""

    def __init__(self, random: np.random.Generator, high: float) -> None:
        self.radius = min(random.uniform(0.02, 0.032), 0.48 * high)
        self.wide = random.uniform(0.012, 0.03)
        self.double = random.random() < 0.6
        self.trail = random.uniform(0.0, 0.02)

    def at(self, place: Point, angle: float) -> list[Part]:
        across, along = (np.array([np.cos(turn), 0, np.sin(turn)]) for turn in (angle, angle + np.pi / 2))
        middle = np.array([place[0], self.radius, place[2]]) + self.trail * along
        spans = [(-1.0, -0.25), (0.25, 1.0)] if self.double else [(-0.6, 0.6)]
        tyres = [
            rod(middle + a * self.wide * across, middle + b * self.wide * across, self.radius, self.radius, 16)
            for a, b in spans
        ]
        return [rod(place, middle, 0.008, 0.008), *tyres]
