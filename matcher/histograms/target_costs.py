"""Compiled comparisons of targets with expected ones: at a view with slopes, and at the nodes of a table."""

from __future__ import annotations

import math

from phasemark.render.kernel import kernel


@kernel
def nearest_targets(distance, scatter, zone, reported, std, steps, residual, spread, slope, hits):  # type: ignore[no-untyped-def]
    """Fill how far each target is from the nearest one expected in its zone, and how that moves with the view.

    `hits` counts how often each expected target is the nearest one.
    """
    for k in range(len(zone)):
        here, which = math.nan, -1
        for t in range(distance.shape[2]):
            d = distance[0, zone[k], t]
            if not math.isnan(d) and not abs(reported[k] - d) >= abs(reported[k] - here):
                here, which = d, t
        if which < 0:
            continue
        residual[k], spread[k] = reported[k] - here, scatter[0, zone[k], which]
        hits[zone[k], which] += 1
        for a in range(len(steps)):
            above, below = math.nan, math.nan
            for t in range(distance.shape[2]):
                d = distance[1 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(above - here):
                    above = d
                d = distance[2 + 2 * a, zone[k], t]
                if not math.isnan(d) and not abs(d - here) >= abs(below - here):
                    below = d
            if not math.isnan(above) and not math.isnan(below):
                rise, fall = above - here, here - below
                if abs(rise - fall) < std[k]:
                    slope[k, a] = (rise + fall) / (2 * steps[a])
                elif rise * fall > 0:  # the estimate jumps: no more is known than what moves to either side
                    slope[k, a] = (rise if abs(rise) < abs(fall) else fall) / steps[a]


@kernel
def node_costs(  # type: ignore[no-untyped-def]
    distance, sure, zone, reported, weight, n_frames, step, still, nearest, moves, hits, cost, shift,
):  # fmt: skip
    """Fill what the targets of every node cost once they are moved along the distance by at most half a step."""
    n_classes, n_distance, n_delta, n_zones, most = distance.shape
    for c in range(n_classes):
        for i in range(n_distance):
            for j in range(n_delta):
                total, mean = 1e-30, 0.0
                for z in range(n_zones):
                    for t in range(most):
                        hits[z, t] = 0.0
                for k in range(len(zone)):
                    nearest[k], which = math.nan, -1
                    for t in range(most):
                        d = reported[k] - distance[c, i, j, zone[k], t]
                        if not math.isnan(d) and not abs(d) >= abs(nearest[k]):
                            nearest[k], which = d, t
                    moves[k] = 1.0
                    if which >= 0:
                        hits[zone[k], which] += 1
                        for t in range(still.shape[1]):
                            if abs(distance[c, i, j, zone[k], which] - still[zone[k], t]) < 0.5 * step:
                                moves[k] = 0.0
                    if moves[k] > 0.0 and abs(nearest[k]) < 2 * step:
                        total += weight[k]
                        mean += weight[k] * nearest[k]
                mean = min(max(mean / total, -step), step)
                shift[c, i, j] = mean
                sum_of = 0.0
                for k in range(len(zone)):
                    d = nearest[k] - moves[k] * mean
                    squared = d * d * weight[k]
                    sum_of += squared if squared < 25.0 else 25.0
                for z in range(n_zones):
                    for t in range(most):
                        if sure[c, i, j, z, t]:
                            sum_of += 25.0 * max(n_frames - hits[z, t], 0.0)
                cost[c, i, j] = sum_of
