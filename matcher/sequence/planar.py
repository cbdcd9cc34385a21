"""Geometry of the plane: where the lens of a robot is, and how a landmark is seen from it (PHYSICS section 8)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray


def lens_pose(
    pose: Sequence[float] | NDArray[np.float64], pan_rad: float, pan_offset_m: ArrayLike, lens_offset_m: ArrayLike
) -> NDArray[np.float64]:
    """Return the lens and the heading of its optical axis, (x, y, heading): PHYSICS section 8 the other way round.

    Parameters
    ----------
    pose : (x, y, heading)
        Of the robot.
    pan_rad : float
        β.
    pan_offset_m, lens_offset_m : (2,) array_like
    """
    heading = pose[2] + pan_rad
    pan_axis = np.asarray(pose[:2]) + rotation(pose[2]) @ np.asarray(pan_offset_m)
    lens = pan_axis + rotation(heading) @ np.asarray(lens_offset_m)
    return np.array([*lens, math.remainder(heading, math.tau)])


def view_of(
    lens: Sequence[float] | NDArray[np.float64], landmark_xy_m: ArrayLike, landmark_yaw_rad: float
) -> tuple[float, float, float]:
    """Return (D, δ, b) of a landmark seen from a lens, PHYSICS sections 1 and 8.

    Parameters
    ----------
    lens : (x, y, heading of the optical axis)
    landmark_xy_m : (2,) array_like
    landmark_yaw_rad : float
    """
    to = np.asarray(landmark_xy_m) - np.asarray(lens[:2])
    line_of_sight = math.atan2(to[1], to[0])
    return (
        float(np.hypot(*to)),
        math.remainder(line_of_sight - landmark_yaw_rad, math.tau),
        math.remainder(line_of_sight - lens[2], math.tau),
    )


def rotation(angle_rad: float) -> NDArray[np.float64]:
    """Return the matrix that turns vectors of the plane, (2, 2)."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])
