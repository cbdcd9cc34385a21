"""Arrays that the compiled functions of this package take: walls, sensors, and the frames of a stop."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_Float = NDArray[np.float64]


class Outline(NamedTuple):
    """Vertical faces that sensors of one height can see, cut where they cross."""

    pieces: _Float
    """(m, 4): ends x, y, x, y, metres."""
    wall: NDArray[np.int64]
    """(m,): which wall or body each piece belongs to."""
    normal: _Float
    """(w, 2): direction in which each wall may be displaced; 0 of bodies."""
    std_m: _Float
    """(w,): standard deviation of that displacement."""

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Least x and y, greatest x and y."""
        x, y = self.pieces[:, ::2], self.pieces[:, 1::2]
        return float(x.min()), float(y.min()), float(x.max()), float(y.max())


class RigNumbers(NamedTuple):
    """Numbers of the sensors of a rig, (S,) float64 each, in the order of the recording's sensors."""

    yaw_rad: _Float
    x_m: _Float
    y_m: _Float
    delay_s: _Float
    offset_m: _Float
    scale: _Float
    step_rad: _Float
    """Angle between neighbouring columns."""
    columns: NDArray[np.int64]
    footprint: _Float
    """Base of the triangle that a column sees, in columns."""


class Scan(NamedTuple):
    """Frames of one stop: C columns of each sensor, or its zones row by row."""

    time_s: _Float
    """(F,): since the first frame of the stop."""
    depth_m: _Float
    """(F, S, C): along the boresight; NaN where there is none."""
    odometry_time_s: _Float
    """(T,), rising."""
    odometry: _Float
    """(T, 3): x, y (m) and yaw (rad) in the body's frame of the first frame."""


class Prediction(NamedTuple):
    """Columns of a scan as a model has them."""

    depth_m: _Float
    """(F, S, C): NaN where no wall is seen."""
    slope: _Float
    """(F, S, C, 11), or 14 in space."""
    spread_m: _Float
    """(F, S, C): of the depth within the footprint."""
    wall_slope: _Float
    """(F, S, C, walls), or empty."""
