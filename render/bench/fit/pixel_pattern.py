"""Differences between pixels: range offsets, and pixels that are dead, stuck, noisy or far off."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.render.bench.fit.boards import DEAD_SHARE, BoardData
from phasemark.render.bench.fit.fitted_sensor import FittedField, Floats
from phasemark.render.bench.fit.range_error import harmonics_of, range_error_m
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.sensor import Sensor

_NOISY_FACTOR = 2.0  # σ of a pixel over that of its neighbours, beside the test of χ²
_OUTLIER_SIGMAS = 6.0
_PIXEL_FALSE_ALARM = 1e-3  # of all pixels together
_DELAY_STEP_RAD = 1e-4


def pattern(data: BoardData, changes: dict[str, Any]) -> tuple[Floats, Floats]:
    """Return the delay of each pixel beside offset and wiggling, as range, and its standard error; (rows, cols).

    A delay moves the range by more or less than itself where the range wiggles: by the slope of the model.
    """
    harmonics = harmonics_of(data.sensor, changes)
    delay = changes["range_offset_m"] / data.sensor.metres_per_radian
    phase = data.truth_m / data.sensor.metres_per_radian
    model = range_error_m(phase, delay, harmonics, data.sensor)
    later = range_error_m(phase, delay + _DELAY_STEP_RAD, harmonics, data.sensor)
    slope = wrap_difference_m(later - model, data.sensor) / (_DELAY_STEP_RAD * data.sensor.metres_per_radian)
    residual = wrap_difference_m(data.error_m - model, data.sensor)[:, data.good]
    slope, noise = slope[:, data.good], (data.variance_m2 / np.maximum(data.n, 1))[:, data.good]
    # without any noise every distance counts alike
    weight = 1 / np.maximum(noise, 1e-18)
    information = (weight * slope**2).sum(axis=0)
    offset, error = np.full(data.good.shape, np.nan), np.full(data.good.shape, np.nan)
    offset[data.good] = (weight * slope * residual).sum(axis=0) / information
    error[data.good] = np.sqrt((weight**2 * slope**2 * noise).sum(axis=0)) / information
    return offset, error


def pattern_moved(data: BoardData, changes: dict[str, Any]) -> Floats:
    """Return how the pattern moves with one standard deviation of each board's distance, (boards, rows, cols).

    Ranges grow from the middle to the corners, so an error of the distance does too; its mean is in the offset.
    """
    before, _ = pattern(data, changes)
    moved = np.array([pattern(data.shifted(k, std), changes)[0] - before for k, std in enumerate(data.distance_std_m)])
    if data.good.any():
        moved -= moved[:, data.good].mean(axis=1)[:, None, None]
    return moved


def odd_pixels(data: BoardData, offset_m: Floats) -> NDArray[np.bool_]:
    """Return pixels that are stuck, far noisier than the rest at their light, or far off; (rows, cols)."""
    good = data.good
    if good.sum() < 3:
        return np.zeros_like(good)
    scaled = np.where(good, data.variance_m2 * data.light, np.nan)  # shot noise: σ² follows 1 / light
    middle = np.nanmedian(scaled, axis=(1, 2), keepdims=True)
    stuck = good & (middle > 0).all() & (data.variance_m2 == 0).any(axis=0)
    limit = special.chdtri(data.n - 1, _PIXEL_FALSE_ALARM / scaled.size) / np.maximum(data.n - 1, 1)
    loud = np.nan_to_num(scaled) > np.maximum(limit, _NOISY_FACTOR**2) * middle
    centre = np.nanmedian(offset_m)
    spread = 1.4826 * np.nanmedian(np.abs(offset_m - centre))
    far = np.abs(np.nan_to_num(offset_m - centre)) > max(_OUTLIER_SIGMAS * spread, 1e-12)
    return np.asarray(good & (stuck | loud.any(axis=0) | far))


def pattern_fields(
    data: BoardData,
    base: Sensor,
    offset_m: Floats,
    offset_error_m: Floats,
    moved_m: Floats,
    odd: NDArray[np.bool_],
    estimates: dict[str, FittedField],
) -> dict[str, Any]:
    """Return the fields about single pixels."""
    good = data.good
    dead = data.dead
    changes: dict[str, Any] = {
        "dead_pixels": tuple((int(row), int(col)) for row, col in np.argwhere(dead)),
        "dead_share": 0.0,
    }
    estimates["dead_pixels"] = FittedField(
        float(dead.sum()), 0.0, f"valid in less than {100 * DEAD_SHARE:.0f} % of the frames at every distance"
    )
    if base.kind == "direct":
        changes["dead_pixels"] = tuple((int(row), int(col)) for row, col in np.argwhere(dead | odd))
        return changes
    changes["hot_pixels"] = tuple((int(row), int(col)) for row, col in np.argwhere(odd))
    changes["hot_share"] = 0.0
    estimates["hot_pixels"] = FittedField(
        float(odd.sum()), 0.0, f"stuck, noisier than {_NOISY_FACTOR:g} times the median or {_OUTLIER_SIGMAS:g} σ off"
    )
    count = int(good.sum())
    if count < 3:
        return changes
    noise = float((offset_error_m[good] ** 2).mean())
    own, moved = offset_m[good] - offset_m[good].mean(), moved_m[:, good]
    by_distance = moved.var(axis=1, ddof=1)  # of each board
    variance = max(float(offset_m[good].var(ddof=1)) - noise - float(by_distance.sum()), 0.0)
    # of a normal pattern's variance, its own and the noise's spread alike; a distance's error δ adds 2δ·cov + δ²·var
    levers = 2 * (moved * own).sum(axis=1) / (count - 1)
    of_distances = float((levers**2).sum() + 2 * (by_distance**2).sum())
    of_variance = math.hypot(math.sqrt(2 / (count - 1)) * (variance + noise), math.sqrt(of_distances))
    std_m = math.sqrt(variance)
    error_m = of_variance / (2 * std_m) if variance > of_variance else math.sqrt(of_variance)
    scale = base.metres_per_radian
    estimates["phase_offset_std_rad"] = FittedField(
        std_m / scale, error_m / scale,
        f"spread of {count} pixels' offsets less noise, {1e3 * std_m:.3g} mm; a tilt of the board is in it",
    )  # fmt: skip
    changes["phase_offset_std_rad"] = min(std_m / scale, 1.0)
    changes["tap_phase_offset_std_rad"] = 0.0
    return changes
