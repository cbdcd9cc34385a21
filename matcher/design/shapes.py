"""The shapes that are tried: boxes and parts above them, spread evenly over what the rules leave."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from phasemark.landmarks.spec import Box, Cone, Cylinder, Revolution, Sphere, Upper
from phasemark.matcher.design.plan import DesignPlan
from phasemark.matcher.design.rules import AllowedDimensions

_THINNEST_SHARE = 0.25
"""Of the widest radius: a waist or foot is not thinner, or the part breaks off."""


class Lattice:
    """Multiples of a step, in metres; floats are what the decimal numbers are.

    Parameters
    ----------
    step_mm : float
    """

    def __init__(self, step_mm: float) -> None:
        self.step_mm = step_mm

    def floor(self, value_m: float) -> int:
        """Return how many whole steps a length has."""
        return math.floor(value_m * 1000 / self.step_mm + 1e-9)

    def ceil(self, value_m: float) -> int:
        """Return how many steps reach a length."""
        return math.ceil(value_m * 1000 / self.step_mm - 1e-9)

    def metres(self, steps: int) -> float:
        """Return a number of steps in metres."""
        return round(steps * self.step_mm / 1000, 9)


def box_of(lattice: Lattice, steps: tuple[int, int, int]) -> Box:
    """Return a box from its length, width and height in steps."""
    length, width, height = map(lattice.metres, steps)
    return Box(length_m=length, width_m=width, height_m=height)


def sample_boxes(plan: DesignPlan, allowed: AllowedDimensions, lattice: Lattice) -> list[tuple[int, int, int]]:
    """Return boxes in steps: squares, rectangles, or half of each; no box twice."""
    least, most = allowed.side_m
    boxes: dict[tuple[int, int, int], None] = {}
    square, oblong = plan.symmetry != 2, plan.symmetry != 4
    share = plan.search.boxes // (square + oblong)
    if square:
        for a, b in _spread(2, share, plan.seed):
            side = _between(lattice, least, most, a)
            boxes[(side, side, _height(allowed, lattice, side, side, b))] = None
    if oblong:
        for a, b, c in _spread(3, share, plan.seed + 1):
            width = _between(lattice, least, min(most, plan.limits.extents_m[1]), a)
            length = _between(lattice, lattice.metres(width + 1), allowed.longest_m(lattice.metres(width)), b)
            boxes[(length, width, _height(allowed, lattice, length, width, c))] = None
    return list(boxes)


def _height(allowed: AllowedDimensions, lattice: Lattice, length: int, width: int, share: float) -> int:
    most = allowed.deepest_m(lattice.metres(length), lattice.metres(width))
    return _between(lattice, allowed.box_height_m[0], most, share)


def sample_uppers(plan: DesignPlan, allowed: AllowedDimensions, lattice: Lattice) -> list[Upper]:
    """Return parts that may stand on the box: cylinders, cones, spheres and profiles of three radii; none twice."""
    least_r, most_r = allowed.upper_radius_m
    least_h, most_h = allowed.upper_height_m
    uppers: dict[Upper, None] = {}
    for kind, width, tall, *shares in _spread(6, plan.search.uppers, plan.seed + 2):
        radius = lattice.metres(_between(lattice, least_r, most_r, width))
        half = lattice.metres(_between(lattice, least_h / 2, most_h / 2, tall))
        if kind < 0.2:
            uppers[Cylinder(radius_m=radius, height_m=2 * half)] = None
        elif kind < 0.3:
            uppers[Cone(radius_m=radius, height_m=2 * half)] = None
        elif kind < 0.4:
            uppers[Sphere(radius_m=min(radius, half))] = None
        else:
            radii = [lattice.metres(_between(lattice, lattice.metres(1), most_r, share)) for share in shares]
            thinnest = lattice.metres(lattice.ceil(_THINNEST_SHARE * max(radii)))
            uppers[profile_of([max(r, thinnest) for r in radii], half)] = None
    return list(uppers)


def profile_of(radii_m: list[float], spacing_m: float) -> Revolution:
    """Return a solid of revolution through radii at even heights."""
    return Revolution(profile_m=tuple((r, round(k * spacing_m, 9)) for k, r in enumerate(radii_m)))


def neighbours(upper: Upper, steps: int, lattice: Lattice) -> Iterator[Upper]:
    """Yield the shapes one move away: each dimension larger or smaller by a number of steps."""
    move = lattice.metres(steps)
    for sign in (move, -move):
        if isinstance(upper, Revolution):
            radii = [r for r, _ in upper.profile_m]
            spacing = upper.profile_m[1][1]
            for k in range(len(radii)):
                changed = [round(r + sign * (i == k), 9) for i, r in enumerate(radii)]
                if min(changed) >= max(_THINNEST_SHARE * max(changed), move / steps):
                    yield profile_of(changed, spacing)
            if spacing + sign > 0:
                yield profile_of(radii, round(spacing + sign, 9))
            continue
        fields = upper.model_dump(exclude={"kind"})
        for name, value in fields.items():
            if value + sign > 0:
                yield type(upper)(**{**fields, name: round(value + sign, 9)})


def _spread(dimensions: int, n: int, seed: int) -> NDArray[np.float64]:
    """Return points that fill a unit cube evenly, (n, dimensions)."""
    from scipy.stats import qmc  # slow to import

    return np.asarray(qmc.Halton(dimensions, rng=np.random.default_rng(seed)).random(n))


def _between(lattice: Lattice, least_m: float, most_m: float, share: float) -> int:
    """Return the lattice point a share of the way from the least length to the greatest."""
    low, high = lattice.ceil(least_m), lattice.floor(most_m)
    return low + round(share * max(high - low, 0))
