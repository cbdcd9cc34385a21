"""Range errors of boards: the global offset with the wiggling beside it, and what single pixels add to it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from phasemark import UsageError
from phasemark.render.bench.fit.boards import DEAD_SHARE, BoardData
from phasemark.render.bench.fit.fitted_sensor import Findings, Floats
from phasemark.render.bench.least_squares import weighted_fit
from phasemark.render.integral.rounding import with_error
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.correlation import Harmonic, correlation_curve
from phasemark.render.sensor.sensor import Sensor

_WIGGLING_ORDERS = ((3, 7), (3,))  # most first; each order is two numbers
_NOISY_FACTOR = 2.0  # σ of a pixel over that of its neighbours, beside the test of χ²
_OUTLIER_SIGMAS = 6.0
_SINE: dict[str, Any] = {
    "modulation": "sine", "max_harmonic": 49, "harmonics": (), "emitted_pulse": (), "reference_pulse": (),
}  # fmt: skip


def _range_error_m(phase: Floats, delay: float, harmonics: tuple[Harmonic, ...], sensor: Sensor) -> Floats:
    """Return the error of the noise-free range, offset and wiggling, from four samples of the correlation curve."""
    samples = [correlation_curve(phase + delay + i * math.pi / 2, harmonics) for i in range(4)]
    measured = np.arctan2(samples[3] - samples[1], samples[0] - samples[2])
    return np.asarray(wrap_difference_m((measured - phase) * sensor.metres_per_radian, sensor))


def fit_offsets(data: BoardData, found: Findings) -> None:
    """Fit the global offset, and wiggling if the distances allow it, to the mean error of each board.

    Ranges cannot tell order k ≡ 3 mod 4 from k + 2: to first order both add sines of (k + 1)φ. All of it is put down to
    the lower one, which moves ranges alike.
    """
    base, scale = data.sensor, data.sensor.metres_per_radian
    truth = data.used(data.truth_m)
    phase, mean = truth / scale, data.used([one.mean for one in data.error_m]).mean(axis=1)
    # the same pixels see every board, so their own offsets move all means alike
    temporal = np.sqrt(data.mean_variance_m2.mean(axis=1) / truth.shape[1])
    # an error of the distance is one of the mean; its lever on the wiggling's phase is small beside that
    std = np.maximum(np.hypot(temporal, data.distance_std_m * (truth / data.distance_m[:, None]).mean(axis=1)), 1e-9)
    m, known = len(mean), base.correlation_harmonics
    _check_distances(data, mean, std)

    def fitted(orders: tuple[int, ...]) -> tuple[float, float, list[tuple[Harmonic, float]]]:
        """Return the offset with its error, and each order with the error of its amplitude."""

        def harmonics(x: Floats) -> tuple[Harmonic, ...]:
            pairs = zip(orders, x[1:].reshape(-1, 2), strict=True)
            return tuple(Harmonic(k, math.hypot(c, s), math.atan2(s, c)) for k, (c, s) in pairs) if orders else known

        def residual(x: Floats) -> Floats:
            model = _range_error_m(phase, float(x[0]), harmonics(x), base).mean(axis=1)
            return np.asarray(wrap_difference_m(mean - model, base) / std)

        middle = float(np.angle(np.exp(1j * mean / scale).sum()))
        solved = optimize.least_squares(residual, [middle, *[1e-3] * (2 * len(orders))], x_scale=0.01)
        scatter = max(2 * solved.cost / max(m - len(solved.x), 1), 1.0)
        covariance = weighted_fit(np.asarray(solved["jac"], np.float64), residual(solved.x), np.ones(m))[1] * scatter
        seen = []
        for j, one in enumerate(harmonics(solved.x) if orders else ()):
            own = slice(1 + 2 * j, 3 + 2 * j)
            gradient = solved.x[own] / max(one.amplitude, 1e-12)
            seen.append((one, math.sqrt(float(gradient @ covariance[own, own] @ gradient))))
        return float(solved.x[0]) * scale, math.sqrt(covariance[0, 0]) * scale, seen

    worst_condition = 20.0  # of the wiggling's design: beyond, the distances cover too little of its period
    seen_sigmas = 4.0  # below, an order of the correlation is not there
    for orders in _WIGGLING_ORDERS:
        parts = [part((k + 1) * phase).mean(axis=1) for k in orders for part in (np.cos, np.sin)]
        design = np.column_stack([np.ones(m), *parts])
        if base.kind == "direct" or m < 1 + design.shape[1]:
            continue
        if np.linalg.cond(design / np.linalg.norm(design, axis=0)) > worst_condition:
            continue
        offset_m, error_m, seen = fitted(orders)
        described = ", ".join(f"a_{one.order} = {with_error(one.amplitude, error)}" for one, error in seen)
        found.fields |= _SINE
        if any(one.amplitude >= seen_sigmas * error for one, error in seen):
            found.add("range_offset_m", offset_m, error_m, f"mean error at {m} distances, less wiggling")
            found.add(
                "harmonics", seen[0][0].amplitude, seen[0][1],
                f"wiggling at {m} distances ({described}); orders 3 and 5, 7 and 9 move ranges alike: all put down to "
                "3, 7",
            )  # fmt: skip
            kept = tuple((one.order, min(one.amplitude, 1.0), one.phase_rad) for one, _ in seen if one.amplitude > 0)
            found.fields |= {"modulation": "harmonics", "harmonics": kept}
            return
        found.notes.append(f"No wiggling is seen at {m} distances: {described}.")
        known = ()
        break
    where = "one distance" if m == 1 else f"{m} distances"
    offset_m, error_m, _ = fitted(())
    caveat = "; wiggling at that distance is in it" if base.kind == "phase" and m == 1 else ""
    found.add("range_offset_m", offset_m, error_m, f"mean error of {truth.shape[1]} pixels at {where}{caveat}")
    if base.kind == "phase" and "modulation" not in found.fields:
        found.notes.append(
            f"Offset and wiggling cannot be distinguished from {where}: that takes at least "
            f"{2 + 2 * len(_WIGGLING_ORDERS[-1])}, spread over {base.unambiguous_range_m / 4:.3g} m, one period of the "
            "wiggling. The modulation is the assumed one."
        )


def _check_distances(data: BoardData, mean: Floats, std: Floats) -> None:
    """Refuse boards whose mean errors, (m,), differ by more than wiggling makes them."""
    most_m = 0.1 if data.sensor.kind == "direct" else 0.1 * data.sensor.metres_per_radian
    off = wrap_difference_m(mean - np.median(mean), data.sensor)
    k = int(np.argmax(np.abs(off) - 6.0 * std))
    if abs(off[k]) > most_m + 6.0 * std[k]:
        raise UsageError(
            f"the board at {data.distance_m[k]:g} m measures {off[k]:+.2g} m off what the others do: is its distance"
            " right, and are the distances in the order of the files?"
        )


def pixel_offsets(data: BoardData, found: Findings) -> tuple[Floats, Floats, Floats]:
    """Return the delay of each pixel beside offset and wiggling, as range; its standard error; its errors by board.

    A delay moves the range by more or less than itself where the range wiggles: by the slope of the model. The last,
    (boards, rows, cols), are those of one standard deviation of each board's distance: ranges grow from the middle to
    the corners, so an error of the distance does too; its mean is in the offset.
    """
    sensor, scale = data.sensor, data.sensor.metres_per_radian
    harmonics = sensor.correlation_harmonics
    if "harmonics" in found.fields:
        harmonics = tuple(Harmonic(*one) for one in found.fields["harmonics"])
    delay, truth = found.fields["range_offset_m"] / scale, data.used(data.truth_m)
    model = _range_error_m(truth / scale, delay, harmonics, sensor)
    delay_step_rad = 1e-4
    later = _range_error_m(truth / scale, delay + delay_step_rad, harmonics, sensor)
    slope = wrap_difference_m(later - model, sensor) / (delay_step_rad * scale)
    residual = wrap_difference_m(data.used([one.mean for one in data.error_m]) - model, sensor)
    # a pixel's own variance of few frames is a poor weight; without any noise every distance counts alike
    noise_m2 = np.mean(data.used(data.variance_m2) / data.used(data.n), axis=1, keepdims=True)
    weight = np.broadcast_to(1 / np.maximum(noise_m2, 1e-18), truth.shape)
    information = (weight * slope**2).sum(axis=0)
    # a longer distance moves the phase as a delay does, and the truth as well
    moved = -weight * slope**2 * truth * (data.distance_std_m / data.distance_m)[:, None] / information
    of_pixels = (
        (weight * slope * residual).sum(axis=0) / information,
        np.sqrt((weight**2 * slope**2 * data.mean_variance_m2).sum(axis=0)) / information,
        moved - moved.mean(axis=1, keepdims=True),
    )
    images = tuple(np.full((*values.shape[:-1], *data.good.shape), np.nan) for values in of_pixels)
    for image, values in zip(images, of_pixels, strict=True):
        image[..., data.good] = values
    return images[0], images[1], images[2]


def board_tilts(data: BoardData) -> tuple[Floats, Floats]:
    """Return by how much each board is tilted against the optical axis, with standard errors, (boards,) radians.

    A board at D whose normal is turned by α has ranges that differ by −D tan α · (y, z)/x over the axis cosine, to
    first order, at the ray (x, y, z) of a pixel; what is square to that is offset, wiggling and pattern.
    """
    rays = data.sensor.pixel_directions() @ data.sensor.cam2level  # along the camera's own axes
    across, up = (rays[..., k][data.good] / rays[..., 0][data.good] ** 2 for k in (1, 2))
    design = np.column_stack([np.ones_like(across), -across, -up])
    angles = []
    for distance, error in zip(data.distance_m, data.used([one.mean for one in data.error_m]), strict=True):
        solution, covariance = weighted_fit(design, error, np.ones(len(error)))
        freedom = max(len(error) - design.shape[1], 1)
        variance = float(((error - design @ solution) ** 2).sum()) / freedom * np.diag(covariance)[1:].max()
        angles.append((math.atan(math.hypot(*solution[1:]) / distance), math.sqrt(variance) / distance))
    angle, std = np.transpose(angles)
    return angle, std


def bowl(data: BoardData) -> tuple[float, float]:
    """Return by how much ranges rise towards the edges, in differences between range and z, with the standard error.

    It is 0 of a board; −1 where z is taken for range, and 1 where range is taken for z.
    """
    error = data.used([one.mean for one in data.error_m])
    rise = data.distance_m[:, None] * (1 / data.sensor.axis_cosine()[data.good] - 1)
    error, rise = (values - values.mean(axis=1, keepdims=True) for values in (error, rise))
    least = np.finfo(float).tiny
    slope = float((rise * error).sum() / max((rise**2).sum(), least))
    variance = float(((error - slope * rise) ** 2).sum() / max((rise**2).sum(), least)) / max(rise.size - 1, 1)
    return slope, math.sqrt(variance)


def odd_pixels(data: BoardData, offset_m: Floats) -> NDArray[np.bool_]:
    """Return pixels that are stuck, far noisier than the rest at their light, or far off; (rows, cols)."""
    good = data.good
    if good.sum() < 3:
        return np.zeros_like(good)
    scaled = np.where(good, data.variance_m2 * data.light, np.nan)  # shot noise: σ² follows 1 / light
    middle = np.nanmedian(scaled, axis=(1, 2), keepdims=True)
    stuck = good & (middle > 0).all() & (data.variance_m2 == 0).any(axis=0)
    pixel_false_alarm = 1e-3  # of all pixels together
    limit = special.chdtri(data.n - 1, pixel_false_alarm / scaled.size) / np.maximum(data.n - 1, 1)
    loud = np.nan_to_num(scaled) > np.maximum(limit, _NOISY_FACTOR**2) * middle
    centre = np.nanmedian(offset_m)
    spread = 1.4826 * np.nanmedian(np.abs(offset_m - centre))
    far = np.abs(np.nan_to_num(offset_m - centre)) > max(_OUTLIER_SIGMAS * spread, 1e-12)
    return np.asarray(good & (stuck | loud.any(axis=0) | far))


def fit_pixels(data: BoardData, odd: NDArray[np.bool_], found: Findings) -> tuple[Floats, Floats]:
    """Find defects and the spread of the offsets of pixels; return these with standard errors, (rows, cols)."""
    offset_m, error_m, moved_m = pixel_offsets(data, found)
    own, noise_m, moved = offset_m[data.good], error_m[data.good], moved_m[:, data.good]
    error_m = np.sqrt(error_m**2 + (moved_m**2).sum(axis=0))
    text = f"valid in less than {100 * DEAD_SHARE:.0f} % of the frames at every distance"
    found.add("dead_pixels", data.dead.sum(), 0.0, text)
    phase = data.sensor.kind == "phase"
    found.fields |= {"dead_pixels": _places(data.dead if phase else data.dead | odd), "dead_share": 0.0}
    if not phase:
        return offset_m, error_m
    text = f"stuck, noisier than {_NOISY_FACTOR:g} times the median or {_OUTLIER_SIGMAS:g} σ off"
    found.add("hot_pixels", odd.sum(), 0.0, text)
    found.fields |= {"hot_pixels": _places(odd), "hot_share": 0.0}
    count, scale = len(own), data.sensor.metres_per_radian
    if count < 3:
        return offset_m, error_m
    noise, own = float((noise_m**2).mean()), own - own.mean()
    by_distance = moved.var(axis=1, ddof=1)  # of each board
    variance = max(float(own.var(ddof=1)) - noise - float(by_distance.sum()), 0.0)
    # of a normal pattern's variance, its own and the noise's spread alike; a distance's error δ adds 2δ·cov + δ²·var
    levers = 2 * (moved * own).sum(axis=1) / (count - 1)
    of_distances = float((levers**2).sum() + 2 * (by_distance**2).sum())
    of_variance = math.hypot(math.sqrt(2 / (count - 1)) * (variance + noise), math.sqrt(of_distances))
    std_m = math.sqrt(variance)
    std_error_m = of_variance / (2 * std_m) if variance > of_variance else math.sqrt(of_variance)
    text = f"spread of {count} pixels' offsets less noise, {1e3 * std_m:.3g} mm; a tilt of the board is in it"
    found.add("phase_offset_std_rad", std_m / scale, std_error_m / scale, text)
    found.fields |= {"phase_offset_std_rad": min(std_m / scale, 1.0), "tap_phase_offset_std_rad": 0.0}
    return offset_m, error_m


def _places(mask: NDArray[np.bool_]) -> tuple[tuple[int, int], ...]:
    return tuple((int(row), int(col)) for row, col in np.argwhere(mask))
