"""The global range offset, with the wiggling beside it where the distances allow it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import optimize

from phasemark.render.bench.fit.boards import BoardData
from phasemark.render.bench.fit.fitted_sensor import FittedField, Floats
from phasemark.render.bench.fit.range_error import circular_mean, range_error_m
from phasemark.render.bench.fit.wiggling import SINE, fit_wiggling, jacobian_of
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.sensor import Sensor

_WIGGLING_ORDERS = ((3, 7), (3,))  # most first; each order is two numbers
_WORST_CONDITION = 20.0  # of the wiggling's design: beyond, the distances cover too little of its period


def fit_offsets(
    data: BoardData, base: Sensor, estimates: dict[str, FittedField], notes: list[str], widening: float
) -> dict[str, Any]:
    """Fit the global offset, and wiggling if the distances allow it, to the mean error of each board."""
    good = data.good
    mean = data.error_m[:, good].mean(axis=1)
    # the same pixels see every board, so their own offsets move all means alike
    temporal = np.sqrt((data.variance_m2 / np.maximum(data.n, 1))[:, good].mean(axis=1) / good.sum()) * widening
    # an error of the distance is one of the mean; its lever on the wiggling's phase is small beside that
    obliquity = (data.truth_m[:, good] / data.distance_m[:, None]).mean(axis=1)
    std = np.maximum(np.hypot(temporal, data.distance_std_m * obliquity), 1e-9)
    m, known, none_seen = len(mean), base.correlation_harmonics, False
    wiggles = [orders for orders in _WIGGLING_ORDERS if m >= 2 + 2 * len(orders)] if base.kind == "phase" else []
    for orders in wiggles:
        design = np.column_stack(
            [np.ones(m)]
            + [part((k + 1) * data.phase_rad).mean(axis=1) for k in orders for part in (np.cos, np.sin)]
        )  # fmt: skip
        if np.linalg.cond(design / np.linalg.norm(design, axis=0)) <= _WORST_CONDITION:
            changes = fit_wiggling(data, orders, mean, std, estimates, notes)
            if changes is not None:
                return changes
            none_seen, known = True, ()
            break

    def residual(parameters: Floats) -> Floats:
        if base.kind == "direct":
            model = np.full(m, parameters[0])
        else:
            delay = float(parameters[0]) / base.metres_per_radian
            model = range_error_m(data.phase_rad, delay, known, base).mean(axis=1)
        return np.asarray(wrap_difference_m(mean - model, base) / std)

    centre = circular_mean(mean, base)
    found = optimize.least_squares(residual, [centre], x_scale=max(float(std.min()), 1e-6))
    error = 1 / float(np.linalg.norm(jacobian_of(found)))
    if m > 1:
        error *= math.sqrt(max(2 * found.cost / (m - 1), 1.0))
    where = "one distance" if m == 1 else f"{m} distances"
    text = f"mean error of {int(good.sum())} pixels at {where}"
    if base.kind == "phase" and m == 1:
        text += "; wiggling at that distance is in it"
    estimates["range_offset_m"] = FittedField(float(found.x[0]), error, text)
    changes = {"range_offset_m": float(found.x[0])}
    if none_seen:
        return {**changes, **SINE}
    if base.kind == "phase":
        needed = 2 + 2 * len(_WIGGLING_ORDERS[-1])
        period = base.unambiguous_range_m / 4
        notes.append(
            f"Offset and wiggling cannot be distinguished from {where}: that takes at least {needed}, spread over "
            f"{period:.3g} m, one period of the wiggling. The modulation is the assumed one."
        )
    return changes
