"""Time filters for a camera at rest: the paper's Kalman filter and the mean phasor (PHYSICS section 6).

Both take :class:`~phasemark.render.Frames` and give :class:`FilteredFrames`, which carry the filter's own standard
deviation. Neither removes mixing at edges: averaging converges to the mixed range.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.filters.loops import add_up, count, follow
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import PhasorImages, phasor_to_range_m, wrap_difference_m, wrap_range_m
from phasemark.render.png import figure_png
from phasemark.render.sensor.range_noise import measured_range_std, predicted_range_std
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.unwrapped_frames import unwrapped

if TYPE_CHECKING:
    pass

_Number = TypeVar("_Number", bound=np.generic)

_USUAL_LIMIT_RAD = 0.1
"""Phase noise where a frame does not know its own and the sensor allows no less."""
_CHIP_ERROR_BINS = 0.03
"""Error of a chip's target, in bins: rounding to millimetres, and what its estimator makes of a surface that bends
within a zone, or of things beside it."""
_LEAST_POOLED = 1e-4
"""Least variance over that of the law; frames without any scatter are simulated, or frozen."""


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
    time_s : (n,) float64, optional
        Mean time stamp of the frames at each position, seconds.
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
    time_s: NDArray[np.float64] | None = None
    by_frequency: tuple[FilteredFrames, ...] = ()

    def __post_init__(self) -> None:
        shape = (len(self.range_m), self.sensor.rows, self.sensor.cols)
        for name in ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective"):
            array = getattr(self, name)
            if array is not None and array.shape != shape:
                raise UsageError(f"'{name}' must have shape (n, rows, cols) = {shape}, got {array.shape}")

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
        return FilteredFrames(
            self.range_m[rows],
            self.std_m[rows],
            None if self.amplitude_e is None else self.amplitude_e[rows],
            None if self.intensity_e is None else self.intensity_e[rows],
            self.state[rows],
            self.n_effective[rows],
            self.sensor,
            self.std_from_scatter,
            None if self.time_s is None else self.time_s[rows],
            tuple(part[index] for part in self.by_frequency),
        )

    def __iter__(self) -> Iterator[FilteredFrames]:
        """Go through the positions, each a batch of one."""
        return (self[k] for k in range(len(self)))

    def with_pixels(self, move: Callable[[NDArray[Any]], NDArray[Any]]) -> FilteredFrames:
        """Return the frames with their pixels elsewhere: mirrored or turned images of the same camera."""
        moved: dict[str, Any] = {
            name: np.ascontiguousarray(move(array))
            for name in ("range_m", "std_m", "amplitude_e", "intensity_e", "state", "n_effective")
            if (array := getattr(self, name)) is not None
        }
        return replace(self, by_frequency=tuple(part.with_pixels(move) for part in self.by_frequency), **moved)

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

    def with_chip_error(self) -> FilteredFrames:
        """Return reported ranges with what the chip's estimator leaves beside their noise, which no mean lessens."""
        histogram = self.sensor.histogram
        if histogram is None or not self.n_effective.max(initial=0.0) > 1:
            return self
        return replace(self, std_m=np.hypot(self.std_m, _CHIP_ERROR_BINS * histogram.bin_width_m))

    def with_pooled_noise(self) -> FilteredFrames:
        """Return the frames of a direct sensor with the noise of its law, scaled to the scatter of all pixels together.

        The scatter of a few frames in one pixel is a poor measure of its noise. The law (`range_std_m` and its
        neighbours in :class:`~phasemark.render.Sensor`) says how the noise of the pixels compares; the median over the
        pixels of a position of scatter over law says how large it is. A single frame has the noise of the law.
        """
        if self.sensor.kind != "direct" or not self.std_from_scatter:
            return self
        from scipy import special  # takes a fifth of a second

        law = assumed_std_m(np.nan_to_num(self.range_m, nan=1.0), self.sensor)
        n = self.n_effective
        ratio = np.divide(self.std_m**2 * n, law**2, out=np.full(n.shape, np.nan), where=(n > 1.5) & (law > 0))
        scale = np.ones((len(self), 1, 1))
        for k in np.flatnonzero(np.isfinite(ratio).any(axis=(1, 2))):
            scattered = np.isfinite(ratio[k])
            freedom = float(np.median(n[k][scattered])) - 1
            usual = float(special.chdtri(freedom, 0.5)) / freedom
            scale[k] = float(np.median(ratio[k][scattered])) / usual
        std = np.sqrt(np.maximum(scale, _LEAST_POOLED)) * law / np.sqrt(np.maximum(n, 1.0))
        return replace(self, std_m=np.where(n > 0, std, np.nan), std_from_scatter=False)

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


