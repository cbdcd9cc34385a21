"""Fit of a sensor to measured flat-field frames of a board, square to the camera, at known distances.

What can be told depends on what was measured. Ranges alone at one distance show one number of noise; several
distances or albedos tell shot noise, which follows the light, from noise that does not; amplitude and intensity add the
electrons themselves. :func:`fit_sensor` says of every number whether it was measured, and from what.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.bench.fit.boards import (
    FEWEST_FRAMES,
    PIXEL_STD_ERROR,
    BoardData,
    known_distance_std,
    one_for_each,
)
from phasemark.render.bench.fit.fitted_sensor import AmplitudeUnit, Findings, SensorFit
from phasemark.render.bench.fit.light import fit_light, limit_contrast
from phasemark.render.bench.fit.ranges import board_tilts, bowl, fit_offsets, fit_pixels, odd_pixels, pixel_offsets
from phasemark.render.frames import Frames
from phasemark.render.integral.rounding import with_error
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.sensor.sensor_file import rounded


def _check_tilt(data: BoardData, found: Findings) -> None:
    """Refuse a board that is far from square to the camera, and note one that is nearly."""
    angle, std = board_tilts(data)
    seen_sigmas, noted_deg, most_deg = 5.0, 0.3, 3.0
    tilt_deg = np.degrees(np.where(angle > seen_sigmas * std, angle, 0.0))
    k = int(tilt_deg.argmax())
    where = f"the board at {data.distance_m[k]:g} m is tilted by about {tilt_deg[k]:.2g}° against the optical axis"
    if tilt_deg[k] > most_deg:
        raise UsageError(f"{where}, which would be taken for offsets of pixels: set it square to the camera")
    if tilt_deg[k] > noted_deg:
        found.notes.append(f"{where[0].upper()}{where[1:]}: that is in the spread of the pixels' offsets.")


def _refuse_other_quantity(data: BoardData) -> None:
    """Refuse ranges that are z, and the other way round."""
    slope, std = bowl(data)
    most_off, most_std = 0.2, 0.1
    if abs(abs(slope) - 1) < most_off and std < most_std:
        told, right = ("range", "z") if slope < 0 else ("z", "range")
        raise UsageError(
            f"the board's ranges {'fall' if slope < 0 else 'rise'} towards the edges by what z and range differ:"
            f" taken for {told}, they must be {right}. Is quantity=… right?"
        )


def fit_sensor(
    frames: Sequence[Frames],
    distance_m: Sequence[float] | NDArray[np.floating],
    *,
    base: Sensor,
    albedo: Sequence[float] | None = None,
    amplitude_unit: AmplitudeUnit = "electrons",
    distance_std_m: float | Sequence[float] | None = None,
) -> SensorFit:
    """Estimate a camera from frames of a flat board that fills the image, square to the optical axis.

    With the range error e = offset + wiggling(phase) + pattern and the noise law σ_φ² = (I + V) / 2A² (PHYSICS section
    4), the board's light follows from distance and albedo, S = ρ cos θ / r² averaged over each pixel:

    - the offset is the mean error; with distances enough, wiggling is fitted beside it;
    - the pattern is the remaining error of each pixel, its spread less the spread that noise leaves;
    - from ranges alone, σ_φ² = a/S + b/S² with a = 1 / 2K²N₀ and b = (all noise that does not follow the light) /
      2K²N₀²; K is assumed;
    - from amplitude in electrons, K N₀ = A/S and 2σ_φ²A² = N₀S + (N_amb + N_dark + V); from intensity as well,
      I = N₀S + N_amb + N_dark and V = 2σ_φ²A² − I;
    - from amplitude and intensity in arbitrary units, g = slope of 2σ_φ²A² over I turns both into electrons.

    The errors of the distances are propagated to first order: they move ranges directly and the light by −2σ_r / r.

    Parameters
    ----------
    frames : sequence of Frames
        One position each, at least `FEWEST_FRAMES` frames.
    distance_m : sequence of float
        Distance of the board along the optical axis for each.
    base : Sensor
        The camera as far as it is known: geometry, modulation frequency and all that is not measured. Of several
        frequencies each is fitted by itself, ``base.by_frequency[j]`` to ``frames.by_frequency[j]``.
    albedo : sequence of float, optional
        Albedo of each board, or one for all; without it 0.8 is assumed.
    amplitude_unit : {"electrons", "arbitrary"}
        Unit of the frames' amplitude and intensity.
    distance_std_m : float or sequence of float, optional
        Standard deviation of the distances, one for all or one for each, independent from board to board; without it
        `DISTANCE_STD_M`, 1 mm, is assumed. 0: exact.

    Returns
    -------
    SensorFit

    Raises
    ------
    UsageError
        Numbers of frames, distances, albedos and standard deviations do not fit; there are too few frames; no pixel is
        valid often enough; a board is farther than 20 m, or tilted by more than 3°; the mean error of one is far from
        those of the others; a standard deviation is negative or more than a tenth of its distance.
    """
    base.refuse_several_frequencies("a fit")
    if len(frames) != len(distance_m) or not frames:
        raise UsageError(
            f"each set of frames needs its distance: got {len(frames)} of frames and {len(distance_m)} of distances"
        )
    if amplitude_unit not in ("electrons", "arbitrary"):
        raise UsageError(f"'amplitude_unit' must be 'electrons' or 'arbitrary', got {amplitude_unit!r}")
    albedos = one_for_each(0.8 if albedo is None else albedo, distance_m, "albedo")
    farthest_m = 20.0  # no board that fills the image stands farther: its distance is in another unit
    for one, distance in zip(frames, distance_m, strict=True):
        if len(one) != 1:
            raise UsageError(f"the frames at {distance:g} m must be of one position, got {len(one)}")
        if distance > farthest_m:
            raise UsageError(f"the board at {distance:g} m is farther than {farthest_m:g} m: distances are in metres")
        if one.n_frames < FEWEST_FRAMES:
            raise UsageError(
                f"too few frames at {distance:g} m: {one.n_frames}, but at least {FEWEST_FRAMES} are needed to know a "
                f"pixel's noise to {100 * PIXEL_STD_ERROR:.0f} %"
            )
    found = Findings()
    distance_std = known_distance_std(distance_m, distance_std_m, found.notes)
    data = BoardData.of(frames, distance_m, distance_std, albedos, base, found.notes)
    if albedo is None and base.kind == "phase":
        found.notes.append("The board's albedo was assumed to be 0.8: only signal_e times albedo was measured.")
    if not (data.used(data.variance_m2) > 0).any():
        raise UsageError("the frames have no noise: every range is the same in all of them; is one frame repeated?")
    correlation, correlation_error = data.frame_correlation()
    correlated_sigmas = 4.0
    if abs(correlation) > correlated_sigmas * correlation_error:
        found.notes.append(
            "Frames are not independent: the noise of a pixel correlates by "
            f"{with_error(correlation, correlation_error)} from one frame to the next, as behind a filter in time, or "
            "while something moved; standard errors allow for it, σ may be too small."
        )
    # the pixels that a flat field shows to be odd leave before anything is measured
    first = Findings()
    fit_offsets(data, first)
    odd = odd_pixels(data, pixel_offsets(data, first)[0])
    data = data.without(odd)
    fit_offsets(data, found)
    _refuse_other_quantity(data)
    _check_tilt(data, found)
    offset, offset_error = fit_pixels(data, odd, found)
    fit_light(data, amplitude_unit, found)
    fields = {**base.model_dump(), **{name: rounded(value) for name, value in found.fields.items()}}
    if base.kind == "phase":
        limit_contrast(fields, found)
    return SensorFit(
        Sensor(**fields),
        {name: found.estimates[name] for name in Sensor.model_fields if name in found.estimates},
        tuple(found.notes),
        offset,
        offset_error,
        np.sqrt(data.variance_m2),
        correlation,
        correlation_error,
        tuple(one.n_frames for one in frames),
        tuple(distance_std),
    )
