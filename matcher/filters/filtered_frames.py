"""Filtered frames: the result of a time filter for a camera at rest (PHYSICS section 6).

:func:`~phasemark.matcher.kalman_filter` and :func:`~phasemark.matcher.phasor_mean` make them of
:class:`~phasemark.render.Frames`, with the filter's own standard deviation. Neither removes mixing at edges: averaging
converges to the mixed range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.pooled_noise import median_scaled, moderated
from phasemark.render.phasor_images import PhasorImages, wrap_range_m
from phasemark.render.png import figure_png
from phasemark.render.sensor.range_noise import predicted_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.unwrapped_frames import unwrapped

_ARRAYS = ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective")
"""Fields of filtered frames with a number for each pixel."""
_OF_POSITIONS = ("time_s", "tilt_rad", "overdispersion")
"""Fields of filtered frames with a number, or two, for each position."""
_USUAL_LIMIT_RAD = 0.1
"""Phase noise where a frame does not know its own and the sensor allows no less."""
_LEAST_STD_M = 1e-4
"""Noise of a range below which no law is believed."""


class PixelState(IntEnum):
    """State of a filtered pixel (PHYSICS section 7)."""

    RETURN = 0
    """At least half of the usable frames are valid: the range counts."""
    NO_RETURN = 1
    """Most of the usable frames are below the threshold: nothing came back. This is data."""
    MISSING = 2
    """No frame is usable: the pixel says nothing."""


@dataclass(frozen=True, eq=False)
class FilteredFrames:
    """One filtered frame for each of n positions.

    Parameters
    ----------
    range_m : (n, rows, cols) float64
        Range in [0, c/2f); NaN unless the state is RETURN.
    std_m : (n, rows, cols) float64
        The filter's own standard deviation √P of that range; NaN unless the state is RETURN. Infinite where a single
        frame without amplitudes cannot tell its noise.
    amplitude_e, intensity_e : (n, rows, cols) float64, or None
        Mean amplitude and intensity of the valid frames, or where none is valid of the usable ones; electrons per phase
        image. NaN where the pixel is missing; None if the frames had none.
    state : (n, rows, cols) uint8
        :class:`PixelState`.
    n_effective : (n, rows, cols) float64
        How many frames the result is worth, R / P: the number of valid frames where every frame counts alike.
        0 unless the state is RETURN.
    sensor : Sensor
        The camera.
    std_from_scatter : bool
        True if `std_m` was estimated from the scatter of the frames themselves, with n − 1 degrees of freedom, rather
        than predicted from amplitude and intensity: tests then need F, not χ².
    overdispersion : (n,) float64, optional
        By how much χ² of each position scatters more than under noise of known size, where the scatter of its pixels
        together told that size, :meth:`with_pooled_noise`: a factor on the variance of χ², less 1.
    time_s : (n,) float64, optional
        Mean time stamp of the frames at each position, seconds.
    tilt_rad : (n, 2) float64, optional
        Mean pitch and roll of what the camera is mounted on (PHYSICS section 9), radians; None: level.
    by_frequency : tuple of FilteredFrames
        What each of several modulation frequencies measured alone, its range wrapped at c / 2f; `range_m` is then
        unwrapped from these, `std_m` is that of the unwrapped range, and amplitude and intensity are those of the first
        frequency. Empty for one frequency, and where the frequencies were unwrapped before they were filtered.

    Raises
    ------
    UsageError
        The shapes do not agree with each other or with the sensor.
    """

    range_m: NDArray[np.float64]
    std_m: NDArray[np.float64]
    amplitude_e: NDArray[np.float64] | None
    intensity_e: NDArray[np.float64] | None
    state: NDArray[np.uint8]
    n_effective: NDArray[np.float64]
    sensor: Sensor
    std_from_scatter: bool = False
    overdispersion: NDArray[np.float64] | None = None
    time_s: NDArray[np.float64] | None = None
    tilt_rad: NDArray[np.float64] | None = None
    by_frequency: tuple[FilteredFrames, ...] = ()

    def __post_init__(self) -> None:
        shape = (len(self.range_m), self.sensor.rows, self.sensor.cols)
        for name in _ARRAYS:
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise UsageError(f"'{name}' must have shape (n, rows, cols) = {shape}, got {array.shape}")
        if self.tilts_rad.shape != (shape[0], 2):
            raise UsageError(f"'tilt_rad' must have shape (n, 2) = {(shape[0], 2)}, got {self.tilts_rad.shape}")

    @property
    def tilts_rad(self) -> NDArray[np.float64]:
        """Pitch and roll of each position, (n, 2); 0 where frames state none."""
        return np.zeros((len(self), 2)) if self.tilt_rad is None else self.tilt_rad

    def __repr__(self) -> str:
        """Describe in one line how many frames there are, and the camera."""
        return f"FilteredFrames({len(self)} positions, {self.sensor!r})"

    def __len__(self) -> int:
        return len(self.range_m)

    def __getitem__(
        self, index: int | slice | Sequence[int] | NDArray[np.integer] | NDArray[np.bool_]
    ) -> FilteredFrames:
        """Return some of the positions; one position is still a batch, of one."""
        rows = index if isinstance(index, slice) else np.atleast_1d(index)
        told = {name: array[rows] for name in _OF_POSITIONS if (array := getattr(self, name)) is not None}
        return self.with_arrays(
            lambda array: array[rows],
            **told,
            by_frequency=tuple(part[index] for part in self.by_frequency),
        )

    def __iter__(self) -> Iterator[FilteredFrames]:
        """Go through the positions, each a batch of one."""
        return (self[k] for k in range(len(self)))

    @classmethod
    def joined(cls, parts: Sequence[FilteredFrames]) -> FilteredFrames:
        """Return the positions of several batches of one camera as one, without what each frequency measured.

        A field that one of them lacks all lack; noise is from the scatter of the frames if that of any is.
        """
        joined: dict[str, Any] = {}
        for name in (*_ARRAYS, *_OF_POSITIONS):
            arrays = [getattr(part, name) for part in parts]
            joined[name] = None if any(array is None for array in arrays) else np.concatenate(arrays)
        joined["std_from_scatter"] = any(part.std_from_scatter for part in parts)
        return replace(parts[0], by_frequency=(), **joined)

    def with_pixels(self, move: Callable[[NDArray[Any]], NDArray[Any]]) -> FilteredFrames:
        """Return the frames with their pixels elsewhere: mirrored or turned images of the same camera."""
        parts = tuple(part.with_pixels(move) for part in self.by_frequency)
        return self.with_arrays(lambda array: np.ascontiguousarray(move(array)), by_frequency=parts)

    def with_arrays(self, change: Callable[[NDArray[Any]], NDArray[Any]], **fields: Any) -> FilteredFrames:
        """Return the frames with every array of pixels changed in one way, and with other fields replaced."""
        for name in _ARRAYS:
            if (array := getattr(self, name)) is not None:
                fields[name] = change(array)
        return replace(self, **fields)

    def without_offset(self) -> FilteredFrames:
        """Return the frames with the sensor's offsets of range and zones taken off, of the same sensor without them."""
        sensor = self.sensor
        if sensor.range_offset_m == 0 and not sensor.zone_offset_m:
            return self
        corrected = wrap_range_m(self.range_m - (sensor.range_offset_m + sensor.zone_offsets), sensor)
        return replace(
            self,
            range_m=corrected,
            sensor=sensor.with_(range_offset_m=0.0, zone_offset_m=()),
            by_frequency=tuple(part.without_offset() for part in self.by_frequency),
        )

    @property
    def pattern_m(self) -> float:
        """Standard deviation of the fixed pattern that the sensor states, metres.

        Offsets of the two taps of a pixel turn its phase by their mean.
        """
        sensor = self.sensor
        of_pixel_rad, of_tap_rad = sensor.phase_offset_std_rad, sensor.tap_phase_offset_std_rad
        return sensor.range_per_phase_noise_m * math.hypot(of_pixel_rad, of_tap_rad / math.sqrt(2))

    def with_fixed_pattern(self) -> FilteredFrames:
        """Return frames whose noise holds the fixed pattern that their sensor states, which no mean lessens."""
        if not self.pattern_m:
            return self
        parts = tuple(part.with_fixed_pattern() for part in self.by_frequency)
        std_m = np.hypot(self.std_m, self.pattern_m)
        share = np.divide(self.std_m, std_m, out=np.ones(std_m.shape), where=np.isfinite(std_m)) ** 2
        told = share[self.n_effective > 0]
        scattered = self.std_from_scatter and told.size > 0 and float(np.median(told)) > 0.5  # the rest is known
        return replace(
            self, std_m=std_m, n_effective=self.n_effective * share, std_from_scatter=scattered, by_frequency=parts
        )

    @property
    def chip_error_m(self) -> float:
        """Error of a chip's target beside its noise, metres: rounding, and what it makes of a surface that bends."""
        chip_error_bins = 0.03  # rounding to millimetres, and what stands beside, or bends within, a zone
        return 0.0 if self.sensor.histogram is None else chip_error_bins * self.sensor.histogram.bin_width_m

    def with_chip_error(self) -> FilteredFrames:
        """Return reported ranges with what the chip's estimator leaves beside their noise, which no mean lessens."""
        if not self.chip_error_m or not self.n_effective.max(initial=0.0) > 1:
            return self
        return replace(self, std_m=np.hypot(self.std_m, self.chip_error_m))

    def with_pooled_noise(self, light: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None) -> FilteredFrames:
        """Return frames whose scatter alone tells their noise with what the scatter of all pixels together says of it.

        The scatter of a few frames in one pixel is a poor measure of its noise. The law of the sensor says how the
        noise of the pixels compares, and all of them together how large it is: for a direct sensor by the median of
        scatter over law, for a phase camera, whose light the law has to guess, pixel by pixel as far as it guesses
        well. A single frame has the noise of the law.

        Parameters
        ----------
        light : (amplitude, intensity) of (n, rows, cols) float64, optional
            Light of a model, relative to an albedo of 1 that faces the camera at 1 m; of no amplitude where it has
            none. None: a surface of albedo 0.8 that faces the camera in every pixel.
        """
        if not self.std_from_scatter:
            return self
        if self.by_frequency:  # ranges are unwrapped by the noise of each frequency
            parts = [part.with_pooled_noise(light) for part in self.by_frequency]
            more = [part.overdispersion for part in parts if part.overdispersion is not None]
            whole = unwrap_filtered(parts, self.sensor)
            return replace(
                whole,
                time_s=self.time_s,
                tilt_rad=self.tilt_rad,
                std_from_scatter=any(part.std_from_scatter for part in parts),
                overdispersion=np.max(more, axis=0) if more else None,
            )
        n, range_m = self.n_effective, np.nan_to_num(self.range_m, nan=1.0)
        law = assumed_std_m(range_m, self.sensor)
        if light is not None:
            lit = predicted_range_std(*light, self.sensor)
            law = np.where(np.isfinite(lit), np.maximum(lit, _LEAST_STD_M), law)
        told = np.isfinite(self.std_m) & (n > 0)
        variance = np.where(told, self.std_m**2 * n, 0.0)
        pool = median_scaled if self.sensor.kind == "direct" else moderated
        flat = (array.reshape(len(self), -1) for array in (variance, np.where(told, n - 1, 0.0), law**2))
        pooled, overdispersion = pool(*flat)
        std = np.sqrt(pooled.reshape(n.shape) / np.maximum(n, 1.0))
        return replace(
            self,
            std_m=np.where(n > 0, std, np.nan),
            std_from_scatter=False,
            overdispersion=overdispersion,
        )

    def _repr_png_(self) -> bytes | None:
        """Show range and standard deviation of the first position in a notebook; nothing where there is none."""
        from phasemark.matcher.filters.figures import filtered_figure  # matplotlib takes half a second to load

        return figure_png(filtered_figure(self.range_m[0], self.std_m[0])) if len(self) else None


