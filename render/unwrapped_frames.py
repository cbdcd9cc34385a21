"""Frames of several modulation frequencies: one range from what each of them measured (PHYSICS section 10)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.frames import Flag, Frames
from phasemark.render.sensor.range_noise import measured_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.unwrapping import Unwrapped, unwrap_ranges


def unwrap_frames(parts: Sequence[Frames], sensor: Sensor, *, taps_e: NDArray[np.float64] | None = None) -> Frames:
    """Return the frames of a camera of several frequencies from those that each frequency measured.

    The range is that of :func:`~phasemark.render.unwrap_ranges` with the noise law at each frequency's measured
    amplitude and intensity (without these, with the phase noise that the sensor allows) and, beside it, the phase
    errors that the sensor has at each frequency: offsets and wiggling. A pixel is a return where every
    frequency has a range and these agree; it is NO_RETURN where no frequency has one for want of light. Where
    frequencies disagree beyond noise, or some return and others do not, it is INCONSISTENT, and MISSING wherever a
    frequency's range is missing.

    Parameters
    ----------
    parts : sequence of Frames
        Frames of each of ``sensor.by_frequency``, in this order and of one shape.
    sensor : Sensor
        Of one frequency the frames come back as they are.
    taps_e : (n, frames, 4 m, 2, rows, cols) float64, optional
        What the taps reported.

    Returns
    -------
    Frames
        Amplitude and intensity are those of the first frequency; ``frames.by_frequency`` are `parts`.

    Raises
    ------
    UsageError
        The parts are not those of the sensor's frequencies.
    """
    if len(sensor.frequencies_hz) == 1:
        return parts[0]
    if len(parts) != len(sensor.frequencies_hz):
        raise UsageError(
            f"'parts' must be frames of each of {len(sensor.frequencies_hz)} frequencies, got {len(parts)}"
        )
    std = [np.broadcast_to(_one_frame_std_m(part), part.range_m.shape) for part in parts]
    found = unwrapped([part.range_m for part in parts], std, sensor)
    first = parts[0]
    return Frames(
        found.range_m,
        first.amplitude_e,
        first.intensity_e,
        sensor=sensor,
        flags=_flags(np.stack([part.flags for part in parts]), found.range_m, found.consistent, sensor),
        taps_e=taps_e,
        time_s=first.time_s,
        tilt_rad=first.tilt_rad,
        by_frequency=parts,
    )


def unwrapped(
    range_m: Sequence[NDArray[np.float64]], std_m: Sequence[NDArray[np.float64]], sensor: Sensor
) -> Unwrapped:
    """Return the unwrapped range of several frequencies, each with errors that no averaging removes.

    Parameters
    ----------
    range_m, std_m : sequence of (...) float64
        Wrapped range and its noise at each of the sensor's frequencies.
    sensor : Sensor

    Returns
    -------
    Unwrapped
        `std_m` is that of the noise alone.
    """
    offset_m = systematic_phase_std_rad(sensor) * np.array([camera.metres_per_radian for camera in sensor.by_frequency])
    noise = np.stack([np.where(np.isfinite(own), std, 1.0) for own, std in zip(range_m, std_m, strict=True)])
    each = (slice(None), *(None,) * (noise.ndim - 1))
    found = unwrap_ranges(np.stack(list(range_m)), np.hypot(noise, offset_m[each]), sensor)
    if not offset_m.any():
        return found
    # the mean is weighted with both errors; this is its noise
    weight = np.hypot(noise, offset_m[each]) ** -2.0
    std = np.sqrt(np.sum((weight * noise) ** 2, axis=0)) / weight.sum(axis=0)
    return found._replace(std_m=np.where(np.isnan(found.range_m), np.nan, std))


def systematic_phase_std_rad(sensor: Sensor) -> float:
    """Return the standard deviation of the phase errors that differ from frequency to frequency and are no noise.

    The fixed offsets of pixels and taps, and wiggling: the harmonic k of the correlation moves the phase by
    a_k sin((k ± 1) φ + θ_k), which is a_k / √2 r.m.s. over all phases φ; even orders cancel.
    """
    wiggling = sum(amplitude**2 / 2 for k, amplitude, _ in sensor.correlation_harmonics if k % 2)
    return math.sqrt(sensor.phase_offset_std_rad**2 + sensor.tap_phase_offset_std_rad**2 / 2 + wiggling)


def _one_frame_std_m(frames: Frames) -> NDArray[np.float64]:
    """Return the noise of one frame's range, metres."""
    sensor = frames.sensor
    if frames.amplitude_e is None or frames.intensity_e is None:
        usual_phase_std_rad = 0.1  # phase noise of frames without amplitudes, where the sensor allows no less
        return np.array((sensor.max_phase_std_rad or usual_phase_std_rad) * sensor.metres_per_radian)
    return measured_range_std(frames.amplitude_e, frames.intensity_e, sensor)


def _flags(
    flags: NDArray[np.uint8], range_m: NDArray[np.float64], consistent: NDArray[np.bool_], sensor: Sensor
) -> NDArray[np.uint8]:
    """Return why the unwrapped ranges are not valid, from the flags (m, ...) of the frequencies."""
    dark = flags == int(Flag.NO_RETURN)
    missing = ((flags != 0) & ~dark).any(axis=0)
    # what a frequency says of its own pixel stays, but for the want of light, which all of them have to say
    said = np.bitwise_or.reduce(np.where(dark, 0, flags).astype(np.uint8), axis=0)
    out = np.where(missing, said, 0).astype(np.uint8)
    out[~missing & dark.all(axis=0)] = int(Flag.NO_RETURN)
    mixed = ~missing & ~dark.all(axis=0) & (dark.any(axis=0) | ~consistent)
    out[mixed] = int(Flag.INCONSISTENT | Flag.MISSING)
    if sensor.wrap_guard_m > 0:
        near = np.minimum(range_m, sensor.unambiguous_range_m - range_m) < sensor.wrap_guard_m
        out[(out == 0) & near] = int(Flag.NEAR_WRAP | Flag.MISSING)
    return out
