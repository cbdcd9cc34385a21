"""The paper's Kalman filter, equations (1) to (5), and for each pixel of a camera at rest (PHYSICS section 6)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames, unwrap_filtered
from phasemark.matcher.filters.loops import follow
from phasemark.matcher.filters.pixel_sums import PixelSums, filter_each, pixels, pixels_of_frames, timed
from phasemark.render.frames import Frames
from phasemark.render.sensor.sensor import Sensor


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
    P, A, Q = (_matrix(name, square, (n_state, n_state)) for name, square in (("P", P), ("A", A), ("Q", Q)))
    H, R = _matrix("H", H, (n_measured, n_state)), _matrix("R", R, (n_measured, n_measured))
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
    if len(frames.by_frequency) > 1:
        return filter_each(frames, lambda part: kalman_filter(part, process_var_m2))
    filters = PixelKalman(frames.sensor, process_var_m2)
    filters._take_in(frames)
    return timed(filters.result(), frames)


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
        if not (math.isfinite(process_var_m2) and process_var_m2 >= 0):
            raise UsageError(f"'process_var_m2' must be zero or positive, got {process_var_m2}")
        self._sensor = sensor
        self._process_var_m2 = process_var_m2
        self._each: tuple[PixelKalman, ...] = ()
        self._sums: PixelSums | None = None
        # of each pixel: the state, P / R (both NaN before the first valid frame), and R
        self._range_m: NDArray[np.float64]
        self._scaled_var: NDArray[np.float64]
        self._measurement_var_m2: NDArray[np.float64]

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
        self._take_in(frame)

    def _take_in(self, frames: Frames) -> None:
        """Take in any number of frames at each position, with the R of all of them; :meth:`update` checks them.

        With Q = 0 no R enters the state: R = 0 (noise switched off) and R = ∞ (not known yet) give the running mean.
        """
        if self._sums is None:
            self._sums = PixelSums(frames, scatter=True)
            self._range_m = self._scaled_var = np.full(self._sums.n_valid.shape, np.nan)
        else:
            self._sums.add(frames)
        # with Q/R finite for a camera without noise: an R of 1e-12 Q has a gain of one all the same
        self._measurement_var_m2 = np.maximum(self._sums.variance_m2(), 1e-12 * self._process_var_m2)
        self._range_m, self._scaled_var = self._range_m.copy(), self._scaled_var.copy()  # results may hold the old ones
        follow(
            pixels_of_frames(frames.range_m), pixels_of_frames(frames.flags), self._sensor.unambiguous_range_m,
            self._process_var_m2, pixels(self._measurement_var_m2), pixels(self._range_m), pixels(self._scaled_var),
        )  # fmt: skip

    def _update_each(self, frame: Frames) -> None:
        """Take in what each modulation frequency measured."""
        if self._sums is not None:
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
        if self._sums is None:
            raise UsageError("no frame to filter: call update() first")
        std_m = np.sqrt(self._scaled_var * self._measurement_var_m2)
        return self._sums.filtered(self._range_m, std_m, 1.0 / self._scaled_var)


def _matrix(name: str, value: ArrayLike, shape: tuple[int, int]) -> NDArray[np.float64]:
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != shape:
        raise UsageError(f"'{name}' must have shape {shape}, got {matrix.shape}")
    return matrix
