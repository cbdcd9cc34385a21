"""Poses (x, y, yaw) of the plane: one in the frame of another, steps, and differences with the yaw wrapped."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_Float = NDArray[np.float64]


def turn_of(yaw_rad: float) -> _Float:
    """Return the matrix that turns a step (x, y, yaw) of a body into the frame in which the body has a yaw, (3, 3)."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def difference(one: _Float, other: _Float) -> _Float:
    """Return one pose less another, the yaw in [−π, π], (3,)."""
    off = one - other
    off[2] = math.remainder(off[2], math.tau)
    return off


def stepped(pose: _Float, step: _Float) -> _Float:
    """Return a pose after a step in its own frame, (3,)."""
    return np.asarray(pose + turn_of(pose[2]) @ step)


def relative_pose(before: _Float, after: _Float) -> _Float:
    """Return a pose in the frame of another one, (3,): the step between them."""
    return np.asarray(turn_of(before[2]).T @ difference(after, before))