def unwrap_filtered(parts: Sequence[FilteredFrames], sensor: Sensor) -> FilteredFrames:
    """Return filtered frames of several modulation frequencies from those of each (PHYSICS section 10).

    The ranges are unwrapped after they were filtered, with the variances of the filter: what one frame leaves open many
    may decide. A pixel returns where every frequency does and these agree beyond doubt; it is *no return* where none
    does, and *missing* elsewhere: a mixed pixel has no one range.

    Parameters
    ----------
    parts : sequence of FilteredFrames
        Of each of ``sensor.by_frequency``, in this order.
    sensor : Sensor

    Returns
    -------
    FilteredFrames
        `n_effective` is the least of the frequencies'.
    """
    unknown = (sensor.max_phase_std_rad or _USUAL_LIMIT_RAD) * np.array(
        [part.sensor.metres_per_radian for part in parts]
    )
    std = [np.where(np.isfinite(part.std_m), part.std_m, limit) for part, limit in zip(parts, unknown, strict=True)]
    found = unwrapped([part.range_m for part in parts], std, sensor)
    states = np.stack([part.state for part in parts])
    returned = (states == PixelState.RETURN).all(axis=0) & found.consistent
    dark = (states == PixelState.NO_RETURN).all(axis=0)
    known = returned & np.all([np.isfinite(part.std_m) for part in parts], axis=0)
    least = np.min([part.n_effective for part in parts], axis=0)
    return replace(
        parts[0],
        range_m=np.where(returned, found.range_m, np.nan),
        std_m=np.where(known, found.std_m, np.where(returned, np.inf, np.nan)),
        state=np.where(returned, PixelState.RETURN, np.where(dark, PixelState.NO_RETURN, PixelState.MISSING)).astype(
            np.uint8
        ),
        n_effective=np.where(returned, least, 0.0),
        sensor=sensor,
        by_frequency=tuple(parts),
    )


