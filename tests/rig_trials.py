"""Rooms, rigs and poses for trials of a robot among walls."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.locate import Rig, WallMap

RING = 0.03
"""Distance of the sensors of :func:`ring_rig` from the robot's centre, metres."""


def room(**more: Any) -> WallMap:
    """Return a room with a niche, in which no two poses look alike."""
    walls = [[0, 0, 3.2, 0], [3.2, 0, 3.2, 2.8], [3.2, 2.8, 1.2, 2.8], [1.2, 2.8, 1.2, 3.3], [1.2, 3.3, 0, 3.3],
             [0, 3.3, 0, 0]]  # fmt: skip
    return WallMap(walls_m=walls, **more)


def ring_rig(sensors: int, **more: Any) -> Rig:
    """Return a rig whose sensors look outward, evenly spaced."""
    turn = [2 * math.pi * k / sensors for k in range(sensors)]
    return Rig(
        sensor=[
            {"name": f"s{k}", "yaw_deg": math.degrees(a), "x_m": RING * math.cos(a), "y_m": RING * math.sin(a)}
            for k, a in enumerate(turn)
        ],
        **more,
    )


def random_room(rng: np.random.Generator) -> WallMap:
    """Return a rectangular room with 3 … 8 walls inside."""
    width, depth = rng.uniform(3, 6, 2)
    walls = [[0, 0, width, 0], [width, 0, width, depth], [width, depth, 0, depth], [0, depth, 0, 0]]
    wanted = 4 + int(rng.integers(3, 9))
    while len(walls) < wanted:
        x, y, angle = rng.uniform(0.3, width - 0.3), rng.uniform(0.3, depth - 0.3), rng.uniform(0, math.tau)
        length = rng.uniform(0.4, 1.5)
        wall = [x, y, x + length * math.cos(angle), y + length * math.sin(angle)]
        if 0.1 < wall[2] < width - 0.1 and 0.1 < wall[3] < depth - 0.1:
            try:
                WallMap(walls_m=[*walls, wall])
            except UsageError:  # it crosses another one
                continue
            walls.append(wall)
    return WallMap(walls_m=walls)


def free_poses(one: WallMap, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return poses with 0.2 m of space around, (n, 3)."""
    pieces = one.outline().pieces
    start, along = pieces[:, :2], pieces[:, 2:] - pieces[:, :2]
    low_x, low_y, high_x, high_y = one.outline().bounds_m
    poses: list[list[float]] = []
    while len(poses) < n:
        place = rng.uniform([low_x, low_y], [high_x, high_y])
        share = np.clip(((place - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        if np.hypot(*(start + share[:, None] * along - place).T).min() > 0.2:
            poses.append([*place.tolist(), rng.uniform(-math.pi, math.pi)])
    return np.array(poses)
