"""Checks that the fields of a sensor agree with each other; each raises ValueError with one line."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from phasemark.inputs.numbers import in_words
from phasemark.render.sensor.correlation import SQUARE_PEAK, correlation_peak, pulse_harmonics
from phasemark.render.sensor.frequencies import check_frequencies
from phasemark.render.sensor.lens_fields import LENS_FIELD, farthest_principal_point
from phasemark.render.sensor.sensor_fields import CALIBRATION, DIRECT_ONLY, PHASE_ONLY, SensorFields
from phasemark.render.sensor.sensor_quantities import SensorQuantities

PATTERN_BOUND = 3.0
"""Fixed patterns are normal and end at this many standard deviations: no pixel of a camera that works lies beyond."""


DIRECT_MODULATION_HZ = 1e4
"""Highest `modulation_hz` of a direct sensor: at 10 m a phase of 4e-3 rad, whose mixing moves a mean range by 1e-6."""


_ROUNDING = 1e-9  # of a limit that files state in decimals


def check_principal_point(sensor: SensorQuantities) -> None:
    """Refuse a principal point far from the image, or from the image that this one is a part of."""
    image = sensor.cols, sensor.rows
    whole = sensor.whole_image_px
    if whole is not None and (whole[0] < image[0] or whole[1] < image[1]):
        raise ValueError(
            f"'whole_image_px' must hold this image of {image[0]} columns and {image[1]} rows, got {whole}"
        )
    if sensor.principal_point_px is None:
        return
    limits = farthest_principal_point(image, whole)
    for at, size, farthest in zip(sensor.principal_point_px, image, limits, strict=True):
        if not abs(at - size / 2) <= farthest:
            of = "image" if whole is None else "and a half of the whole image's"
            raise ValueError(
                f"'principal_point_px' must lie within one {of} width and height of the image's centre, got "
                f"{sensor.principal_point_px}"
            )


def check_lamp(sensor: SensorQuantities) -> None:
    """Refuse a lamp that leaves a corner of the image dark, samples that do not rise, and a second profile."""
    if sensor.lamp_shapes_light and sensor.histogram is not None:
        raise ValueError("'lamp_profile' must be left out beside 'histogram', which has 'light_width' for its light")
    if isinstance(sensor.lamp_profile, tuple):
        angles = [angle for angle, _ in sensor.lamp_profile]
        if any(b <= a for a, b in pairwise(angles)):
            raise ValueError(f"'lamp_profile' must have samples by rising angle, got the angles {in_words(angles)}")
    if sensor.lamp_half_angle_deg is not None:
        corner_deg = sensor.farthest_corner_deg
        if sensor.lamp_half_angle_deg < corner_deg * (1 - _ROUNDING):
            raise ValueError(
                f"'lamp_half_angle_deg' must be at least {corner_deg:.4g}, the angle of the image's farthest corner off"
                f" the axis, got {sensor.lamp_half_angle_deg:g}"
            )


def check_kind(sensor: SensorQuantities) -> None:
    """Refuse fields of the other kind of camera."""
    if sensor.histogram is not None and sensor.lens is not None:
        raise ValueError(
            "'lens' must be left out beside 'histogram': the zones of a direct sensor are rectangles of tangents"
        )
    foreign, why = DIRECT_ONLY, "it belongs to 'kind' = 'direct'"
    if sensor.kind == "direct":
        foreign, why = PHASE_ONLY, "a direct sensor has no taps, harmonics or phasors"
    for name in foreign:
        value = getattr(sensor, name)
        if value != SensorFields.model_fields[name].default:
            shown = "a table" if name == "histogram" else value
            raise ValueError(f"'{name}' must be left out for 'kind' = '{sensor.kind}', got {shown}: {why}")
    if sensor.kind == "direct" and len(sensor.frequencies_hz) > 1:
        raise ValueError(
            f"'modulation_hz' must be one number for 'kind' = 'direct', which has no phase images, got"
            f" {in_words(sensor.frequencies_hz)}"
        )
    if sensor.kind == "direct" and sensor.frequencies_hz[0] > DIRECT_MODULATION_HZ:
        raise ValueError(
            f"'modulation_hz' must be at most {DIRECT_MODULATION_HZ:g} for 'kind' = 'direct', which mixes no "
            f"phasors, got {sensor.frequencies_hz[0]:g}"
        )


def check_correlation(sensor: SensorQuantities) -> None:
    """Refuse harmonics and pulses that do not belong together, and a contrast that no tap can have."""
    for names, owner in ((("harmonics",), "harmonics"), (("emitted_pulse", "reference_pulse"), "pulse")):
        for name in names:
            if bool(getattr(sensor, name)) != (sensor.modulation == owner):
                verb = "must be given for" if sensor.modulation == owner else "must be left out unless"
                raise ValueError(f"'{name}' {verb} 'modulation' = '{owner}', got 'modulation' = '{sensor.modulation}'")
    orders = [k for k, _, _ in sensor.harmonics]
    if len(set(orders)) < len(orders):
        raise ValueError(f"'harmonics' must name each order once, got the orders {orders}")
    if sensor.modulation == "pulse":
        n, m = len(sensor.emitted_pulse), len(sensor.reference_pulse)
        least_pulse_samples = 8
        if n != m or n < least_pulse_samples:
            raise ValueError(
                f"'emitted_pulse' and 'reference_pulse' must have the same number of samples, at least "
                f"{least_pulse_samples}, got {n} and {m}"
            )
        try:
            pulse_harmonics(sensor.emitted_pulse, sensor.reference_pulse, sensor.max_harmonic)
        except ValueError as error:
            raise ValueError(f"'emitted_pulse' and 'reference_pulse' {error}") from None
    # The whole square wave, not its first orders, must fit: K ≤ 8/π².
    peak = SQUARE_PEAK if sensor.modulation == "square" else correlation_peak(sensor.correlation_harmonics)
    if sensor.contrast * peak > 1 + _ROUNDING:
        raise ValueError(
            f"'contrast' must be at most {1 / peak:.4g} with 'modulation' = '{sensor.modulation}', or a tap would "
            f"count less than nothing, got {sensor.contrast:g}"
        )


def check_times_and_shares(sensor: SensorQuantities) -> None:
    """Refuse times, shares and pixels that contradict each other."""
    longest = 1 / (sensor.n_phase_images * sensor.frame_rate_hz)
    if sensor.phase_interval_s is not None and sensor.phase_interval_s > longest * (1 + _ROUNDING):
        raise ValueError(
            f"'phase_interval_s' must be at most 1 / ({sensor.n_phase_images} · frame_rate_hz) = {longest:.6g}, got "
            f"{sensor.phase_interval_s:g}"
        )
    for names in (("blur_share", "veil_share"), ("dead_share", "hot_share")):
        one, other = (getattr(sensor, name) for name in names)
        if one + other >= 1:
            raise ValueError(f"'{names[0]}' + '{names[1]}' must be below 1, got {one:g} + {other:g}")
    for name in ("dead_pixels", "hot_pixels"):
        for row, col in getattr(sensor, name):
            if row >= sensor.rows or col >= sensor.cols:
                raise ValueError(
                    f"'{name}' must lie in the image of {sensor.rows} × {sensor.cols} pixels, got ({row}, {col})"
                )
    if both := sorted(set(sensor.dead_pixels) & set(sensor.hot_pixels)):
        raise ValueError(f"'dead_pixels' and 'hot_pixels' must not share a pixel, got {both[0]} in both")
    if not sensor.wrap_guard_m < sensor.unambiguous_range_m / 2:
        limit = "c / 4f" if len(sensor.frequencies_hz) == 1 else "c / (4 gcd f)"
        raise ValueError(
            f"'wrap_guard_m' must be below {limit} = {sensor.unambiguous_range_m / 2:.4g}, got {sensor.wrap_guard_m:g}"
        )


def check_read_out(sensor: SensorQuantities) -> None:
    """Refuse a read-out that leaves no room for light."""
    if sensor.adc_bits is None:
        for name in ("gain", "black_level"):
            value = getattr(sensor, name)
            if value != SensorFields.model_fields[name].default:
                raise ValueError(f"'{name}' must be left out without a converter ('adc_bits'), got {value:g}")
    elif sensor.black_level >= 2**sensor.adc_bits - 1:
        raise ValueError(
            f"'black_level' must be below the converter's highest code, {2**sensor.adc_bits - 1}, got "
            f"{sensor.black_level:g}"
        )
    if sensor.dsnu_e > sensor.dark_e / 6 * (1 + _ROUNDING):
        raise ValueError(
            f"'dsnu_e' must be at most dark_e / 6 = {sensor.dark_e / 6:g}: a tap's dark signal, dark_e / 2, varies "
            f"by up to {PATTERN_BOUND:g} standard deviations and cannot be negative, got {sensor.dsnu_e:g}"
        )
    offset_e = (sensor.ambient_e + sensor.dark_e) / 2
    if sensor.saturation_e <= offset_e:
        limit = "full_well_e" if sensor.full_well_e == sensor.saturation_e else "gain"
        raise ValueError(
            f"'{limit}' leaves no room for light: a tap saturates at {sensor.saturation_e:.6g} e-, and ambient light "
            f"and dark current alone bring {offset_e:.6g} e-"
        )


def check_threshold(sensor: SensorQuantities) -> None:
    """Refuse a threshold that the brightest pixel cannot meet."""
    if not math.isfinite(sensor.saturation_e):
        return
    # The brightest pixel that does not saturate: ½ (A/K + N_amb + N_dark + A · peak) = saturation.
    peak = correlation_peak(sensor.correlation_harmonics)
    offset_e = sensor.ambient_e + sensor.dark_e
    amplitude_e = (2 * sensor.saturation_e - offset_e) / (1 / sensor.contrast + peak)
    if sensor.min_amplitude_e >= amplitude_e:
        raise ValueError(
            f"'min_amplitude_e' must be below {amplitude_e:.6g}, the amplitude at which a tap saturates at "
            f"{sensor.saturation_e:.6g} e- (full well or converter), got {sensor.min_amplitude_e:g}"
        )
    if sensor.max_phase_std_rad is not None:
        shot = amplitude_e / sensor.contrast + offset_e if sensor.shot_noise else 0.0
        least = math.sqrt((shot + sensor.read_variance_e2) / 2) / amplitude_e
        if sensor.max_phase_std_rad <= least:
            raise ValueError(
                f"'max_phase_std_rad' must be above {least:.4g}, the noise of the brightest pixel that does not "
                f"saturate at {sensor.saturation_e:.6g} e- (full well or converter), got {sensor.max_phase_std_rad:g}"
            )


def check_tables(sensor: SensorQuantities) -> None:
    """Refuse tables of another size, and a covariance that is none."""
    if sensor.histogram is not None:
        sensor.histogram.check_zones(sensor.rows, sensor.cols)
    if sensor.zone_offset_m:
        _check_table("zone_offset_m", sensor.zone_offset_m, sensor.rows, sensor.cols, "rows x cols of the sensor")
    names = sensor.calibration_fields
    for name in names:
        _check_calibrated_field(sensor, name)
        if names.count(name) > 1:
            raise ValueError(f"'calibration_fields' must name each field once, got '{name}' twice")
    covariance = sensor.calibration_covariance
    _check_table("calibration_covariance", covariance, len(names), len(names), "one for each of calibration_fields")
    matrix = np.array(covariance, dtype=np.float64).reshape(len(names), len(names))
    variance = np.diag(matrix)
    if (variance < 0).any():
        k = int((variance < 0).argmax())
        raise ValueError(f"'calibration_covariance' must have no negative variance, got {variance[k]:g}")
    root = np.sqrt(np.where(variance > 0, variance, 1.0))
    correlation = matrix / np.outer(root, root)
    semidefinite = 1e-5  # negative eigenvalue of a correlation matrix that rounding to the digits of a file may cause
    if not np.allclose(correlation, correlation.T, rtol=0, atol=semidefinite):
        raise ValueError("'calibration_covariance' must be symmetric")
    lowest = float(np.linalg.eigvalsh(correlation).min()) if names else 0.0
    if lowest < -semidefinite:
        raise ValueError(
            f"'calibration_covariance' must be positive semidefinite, but its correlation matrix has the eigenvalue"
            f" {lowest:.3g}"
        )


def _check_calibrated_field(sensor: SensorQuantities, name: str) -> None:
    """Refuse the name of what is no number of the sensor or of its lens."""
    if name.startswith(LENS_FIELD):
        terms = {} if sensor.lens is None else sensor.lens.terms
        if name.removeprefix(LENS_FIELD) not in terms:
            has = f"has {', '.join(terms)}" if terms else "is not stated"
            raise ValueError(f"'calibration_fields' must name terms of the lens, which {has}, got '{name}'")
        return
    number = name in SensorFields.model_fields and isinstance(getattr(sensor, name), float)
    if not number or name in CALIBRATION:
        raise ValueError(f"'calibration_fields' must name fields of the sensor that are numbers, got '{name}'")


def check_fields(sensor: SensorQuantities) -> None:
    """Make all checks, in the order in which their findings are told."""
    check_principal_point(sensor)
    check_kind(sensor)
    check_frequencies(sensor.frequencies_hz)
    check_correlation(sensor)
    check_times_and_shares(sensor)
    check_read_out(sensor)
    check_threshold(sensor)
    check_tables(sensor)
    check_lamp(sensor)


def _check_table(name: str, table: tuple[tuple[float, ...], ...], rows: int, cols: int, what: str) -> None:
    """Raise ValueError if a table does not have the stated numbers of rows and columns."""
    lengths = {len(row) for row in table}
    if len(table) != rows or lengths - {cols}:
        got = f"{len(table)} rows of {' or '.join(map(str, sorted(lengths))) or 'no'} numbers"
        raise ValueError(f"'{name}' must have {rows} rows of {cols} numbers, {what}, got {got}")