def assumed_std_m(range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return the one-frame noise of a surface of albedo 0.8 that faces the camera at a range, metres."""
    amplitude = 0.8 / np.maximum(range_m, 1e-3) ** 2
    return np.maximum(predicted_range_std(amplitude, amplitude, sensor), _LEAST_STD_M)


def noise_free(images: PhasorImages, n_frames: float, returned: NDArray[np.bool_] | None = None) -> FilteredFrames:
    """Return what filtering frames would give if their noise had no effect: exact ranges, honest variances.

    Parameters
    ----------
    images : PhasorImages
        n views.
    n_frames : float
        How many frames' noise `std_m` is.
    returned : (n, rows, cols) bool, optional
        Which pixels return. None: where the noise law says that most single frames pass the sensor's threshold
        `max_phase_std_rad`.

    Returns
    -------
    FilteredFrames
        `std_m` is the noise law's (PHYSICS section 4) over √n_frames.
    """
    sensor = images.sensor
    if len(sensor.frequencies_hz) > 1:
        return unwrap_filtered([noise_free(part, n_frames, returned) for part in images.by_frequency], sensor)
    std = predicted_range_std(images.amplitude, images.intensity, sensor)
    limit = math.inf if sensor.max_phase_std_rad is None else sensor.max_phase_std_rad * sensor.metres_per_radian
    if returned is None:
        returned = (images.amplitude > 0) & (std <= limit)
    return FilteredFrames(
        range_m=np.where(returned, images.range_m, np.nan),
        std_m=np.where(returned, std / math.sqrt(n_frames), np.nan),
        amplitude_e=None,
        intensity_e=None,
        state=np.where(returned, PixelState.RETURN, PixelState.NO_RETURN).astype(np.uint8),
        n_effective=np.where(returned, float(n_frames), 0.0),
        sensor=sensor,
    )
