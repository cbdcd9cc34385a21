"""One stop of a robot: the depths that its columns should show, their slopes, and the sums of a Gauss–Newton step.

While a stop is scanned the odometry says how the body has moved since the first frame. A sensor's data are older than
the odometry by its delay. The unknowns of a stop are

    θ = (x, y, yaw; drift of the odometry along the body's x and y, m/s; age of all data, s;
         an offset of the range of each sensor, m; an offset of the yaw of each sensor, rad;
         and where zones are seen in space: height above that of the map, m, pitch and roll, rad).

An observed column is one of the model with probability 1 − ε and normal, or uniform over the range:

    cost = −2 log( exp(−r² / 2) + κ ) + 2 log(1 + κ),   κ = ε σ √(2π) / ((1 − ε) R),   r = residual / σ .
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.locate.kernel_arguments import Outline, Prediction, RigNumbers, Scan
from phasemark.matcher.locate.wall_depths import N_SLOPES, column_depths

_Float = NDArray[np.float64]

POSE, DRIFT_X, DRIFT_Y, AGE, SENSOR_YAW, SENSOR_X, SENSOR_Y, SCALE, STEP = 0, 3, 4, 5, 6, 7, 8, 9, 10
"""Columns of the slopes of :func:`predict`: of a stop, then of a rig. That of a delay is that of the age."""
N_ROWS = 11
N_BODY = 6
"""Unknowns of a stop before those of its sensors."""
N_TILT = 3
"""Unknowns of a stop after those of its sensors, in space; their slopes follow the others."""


def empty_prediction(scan: Scan, walls: int = 0) -> Prediction:
    """Return arrays for :func:`predict`; without `walls` there are no slopes by their displacements."""
    shape = scan.depth_m.shape
    of_walls = np.empty((*(shape if walls else (0, *shape[1:])), walls))
    return Prediction(np.empty(shape), np.empty((*shape, N_ROWS)), np.empty(shape), of_walls)


@njit(cache=True, nogil=True, error_model="numpy")
def predict(theta: _Float, scan: Scan, rig: RigNumbers, outline: Outline, out: Prediction) -> None:
    """Compute the depths that a stop should show, with slopes.

    Parameters
    ----------
    theta : (6 + 2 S,) float64
        The unknowns of the stop.
    scan : Scan
    rig : RigNumbers
    outline : Outline
    out : Prediction
        Result.
    """
    frames, sensors, columns = scan.depth_m.shape
    n = frames * sensors
    poses, of, rate, lever = np.empty((n, 3)), np.empty(n, np.int64), np.empty((n, 3)), np.empty((n, 2))
    cos, sin = np.cos(theta[2]), np.sin(theta[2])
    times, track = scan.odometry_time_s, scan.odometry
    for f in range(frames):
        drift_x, drift_y = theta[3] * scan.time_s[f], theta[4] * scan.time_s[f]
        for s in range(sensors):
            k = f * sensors + s
            when = scan.time_s[f] - rig.delay_s[s] - theta[5]
            at = min(max(np.searchsorted(times, when) - 1, 0), max(len(times) - 2, 0))
            moved_x, moved_y, turned = track[at, 0], track[at, 1], track[at, 2]
            rate[k] = 0.0
            if len(times) > 1 and when > times[0]:  # before the first frame the robot stands
                span = times[at + 1] - times[at]
                for p in range(3):
                    rate[k, p] = (track[at + 1, p] - track[at, p]) / span
                since = when - times[at]
                moved_x += rate[k, 0] * since
                moved_y += rate[k, 1] * since
                turned += rate[k, 2] * since
            moved_x += drift_x
            moved_y += drift_y
            body = theta[2] + turned
            cos_b, sin_b = np.cos(body), np.sin(body)
            lever[k, 0] = cos_b * rig.x_m[s] - sin_b * rig.y_m[s]
            lever[k, 1] = sin_b * rig.x_m[s] + cos_b * rig.y_m[s]
            poses[k, 0] = theta[0] + cos * moved_x - sin * moved_y + lever[k, 0]
            poses[k, 1] = theta[1] + sin * moved_x + cos * moved_y + lever[k, 1]
            poses[k, 2] = body + rig.yaw_rad[s] + theta[N_BODY + sensors + s]
            of[k] = s
    depth, spread = out.depth_m.reshape(n, columns), out.spread_m.reshape(n, columns)
    slope = np.empty((n, columns, N_SLOPES))
    of_walls = out.wall_slope.reshape(out.wall_slope.shape[0] * sensors, columns, out.wall_slope.shape[3])
    column_depths(poses, of, outline, rig, depth, slope, of_walls, spread)
    for k in range(n):
        f, s = k // sensors, k % sensors
        cos_s, sin_s = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        turn = poses[k, 2] - rig.yaw_rad[s] - theta[N_BODY + sensors + s]
        cos_b, sin_b = np.cos(turn), np.sin(turn)
        from_x, from_y = poses[k, 0] - theta[0], poses[k, 1] - theta[1]
        speed_x, speed_y = cos * rate[k, 0] - sin * rate[k, 1], sin * rate[k, 0] + cos * rate[k, 1]
        scale = rig.scale[s]
        for c in range(columns):
            by_x = scale * (slope[k, c, 0] * cos_s - slope[k, c, 1] * sin_s)
            by_y = scale * (slope[k, c, 0] * sin_s + slope[k, c, 1] * cos_s)
            by_yaw = scale * slope[k, c, 2]
            row = out.slope[f, s, c]
            row[0], row[1], row[2] = by_x, by_y, by_yaw - from_y * by_x + from_x * by_y
            row[DRIFT_X] = scan.time_s[f] * (cos * by_x + sin * by_y)
            row[DRIFT_Y] = scan.time_s[f] * (cos * by_y - sin * by_x)
            turning = by_yaw - lever[k, 1] * by_x + lever[k, 0] * by_y
            row[AGE] = -(speed_x * by_x + speed_y * by_y + rate[k, 2] * turning)
            row[SENSOR_YAW] = by_yaw
            row[SENSOR_X] = cos_b * by_x + sin_b * by_y
            row[SENSOR_Y] = cos_b * by_y - sin_b * by_x
            row[SCALE] = depth[k, c]
            row[STEP] = scale * slope[k, c, 3] * (0.5 * (rig.columns[s] - 1) - c)
            depth[k, c] = scale * depth[k, c] + rig.offset_m[s] + theta[N_BODY + s]


@njit(cache=True, nogil=True, error_model="numpy")
def sums(
    scan: Scan, seen: Prediction, sigma_m: _Float, outlier_density: float, information: _Float, gradient: _Float
) -> tuple[float, int]:
    """Add up the normal equations of a stop's unknowns, and return the cost and the number of explained columns.

    Parameters
    ----------
    scan : Scan
    seen : Prediction
    sigma_m : (F, S, C) float64
    outlier_density : float
        ε / ((1 − ε) R), per metre.
    information : (p, p) float64
        Result, without priors, of 6 + 2 S unknowns, or 9 + 2 S in space.
    gradient : (p,) float64
        Result.

    Returns
    -------
    cost : float
    explained : int
        Columns that are more probably explained than not.
    """
    frames, sensors, columns = scan.depth_m.shape
    information[:] = 0.0
    gradient[:] = 0.0
    tilts = len(gradient) - N_BODY - 2 * sensors
    row, place = np.empty(N_BODY + 2 + tilts), np.arange(N_BODY + 2 + tilts)
    place[N_BODY + 2 :] += 2 * sensors - 2
    cost, explained = 0.0, 0
    for f in range(frames):
        for s in range(sensors):
            place[N_BODY], place[N_BODY + 1] = N_BODY + s, N_BODY + sensors + s
            for c in range(columns):
                measured = scan.depth_m[f, s, c]
                if np.isnan(measured):
                    continue
                sigma = sigma_m[f, s, c]
                kappa = outlier_density * sigma * np.sqrt(2 * np.pi)
                modelled = seen.depth_m[f, s, c]
                r = np.inf if np.isnan(modelled) else (measured - modelled) / sigma
                likely = np.exp(-0.5 * min(r * r, 1400.0)) if r < np.inf else 0.0
                cost -= 2 * np.log((likely + kappa) / (1 + kappa))
                weight = likely / (likely + kappa)
                if weight > 0.5:
                    explained += 1
                if weight < 1e-9:
                    continue
                for p in range(N_BODY):
                    row[p] = seen.slope[f, s, c, p] / sigma
                row[N_BODY], row[N_BODY + 1] = 1 / sigma, seen.slope[f, s, c, SENSOR_YAW] / sigma
                for p in range(tilts):
                    row[N_BODY + 2 + p] = seen.slope[f, s, c, N_ROWS + p] / sigma
                for p in range(len(row)):
                    gradient[place[p]] += weight * r * row[p]
                    for q in range(p + 1):
                        information[place[p], place[q]] += weight * row[p] * row[q]
    for p in range(len(gradient)):
        for q in range(p):
            total = information[p, q] + information[q, p]
            information[p, q] = total
            information[q, p] = total
    return cost, explained