def _filter_each(frames: Frames, filter_one: Callable[[Frames], FilteredFrames]) -> FilteredFrames:
    """Filter the frames of each modulation frequency, and unwrap what comes of it."""
    return unwrap_filtered([filter_one(part) for part in frames.by_frequency], frames.sensor)


def assumed_std_m(range_m: NDArray[np.float64], sensor: Sensor) -> NDArray[np.float64]:
    """Return the one-frame noise of a surface of albedo 0.8 that faces the camera at a range, metres."""
    amplitude = 0.8 / np.maximum(range_m, 1e-3) ** 2
    return np.maximum(predicted_range_std(amplitude, amplitude, sensor), 1e-4)


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


def kalman_step(
    x: ArrayLike,
    P: ArrayLike,
    z: ArrayLike,
    *,
    A: ArrayLike,
    H: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    B: ArrayLike | None = None,
    u: ArrayLike | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Run one step of the discrete Kalman filter, equations (1)–(5) of the paper.

    Predict  x⁻ = A x + B u (1),  P⁻ = A P Aᵀ + Q (2);
    update   K = P⁻Hᵀ (H P⁻ Hᵀ + R)⁻¹ (3),  x = x⁻ + K (z − H x⁻) (4),  P = (1 − K H) P⁻ (5).

    The last is computed as (1 − KH) P⁻ (1 − KH)ᵀ + K R Kᵀ, which is the same for this gain and stays symmetric and
    positive in floating point.

    Parameters
    ----------
    x : (s,) array_like
        State after the step before.
    P : (s, s) array_like
        Its covariance.
    z : (m,) array_like
        Measurement.
    A, H : (s, s) and (m, s) array_like
        Transition and output matrix.
    Q, R : (s, s) and (m, m) array_like
        Covariance of process and measurement noise.
    B, u : (s, c) and (c,) array_like, optional
        Control matrix and input; both or neither.

    Returns
    -------
    x : (s,) ndarray
        State after the measurement.
    P : (s, s) ndarray
        Its covariance.

    Raises
    ------
    UsageError
        The shapes do not fit, only one of B and u is given, or H P⁻ Hᵀ + R is singular.
    """
    x, z = np.asarray(x, dtype=np.float64), np.asarray(z, dtype=np.float64)
    if x.ndim != 1 or z.ndim != 1:
        raise UsageError(f"'x' and 'z' must be vectors, got shapes {x.shape} and {z.shape}")
    n_state, n_measured = len(x), len(z)
    P = _matrix("P", P, (n_state, n_state))
    A = _matrix("A", A, (n_state, n_state))
    H = _matrix("H", H, (n_measured, n_state))
    Q = _matrix("Q", Q, (n_state, n_state))
    R = _matrix("R", R, (n_measured, n_measured))
    if (B is None) != (u is None):
        raise UsageError("'B' and 'u' go together: give both or neither")
    x_prior = A @ x
    if B is not None and u is not None:
        control = np.asarray(u, dtype=np.float64)
        if control.ndim != 1:
            raise UsageError(f"'u' must be a vector, got shape {control.shape}")
        x_prior = x_prior + _matrix("B", B, (n_state, len(control))) @ control
    P_prior = A @ P @ A.T + Q
    try:
        gain = np.linalg.solve(H @ P_prior @ H.T + R, H @ P_prior).T
    except np.linalg.LinAlgError:
        raise UsageError("H P Hᵀ + R is singular: the measurement noise 'R' must be positive definite") from None
    rest = np.eye(n_state) - gain @ H
    return x_prior + gain @ (z - H @ x_prior), rest @ P_prior @ rest.T + gain @ R @ gain.T


def kalman(
    x0: ArrayLike,
    P0: ArrayLike,
    z: ArrayLike,
    *,
    A: ArrayLike,
    H: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    B: ArrayLike | None = None,
    u: ArrayLike | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Filter a series of measurements with :func:`kalman_step`.

    Parameters
    ----------
    x0, P0 : (s,) and (s, s) array_like
        State and covariance before the first measurement.
    z : (k, m) array_like
        Measurements in the order of time.
    A, H, Q, R, B : array_like
        As in :func:`kalman_step`, constant over the series.
    u : (k, c) array_like, optional
        Control input of each step.

    Returns
    -------
    x : (k, s) ndarray
        State after each measurement.
    P : (k, s, s) ndarray
        Its covariance.

    Raises
    ------
    UsageError
        As :func:`kalman_step`; or `z` or `u` is not a series, or they differ in length.

    Examples
    --------
    The running mean of a constant:

    >>> x, P = kalman([2.0], [[1.0]], [[4.0], [6.0]], A=[[1.0]], H=[[1.0]], Q=[[0.0]], R=[[1.0]])
    >>> x.ravel().tolist(), P.ravel().round(3).tolist()
    ([3.0, 4.0], [0.5, 0.333])
    """
    series = np.asarray(z, dtype=np.float64)
    if series.ndim != 2:
        raise UsageError(f"'z' must have shape (steps, m), got {series.shape}")
    controls = None if u is None else np.asarray(u, dtype=np.float64)
    if controls is not None and (controls.ndim != 2 or len(controls) != len(series)):
        raise UsageError(
            f"'u' must have shape ({len(series)}, c), one input for each measurement, got {controls.shape}"
        )
    state = np.asarray(x0, dtype=np.float64)
    covariance = np.asarray(P0, dtype=np.float64)
    states, covariances = [], []
    for k, measured in enumerate(series):
        control = None if controls is None else controls[k]
        state, covariance = kalman_step(state, covariance, measured, A=A, H=H, Q=Q, R=R, B=B, u=control)
        states.append(state)
        covariances.append(covariance)
    size = len(state)
    return np.reshape(states, (-1, size)), np.reshape(covariances, (-1, size, size))


def kalman_filter(frames: Frames, process_var_m2: float = 0.0) -> FilteredFrames:
    """Filter every pixel of frames of a still scene with the paper's scalar Kalman filter (PHYSICS section 6).

    A = 1, B = 0, H = 1. The first valid frame starts the filter with x = z, P = R; innovations are wrapped to ± c/4f.
    An invalid frame brings no measurement: x stays and P grows by Q. With Q = 0 this is the running mean of the valid
    frames, with P = R / n_valid.

    R is one value per pixel: the noise law at the mean amplitude_e and intensity_e of its valid frames; or, if the
    frames have no amplitude or no intensity, the sample variance of their wrapped ranges. One frame has no sample
    variance: there R, and so the standard deviation, is infinite.

    Parameters
    ----------
    frames : Frames
        (n, frames, rows, cols).
    process_var_m2 : float
        Q, the variance in m² by which the range may wander from one frame to the next. On a still scene Q > 0 makes P
        overstate the error.

    Returns
    -------
    FilteredFrames

    Raises
    ------
    UsageError
        `process_var_m2` is negative or not finite, or there is no frame.
    """
    _check_process_variance(process_var_m2)
    if len(frames.by_frequency) > 1:
        return _filter_each(frames, lambda part: kalman_filter(part, process_var_m2))
    tally = _Tally.of(frames)
    measurement_var = tally.law_variance_m2()
    if measurement_var is None:
        scatter = _Scatter.empty(tally.n_valid.shape, frames.sensor)
        for range_m, valid in _in_time(frames):
            scatter.add(range_m, valid)
        measurement_var = scatter.variance_m2()
    measurement_var = _floored(measurement_var, process_var_m2)
    track = _Track.empty(tally.n_valid.shape, frames.sensor)
    track.follow(frames, process_var_m2, measurement_var)
    filtered = _result(tally, track.range_m, np.sqrt(track.scaled_var * measurement_var), track.n_effective())
    return _timed(filtered, frames)


def phasor_mean(frames: Frames) -> FilteredFrames:
    """Average the phasors amplitude_e · exp(iφ) of every pixel coherently (PHYSICS section 6).

    Better than a mean of ranges at low signal, where a weak frame's phase is worth less, and near the wrap. Frames
    without amplitude average unit phasors. A frame below the validity threshold has no range and so no phase: only
    valid frames enter. To use every frame at low signal, capture with ``max_phase_std_rad=None``.

    The variance of the range is the noise law at the amplitude of the mean phasor and the mean intensity, over n_valid;
    or, if the frames have no amplitude or no intensity, the scatter of the phasors across their mean's direction,
    over n_valid (n_valid − 1), infinite for one frame.

    Parameters
    ----------
    frames : Frames
        (n, frames, rows, cols).

    Returns
    -------
    FilteredFrames
        Its amplitude_e is that of the mean phasor, which unlike the mean amplitude carries no bias from noise, where a
        frame is valid.

    Raises
    ------
    UsageError
        There is no frame.
    """
    if len(frames.by_frequency) > 1:
        return _filter_each(frames, phasor_mean)
    if not frames.by_frequency:
        raise UsageError(
            "the frames hold unwrapped ranges alone, and a mean of phasors takes what each modulation frequency"
            " measured: filter them with kalman_filter"
        )
    tally = _Tally.of(frames)
    n_valid = tally.n_valid
    mean = np.zeros(n_valid.shape, dtype=np.complex128)
    for phasor in _phasors_in_time(frames):
        mean += phasor
    mean /= np.maximum(n_valid, 1)
    amplitude = np.abs(mean)
    intensity_e = tally.mean_intensity_e()
    std_m = np.full(n_valid.shape, np.inf)
    if frames.amplitude_e is not None and intensity_e is not None:
        law = measured_range_std(amplitude, intensity_e, frames.sensor)
        np.divide(law, np.sqrt(n_valid), out=std_m, where=n_valid > 0)
    else:
        direction = np.divide(mean, amplitude, out=np.ones_like(mean), where=amplitude > 0)
        squares = np.zeros(n_valid.shape)
        for phasor in _phasors_in_time(frames):
            squares += (phasor * direction.conj()).imag ** 2
        across = np.sqrt(squares) * frames.sensor.metres_per_radian
        scale = amplitude * np.sqrt(n_valid * (n_valid - 1.0))
        np.divide(across, scale, out=std_m, where=scale > 0)
    coherent = None if frames.amplitude_e is None else amplitude
    filtered = _result(tally, phasor_to_range_m(mean, frames.sensor), std_m, n_valid.astype(np.float64), coherent)
    return _timed(filtered, frames)


class PixelKalman:
    """The filter of :func:`kalman_filter` for frames that come one at a time.

    R is evaluated from the mean amplitude and intensity, or the sample variance, of the frames so far. With Q = 0 the
    gain does not depend on R, and after the same frames the result is that of :func:`kalman_filter`. With Q > 0 the
    early gains used an R of few frames, and the two agree only once R has settled.

    Parameters
    ----------
    sensor : Sensor
        The camera that takes the frames.
    process_var_m2 : float
        Q, m² from one frame to the next.

    Raises
    ------
    UsageError
        `process_var_m2` is negative or not finite.
    """

    def __init__(self, sensor: Sensor, process_var_m2: float = 0.0) -> None:
        _check_process_variance(process_var_m2)
        self._sensor = sensor
        self._process_var_m2 = process_var_m2
        self._tally: _Tally | None = None
        self._each: tuple[PixelKalman, ...] = ()
        self._scatter: _Scatter
        self._track: _Track

    def update(self, frame: Frames) -> None:
        """Take in the next frame.

        Parameters
        ----------
        frame : Frames
            One frame of one or more positions, the same number each time: (n, 1, rows, cols).

        Raises
        ------
        UsageError
            More than one frame a position, or a frame unlike the ones before: another sensor, another number of
            positions, or with amplitude where they had none.
        """
        if frame.n_frames != 1:
            raise UsageError(f"update() takes one frame at a time, got {frame.n_frames}: kalman_filter takes many")
        if frame.sensor != self._sensor:
            raise UsageError("the frame was taken by another sensor than the filter's")
        if len(frame.by_frequency) > 1:
            self._update_each(frame)
            return
        if self._each:
            raise UsageError("the frame holds an unwrapped range alone, the ones before what each frequency measured")
        news = _Tally.of(frame)
        if self._tally is None:
            self._tally = news
            self._scatter = _Scatter.empty(news.n_valid.shape, self._sensor)
            self._track = _Track.empty(news.n_valid.shape, self._sensor)
        else:
            self._tally = self._tally.plus(news)
        self._scatter.add(frame.range_m[:, 0], frame.valid[:, 0])
        self._track.follow(frame, self._process_var_m2, self._measurement_var_m2(self._tally))

    def _update_each(self, frame: Frames) -> None:
        """Take in what each modulation frequency measured."""
        if self._tally is not None:
            raise UsageError("the frame holds what each frequency measured, the ones before an unwrapped range alone")
        if not self._each:
            self._each = tuple(PixelKalman(camera, self._process_var_m2) for camera in self._sensor.by_frequency)
        for one, part in zip(self._each, frame.by_frequency, strict=True):
            one.update(part)

    def result(self) -> FilteredFrames:
        """Return the filtered frame as of now.

        Raises
        ------
        UsageError
            There was no frame yet.
        """
        if self._each:
            return unwrap_filtered([one.result() for one in self._each], self._sensor)
        if self._tally is None:
            raise UsageError("no frame to filter: call update() first")
        std_m = np.sqrt(self._track.scaled_var * self._measurement_var_m2(self._tally))
        return _result(self._tally, self._track.range_m, std_m, self._track.n_effective())

    def _measurement_var_m2(self, tally: _Tally) -> NDArray[np.float64]:
        law = tally.law_variance_m2()
        return _floored(self._scatter.variance_m2() if law is None else law, self._process_var_m2)


@dataclass
class _Track:
    """State of the scalar filters, one per pixel, with P in units of R.

    With Q = 0 no R enters: R = 0 (noise switched off) and R = ∞ (not known yet) still give the running mean.
    """

    range_m: NDArray[np.float64]
    scaled_var: NDArray[np.float64]  # p = P/R; NaN before the first valid frame
    sensor: Sensor

    @classmethod
    def empty(cls, shape: tuple[int, ...], sensor: Sensor) -> _Track:
        return cls(np.full(shape, np.nan), np.full(shape, np.nan), sensor)

    def follow(self, frames: Frames, process_var_m2: float, measurement_var_m2: NDArray[np.float64]) -> None:
        """Take in the next frames."""
        self.range_m, self.scaled_var = self.range_m.copy(), self.scaled_var.copy()  # results may hold the old ones
        follow(
            _pixels_of_frames(frames.range_m), _pixels_of_frames(frames.flags), self.sensor.unambiguous_range_m,
            process_var_m2, _pixels(measurement_var_m2), _pixels(self.range_m), _pixels(self.scaled_var),
        )  # fmt: skip

    def n_effective(self) -> NDArray[np.float64]:
        return 1.0 / self.scaled_var


@dataclass
class _Scatter:
    """Running mean and sum of squares of wrapped ranges (Welford's recurrence)."""

    n: NDArray[np.int64]
    mean_m: NDArray[np.float64]
    squares_m2: NDArray[np.float64]
    sensor: Sensor

    @classmethod
    def empty(cls, shape: tuple[int, ...], sensor: Sensor) -> _Scatter:
        return cls(np.zeros(shape, dtype=np.int64), np.zeros(shape), np.zeros(shape), sensor)

    def add(self, range_m: NDArray[np.float64], valid: NDArray[np.bool_]) -> None:
        self.n = self.n + valid
        step = wrap_difference_m(np.where(valid, range_m - self.mean_m, 0.0), self.sensor)
        share = 1.0 / np.maximum(self.n, 1)
        self.mean_m = self.mean_m + share * step
        self.squares_m2 = self.squares_m2 + (1.0 - share) * step**2

    def variance_m2(self) -> NDArray[np.float64]:
        """Return the sample variance of one frame; infinite with fewer than two frames."""
        variance = np.full(self.squares_m2.shape, np.inf)
        np.divide(self.squares_m2, self.n - 1, out=variance, where=self.n > 1)
        return variance


@dataclass(frozen=True)
class _Tally:
    """Counts and sums over the frames of each pixel: all that state, amplitude and R need, and additive in time."""

    n_valid: NDArray[np.int64]
    n_usable: NDArray[np.int64]
    amplitude: _Sums | None
    intensity: _Sums | None
    sensor: Sensor

    @classmethod
    def of(cls, frames: Frames) -> _Tally:
        if frames.n_frames == 0:
            raise UsageError("there is no frame to filter")
        n_valid, n_usable = (np.zeros(_one_each(frames), np.int64) for _ in range(2))
        count(_pixels_of_frames(frames.flags), _pixels(n_valid), _pixels(n_usable))
        return cls(
            n_valid,
            n_usable,
            None if frames.amplitude_e is None else _Sums.of(frames.amplitude_e, frames.flags, n_valid),
            None if frames.intensity_e is None else _Sums.of(frames.intensity_e, frames.flags, n_valid),
            frames.sensor,
        )

    def plus(self, other: _Tally) -> _Tally:
        if other.n_valid.shape != self.n_valid.shape:
            raise UsageError(
                f"the frame has {len(other.n_valid)} positions, but the ones before have {len(self.n_valid)}"
            )
        return _Tally(
            self.n_valid + other.n_valid,
            self.n_usable + other.n_usable,
            _add_sums("amplitude_e", self.amplitude, other.amplitude),
            _add_sums("intensity_e", self.intensity, other.intensity),
            self.sensor,
        )

    def state(self) -> NDArray[np.uint8]:
        returned = (self.n_usable > 0) & (2 * self.n_valid >= self.n_usable)
        some = np.where(self.n_usable > 0, int(PixelState.NO_RETURN), int(PixelState.MISSING))
        return np.where(returned, int(PixelState.RETURN), some).astype(np.uint8)

    def mean_amplitude_e(self) -> NDArray[np.float64] | None:
        return None if self.amplitude is None else self.amplitude.mean()

    def mean_intensity_e(self) -> NDArray[np.float64] | None:
        return None if self.intensity is None else self.intensity.mean()

    def law_variance_m2(self) -> NDArray[np.float64] | None:
        """Return R of one frame by the noise law; None without amplitude or intensity of what the range is made of."""
        amplitude_e, intensity_e = self.mean_amplitude_e(), self.mean_intensity_e()
        if amplitude_e is None or intensity_e is None or len(self.sensor.frequencies_hz) > 1:
            return None
        return measured_range_std(amplitude_e, intensity_e, self.sensor) ** 2


@dataclass(frozen=True)
class _Sums:
    """Sums of a quantity over valid frames, and over finite values of the usable but invalid ones."""

    valid: NDArray[np.float64]
    n_valid: NDArray[np.int64]
    other: NDArray[np.float64]
    n_other: NDArray[np.int64]

    @classmethod
    def of(cls, values: NDArray[np.float64], flags: NDArray[np.uint8], n_valid: NDArray[np.int64]) -> _Sums:
        """Add up frames, (n, frames, rows, cols)."""
        valid, other, n_other = np.zeros(n_valid.shape), np.zeros(n_valid.shape), np.zeros(n_valid.shape, np.int64)
        add_up(_pixels_of_frames(values), _pixels_of_frames(flags), _pixels(valid), _pixels(other), _pixels(n_other))
        return cls(valid, n_valid, other, n_other)

    def mean(self) -> NDArray[np.float64]:
        """Return the mean of the valid frames, or where there is none of the others; NaN where there is neither."""
        use_valid = self.n_valid > 0
        total = np.where(use_valid, self.valid, self.other)
        count = np.where(use_valid, self.n_valid, self.n_other)
        mean = np.full(total.shape, np.nan)
        np.divide(total, count, out=mean, where=count > 0)
        return mean


def _add_sums(name: str, old: _Sums | None, new: _Sums | None) -> _Sums | None:
    if old is None and new is None:
        return None
    if old is None or new is None:
        with_, without = ("frame", "ones before") if old is None else ("ones before", "frame")
        raise UsageError(f"'{name}' must come with every frame or none: given with the {with_}, not with the {without}")
    return _Sums(old.valid + new.valid, old.n_valid + new.n_valid, old.other + new.other, old.n_other + new.n_other)


def _one_each(frames: Frames) -> tuple[int, ...]:
    """Return the shape of one number for each pixel, (n, rows, cols)."""
    return (len(frames), *frames.range_m.shape[2:])


def _pixels(image: NDArray[_Number]) -> NDArray[_Number]:
    """Return (n, rows, cols) as the compiled loops take it, (n, pixels)."""
    return image.reshape(len(image), math.prod(image.shape[1:]))


def _pixels_of_frames(values: NDArray[_Number]) -> NDArray[_Number]:
    """Return (n, frames, rows, cols) as the compiled loops take it, (n, frames, pixels)."""
    return np.ascontiguousarray(values).reshape(*values.shape[:2], math.prod(values.shape[2:]))


def _in_time(frames: Frames) -> Iterator[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Yield range and validity frame by frame, each (n, rows, cols)."""
    valid = frames.valid
    for k in range(frames.n_frames):
        yield frames.range_m[:, k], valid[:, k]


def _phasors_in_time(frames: Frames) -> Iterator[NDArray[np.complex128]]:
    """Yield amplitude_e · exp(iφ) frame by frame, zero where invalid; exp(iφ) without amplitudes."""
    for k, (range_m, valid) in enumerate(_in_time(frames)):
        unit = np.exp(1j / frames.sensor.metres_per_radian * np.where(valid, range_m, 0.0))
        yield np.where(valid, 1.0 if frames.amplitude_e is None else frames.amplitude_e[:, k], 0.0) * unit


def _result(
    tally: _Tally,
    range_m: NDArray[np.float64],
    std_m: NDArray[np.float64],
    n_effective: NDArray[np.float64],
    coherent_amplitude_e: NDArray[np.float64] | None = None,
) -> FilteredFrames:
    state = tally.state()
    returned = state == PixelState.RETURN
    amplitude_e = tally.mean_amplitude_e()
    if coherent_amplitude_e is not None and amplitude_e is not None:
        amplitude_e = np.where(tally.n_valid > 0, coherent_amplitude_e, amplitude_e)
    return FilteredFrames(
        range_m=np.where(returned, wrap_range_m(range_m, tally.sensor), np.nan),
        std_m=np.where(returned, std_m, np.nan),
        amplitude_e=amplitude_e,
        intensity_e=tally.mean_intensity_e(),
        state=state,
        n_effective=np.where(returned, n_effective, 0.0),
        sensor=tally.sensor,
        std_from_scatter=tally.amplitude is None or tally.intensity is None or len(tally.sensor.frequencies_hz) > 1,
    )


def _timed(filtered: FilteredFrames, frames: Frames) -> FilteredFrames:
    """Give filtered frames the mean time stamp of the frames they were made of."""
    return filtered if frames.time_s is None else replace(filtered, time_s=frames.time_s.mean(axis=1))


def _floored(measurement_var_m2: NDArray[np.float64], process_var_m2: float) -> NDArray[np.float64]:
    """Keep Q/R finite for a camera without noise: an R of 1e-12 Q has a gain of one all the same."""
    return np.maximum(measurement_var_m2, 1e-12 * process_var_m2)


def _check_process_variance(process_var_m2: float) -> None:
    if not (math.isfinite(process_var_m2) and process_var_m2 >= 0):
        raise UsageError(f"'process_var_m2' must be zero or positive, got {process_var_m2}")


def _matrix(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != shape:
        raise UsageError(f"'{name}' must have shape {shape}, got {matrix.shape}")
    return matrix
