"""Depths that columns of zones see of vertical walls: the footprint of a column integrated over the visible outline.

In the frame of a sensor (u along the boresight, v to the left) a direction is τ = v / u, and the inverse depth of a
wall is linear in τ: u⁻¹ = q = A + B τ with A u + B v = 1 on the wall. Between neighbouring ends of walls, sorted by τ,
one wall is the nearest, for no two pieces cross. The depth of a column is the mean of u over its footprint, a triangle
in τ, weighted with the light that returns from walls of one albedo, cos θ / r² of the incidence θ and the range r:

    L = q³ / ( (1 + τ²)^(3/2) √(A² + B²) ) .

Its slopes are exact: those of ∫ L u and ∫ L inside an interval, and at an end their jump times the motion of the end.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.locate.kernel_arguments import Outline, RigNumbers

_Float = NDArray[np.float64]

_NEAREST_M = 1e-3
"""A wall is cut off at this depth."""
_NODES = np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0
N_SLOPES = 4
"""Slopes of a depth: by a move of the sensor along u and along v, by its yaw, and by the angle of the column."""


@njit(cache=True, nogil=True, error_model="numpy")
def column_depths(
    poses: _Float, sensor: NDArray[np.int64], outline: Outline, rig: RigNumbers,
    depth_m: _Float, slope: _Float, wall_slope: _Float, spread_m: _Float,
) -> None:  # fmt: skip
    """Compute the depth of each column at poses of sensors, with its slopes.

    Parameters
    ----------
    poses : (n, 3) float64
        x, y (m) and yaw (rad) of a sensor in the frame of the map.
    sensor : (n,) int64
        Which sensor each pose is of.
    outline : Outline
    rig : RigNumbers
        Columns of the sensors, column 0 the leftmost, and their footprints.
    depth_m : (n, C) float64
        Result: mean distance along the boresight, weighted with light; NaN where no wall is seen, and of columns a
        sensor does not have.
    slope : (n, C, 4) float64
        Result, in the order of :data:`N_SLOPES`.
    wall_slope : (n, C, w) float64
        Result: by the displacement of each wall; of no pose (0, C, w): not computed.
    spread_m : (n, C) float64
        Result: standard deviation of the depth within the footprint.
    """
    pieces, wall, normal, with_walls = outline.pieces, outline.wall, outline.normal, len(wall_slope) > 0
    m, most = len(pieces), depth_m.shape[1]
    low, high = np.empty(m), np.empty(m)
    a, b, owner = np.empty(m), np.empty(m), np.empty(m, np.int64)
    end, end_owner = np.empty((2 * m + 2, 3)), np.empty(2 * m + 2, np.int64)
    centre, width = np.empty(most), np.empty(most)
    total = np.empty((most, 4))  # integrals of L, L u, L u², L u τ
    depth_slope, light_slope, hits = np.empty((most, 3)), np.empty((most, 3)), np.empty(most)
    light_of_walls = np.empty((most, len(normal) if with_walls else 0))
    for k in range(len(poses)):
        s = sensor[k]
        first, last = np.inf, -np.inf
        n, step_rad, footprint = rig.columns[s], rig.step_rad[s], rig.footprint[s]
        for c in range(n):
            centre[c] = np.tan((0.5 * (n - 1) - c) * step_rad)
            width[c] = 0.5 * footprint * abs(step_rad) * (1 + centre[c] ** 2)
            first, last = min(first, centre[c] - width[c]), max(last, centre[c] + width[c])
        x, y, cos, sin = poses[k, 0], poses[k, 1], np.cos(poses[k, 2]), np.sin(poses[k, 2])
        seen, ends = 0, 2
        end[0], end[1] = first, last
        for j in range(m):
            ax, ay, bx, by = pieces[j, 0] - x, pieces[j, 1] - y, pieces[j, 2] - x, pieces[j, 3] - y
            ua, va, ub, vb = cos * ax + sin * ay, cos * ay - sin * ax, cos * bx + sin * by, cos * by - sin * bx
            if ua < _NEAREST_M and ub < _NEAREST_M:
                continue
            cross = ua * vb - va * ub
            if abs(cross) < 1e-12:
                continue
            real_a, real_b = ua >= _NEAREST_M, ub >= _NEAREST_M
            ta = va / ua if real_a else (va + (vb - va) * (_NEAREST_M - ua) / (ub - ua)) / _NEAREST_M
            tb = vb / ub if real_b else (va + (vb - va) * (_NEAREST_M - ua) / (ub - ua)) / _NEAREST_M
            if max(ta, tb) <= first or min(ta, tb) >= last:
                continue
            low[seen], high[seen] = min(ta, tb), max(ta, tb)
            a[seen], b[seen] = (vb - va) / cross, (ua - ub) / cross
            owner[seen] = wall[j]
            seen += 1
            if real_a and first < ta < last:
                end[ends, 0], end[ends, 1], end[ends, 2] = ta, ua, va
                end_owner[ends] = wall[j]
                ends += 1
            if real_b and first < tb < last:
                end[ends, 0], end[ends, 1], end[ends, 2] = tb, ub, vb
                end_owner[ends] = wall[j]
                ends += 1
        order = np.argsort(end[:ends, 0])
        total[:] = 0.0
        depth_slope[:] = 0.0
        light_slope[:] = 0.0
        hits[:] = 0.0
        light_of_walls[:] = 0.0
        depth_m[k] = np.nan
        slope[k] = 0.0
        spread_m[k] = 0.0
        if with_walls:
            wall_slope[k] = 0.0
        before = -1
        for i in range(ends - 1):
            here, there = end[order[i], 0], end[order[i + 1], 0]
            if there - here < 1e-12 and i + 1 < ends - 1:
                nearest = before
            else:
                middle, nearest, best = 0.5 * (here + there), -1, 0.0
                for j in range(seen):
                    if low[j] <= middle <= high[j]:
                        inverse = a[j] + b[j] * middle
                        if inverse > best:
                            nearest, best = j, inverse
            if i and nearest != before:
                left, right, light_left, light_right = 0.0, 0.0, 0.0, 0.0
                if before >= 0:
                    light_left, left = _light(a[before], b[before], here)
                if nearest >= 0:
                    light_right, right = _light(a[nearest], b[nearest], here)
                ue, ve = end[order[i], 1], end[order[i], 2]
                motion = (ve / ue**2, -1 / ue, -(1 + here**2))
                e = end_owner[order[i]]
                nu, nv = cos * normal[e, 0] + sin * normal[e, 1], cos * normal[e, 1] - sin * normal[e, 0]
                wall_motion = (nv * ue - ve * nu) / ue**2
                jump, gained = light_left * left - light_right * right, light_left - light_right
                for c in range(n):
                    weight = (1 - abs(here - centre[c]) / width[c]) / width[c]
                    if weight > 0:
                        for p in range(3):
                            depth_slope[c, p] += weight * jump * motion[p]
                            light_slope[c, p] += weight * gained * motion[p]
                        if with_walls:
                            wall_slope[k, c, e] += weight * jump * wall_motion
                            light_of_walls[c, e] += weight * gained * wall_motion
            before = nearest
            if nearest < 0:
                continue
            an, bn, e = a[nearest], b[nearest], owner[nearest]
            nu, nv = cos * normal[e, 0] + sin * normal[e, 1], cos * normal[e, 1] - sin * normal[e, 0]
            away = an * nu + bn * nv
            for c in range(n):
                for side in range(2):
                    lo = max(here, centre[c] - width[c] if side == 0 else centre[c])
                    hi = min(there, centre[c] if side == 0 else centre[c] + width[c])
                    if hi <= lo:
                        continue
                    for g in range(3):
                        tau = 0.5 * (lo + hi) + 0.5 * (hi - lo) * _NODES[g]
                        weight = _WEIGHTS[g] * (hi - lo) * (1 - abs(tau - centre[c]) / width[c]) / width[c]
                        hits[c] += weight
                        light, z = _light(an, bn, tau)
                        light *= weight
                        total[c, 0] += light
                        total[c, 1] += light * z
                        total[c, 2] += light * z * z
                        total[c, 3] += light * z * tau
                        # a move along u or v multiplies q and √(A² + B²) by 1 + A or 1 + B, a turn adds B − A τ to q
                        turn = z * (bn - an * tau)
                        depth_slope[c, 0] += light * z * an
                        depth_slope[c, 1] += light * z * bn
                        depth_slope[c, 2] += 2 * light * z * turn
                        light_slope[c, 0] += 2 * light * an
                        light_slope[c, 1] += 2 * light * bn
                        light_slope[c, 2] += 3 * light * turn
                        if with_walls:
                            wall_slope[k, c, e] -= light * z * away
                            light_of_walls[c, e] -= 2 * light * away
        for c in range(n):
            if hits[c] < 1e-6:
                continue
            light = total[c, 0]
            z = total[c, 1] / light
            depth_m[k, c] = z
            spread_m[k, c] = np.sqrt(max(0.0, total[c, 2] / light - z * z))
            for p in range(3):
                slope[k, c, p] = (depth_slope[c, p] - z * light_slope[c, p]) / light
            slope[k, c, 3] = slope[k, c, 2] - total[c, 3] / light
            if with_walls:
                for e in range(len(normal)):
                    wall_slope[k, c, e] = (wall_slope[k, c, e] - z * light_of_walls[c, e]) / light


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _light(a, b, tau):  # type: ignore[no-untyped-def]
    """Return the light from a wall at a direction, and the depth there."""
    q = a + b * tau
    return q**3 / ((1 + tau * tau) ** 1.5 * np.sqrt(a * a + b * b)), 1 / q
