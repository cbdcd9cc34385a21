"""Counts and sums over the frames of each pixel, which every filter needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState, unwrap_filtered
from phasemark.matcher.filters.loops import add_up, count
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import wrap_difference_m, wrap_range_m
from phasemark.render.sensor.range_noise import measured_range_std

_Number = TypeVar("_Number", bound=np.generic)
_SUMMED = ("amplitude_e", "intensity_e")


class PixelSums:
    """Counts and sums over the frames of each pixel: all that state, amplitude and R need.

    Parameters
    ----------
    frames : Frames
        The first frames; :meth:`add` takes in further ones.
    scatter : bool
        Whether to find the scatter of the ranges where the noise law cannot be evaluated.

    Attributes
    ----------
    n_valid, n_usable : (n, rows, cols) int64
        Frames that are valid, and that say anything.

    Raises
    ------
    UsageError
        There is no frame.
    """

    def __init__(self, frames: Frames, *, scatter: bool = False) -> None:
        if frames.n_frames == 0:
            raise UsageError("there is no frame to filter")
        shape = (len(frames), *frames.range_m.shape[2:])
        self.sensor = frames.sensor
        self.n_valid, self.n_usable = (np.zeros(shape, np.int64) for _ in range(2))
        # by quantity: the sum over valid frames, that over finite values of usable but invalid ones, and their number
        self._sums = {
            name: (np.zeros(shape), np.zeros(shape), np.zeros(shape, np.int64))
            for name in _SUMMED
            if getattr(frames, name) is not None
        }
        self._has_law = len(self._sums) == len(_SUMMED) and len(self.sensor.frequencies_hz) == 1
        self._has_scatter = scatter and not self._has_law
        self._mean_m, self._squares_m2 = np.zeros(shape), np.zeros(shape)
        self.add(frames)

    def add(self, frames: Frames) -> None:
        """Take in further frames.

        Raises
        ------
        UsageError
            They are of another number of positions, or have an amplitude or intensity where the others had none.
        """
        if len(frames) != len(self.n_valid):
            raise UsageError(f"the frame has {len(frames)} positions, but the ones before have {len(self.n_valid)}")
        for name in _SUMMED:
            if (name in self._sums) != (getattr(frames, name) is not None):
                given, missing = ("ones before", "frame") if name in self._sums else ("frame", "ones before")
                raise UsageError(
                    f"'{name}' must come with every frame or none: given with the {given}, not with the {missing}"
                )
        if self._has_scatter:
            self._add_scatter(frames)
        flags = pixels_of_frames(frames.flags)
        count(flags, pixels(self.n_valid), pixels(self.n_usable))
        for name, sums in self._sums.items():
            add_up(pixels_of_frames(getattr(frames, name)), flags, *map(pixels, sums))

    def mean(self, name: str) -> NDArray[np.float64] | None:
        """Return the mean of a quantity over valid frames, or else over the others; NaN where there is neither.

        None where the frames have none.
        """
        if name not in self._sums:
            return None
        valid, other, n_other = self._sums[name]
        total = np.where(self.n_valid > 0, valid, other)
        number = np.where(self.n_valid > 0, self.n_valid, n_other)
        return np.asarray(np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0))

    def variance_m2(self) -> NDArray[np.float64]:
        """Return R of one frame by the noise law.

        Without amplitude or intensity of what the range is made of it is the sample variance of the ranges, infinite
        with fewer than two frames.
        """
        amplitude_e, intensity_e = self.mean("amplitude_e"), self.mean("intensity_e")
        if self._has_law and amplitude_e is not None and intensity_e is not None:
            return measured_range_std(amplitude_e, intensity_e, self.sensor) ** 2
        variance = np.full(self._squares_m2.shape, np.inf)
        np.divide(self._squares_m2, self.n_valid - 1, out=variance, where=self.n_valid > 1)
        return variance

    def _add_scatter(self, frames: Frames) -> None:
        """Take on mean and sum of squares of the wrapped ranges of valid frames (Welford's recurrence)."""
        n = self.n_valid
        for range_m, valid in in_time(frames):
            n = n + valid
            step = wrap_difference_m(np.where(valid, range_m - self._mean_m, 0.0), self.sensor)
            share = 1.0 / np.maximum(n, 1)
            self._mean_m = self._mean_m + share * step
            self._squares_m2 = self._squares_m2 + (1.0 - share) * step**2

    def filtered(
        self,
        range_m: NDArray[np.float64],
        std_m: NDArray[np.float64],
        n_effective: NDArray[np.float64],
        coherent_amplitude_e: NDArray[np.float64] | None = None,
    ) -> FilteredFrames:
        """Return filtered frames of these ranges, (n, rows, cols), with state, amplitude and intensity.

        A pixel that says something less than a quarter as often as the one that does most often is missing: the few
        frames of it are those in which noise passed a threshold.
        """
        most = self.n_usable.max(axis=(1, 2), keepdims=True)
        usable = (self.n_usable > 0) & (4 * self.n_usable >= most)
        returned = usable & (2 * self.n_valid >= self.n_usable)
        state = np.where(returned, PixelState.RETURN, np.where(usable, PixelState.NO_RETURN, PixelState.MISSING))
        amplitude_e = self.mean("amplitude_e")
        if coherent_amplitude_e is not None and amplitude_e is not None:
            amplitude_e = np.where(self.n_valid > 0, coherent_amplitude_e, amplitude_e)
        return FilteredFrames(
            range_m=np.where(returned, wrap_range_m(range_m, self.sensor), np.nan),
            std_m=np.where(returned, std_m, np.nan),
            amplitude_e=amplitude_e,
            intensity_e=self.mean("intensity_e"),
            state=state.astype(np.uint8),
            n_effective=np.where(returned, n_effective, 0.0),
            sensor=self.sensor,
            std_from_scatter=not self._has_law,
        )


def filter_each(frames: Frames, filter_one: Callable[[Frames], FilteredFrames]) -> FilteredFrames:
    """Filter the frames of each modulation frequency, and unwrap what comes of it."""
    return unwrap_filtered([filter_one(part) for part in frames.by_frequency], frames.sensor)


def timed(filtered: FilteredFrames, frames: Frames) -> FilteredFrames:
    """Give filtered frames the mean time stamp and tilt of the frames they were made of."""
    time_s, tilt_rad = (None if own is None else own.mean(axis=1) for own in (frames.time_s, frames.tilt_rad))
    return replace(filtered, time_s=time_s, tilt_rad=tilt_rad)


def pixels(image: NDArray[_Number]) -> NDArray[_Number]:
    """Return (n, rows, cols) as the compiled loops take it, (n, pixels)."""
    return image.reshape(len(image), math.prod(image.shape[1:]))


def pixels_of_frames(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return (n, frames, rows, cols) as the compiled loops take it, (n, frames, pixels)."""
    return np.ascontiguousarray(values).reshape(*values.shape[:2], math.prod(values.shape[2:]))


def in_time(frames: Frames) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Yield range and validity frame by frame, each (n, rows, cols)."""
    valid = frames.valid
    for k in range(frames.n_frames):
        yield frames.range_m[:, k], valid[:, k]
