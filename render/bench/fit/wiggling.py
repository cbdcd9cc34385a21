"""Wiggling: offset and orders of the correlation curve, fitted to the mean errors of boards at many distances."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import optimize

from phasemark.render.bench.fit.boards import BoardData
from phasemark.render.bench.fit.fitted_sensor import FittedField, Floats
from phasemark.render.bench.fit.range_error import circular_mean, range_error_m
from phasemark.render.integral.rounding import with_error
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.correlation import Harmonic

_SEEN_SIGMAS = 4.0  # below, an order of the correlation is not there
SINE: dict[str, Any] = {
    "modulation": "sine",
    "max_harmonic": 49,
    "harmonics": (),
    "emitted_pulse": (),
    "reference_pulse": (),
}


def fit_wiggling(
    data: BoardData,
    orders: tuple[int, ...],
    mean: Floats,
    std: Floats,
    estimates: dict[str, FittedField],
    notes: list[str],
) -> dict[str, Any] | None:
    """Fit offset and orders of the correlation to the mean errors.

    Ranges cannot tell order k ≡ 3 mod 4 from k + 2: to first order both add sines of (k + 1)φ. All of it is put down to
    the lower one, which moves ranges alike. None where no order is seen.
    """
    sensor, m = data.sensor, len(mean)

    def harmonics(parameters: Floats) -> tuple[Harmonic, ...]:
        pairs = parameters[1:].reshape(-1, 2)
        return tuple(Harmonic(k, math.hypot(c, s), math.atan2(s, c)) for k, (c, s) in zip(orders, pairs, strict=True))

    def residual(parameters: Floats) -> Floats:
        model = range_error_m(data.phase_rad, float(parameters[0]), harmonics(parameters), sensor).mean(axis=1)
        return np.asarray(wrap_difference_m(mean - model, sensor) / std)

    start = np.zeros(1 + 2 * len(orders))
    start[0] = circular_mean(mean, sensor) / sensor.metres_per_radian
    start[1:] = 1e-3
    found = optimize.least_squares(residual, start, x_scale=0.01)
    scatter = max(2 * found.cost / max(m - len(start), 1), 1.0)
    jacobian = jacobian_of(found)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * scatter
    offset_m = float(found.x[0]) * sensor.metres_per_radian
    found_harmonics = harmonics(found.x)
    parts = []
    for j, one in enumerate(found_harmonics):
        gradient = found.x[1 + 2 * j : 3 + 2 * j] / max(one.amplitude, 1e-12)
        own = covariance[1 + 2 * j : 3 + 2 * j, 1 + 2 * j : 3 + 2 * j]
        parts.append(math.sqrt(float(gradient @ own @ gradient)))
    described = ", ".join(
        f"a_{h.order} = {with_error(h.amplitude, e)}" for h, e in zip(found_harmonics, parts, strict=True)
    )
    if all(h.amplitude < _SEEN_SIGMAS * e for h, e in zip(found_harmonics, parts, strict=True)):
        notes.append(f"No wiggling is seen at {m} distances: {described}.")
        return None
    estimates["range_offset_m"] = FittedField(
        offset_m, math.sqrt(covariance[0, 0]) * sensor.metres_per_radian, f"mean error at {m} distances, less wiggling"
    )
    estimates["harmonics"] = FittedField(
        found_harmonics[0].amplitude,
        parts[0],
        f"wiggling at {m} distances ({described}); orders 3 and 5, 7 and 9 move ranges alike: all put down to 3, 7",
    )
    kept = [(h.order, min(h.amplitude, 1.0), h.phase_rad) for h in found_harmonics if h.amplitude > 0]
    return {
        **SINE,
        "range_offset_m": offset_m,
        "modulation": "harmonics",
        "harmonics": tuple(kept),
    }


def jacobian_of(found: optimize.OptimizeResult) -> Floats:
    """Return the Jacobian of a least-squares solution, (residuals, parameters)."""
    return np.asarray(found["jac"], dtype=np.float64)
