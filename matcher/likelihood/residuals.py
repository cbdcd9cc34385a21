"""Residuals between model images and filtered frames, and their derivatives by the view: Gauss–Newton's sums.

On *ranges*, each pixel leaves the residual y − (c/4πf) arg S, wrapped, with the variance of the filter. On *phasors*
it leaves two, real and imaginary part of z − S, where z is the filtered amplitude · exp(iφ) in units of |S|; both have
the variance (N₀·intensity + N_amb + N_dark + 2σ_r² + q²/6) / (2 n (K N₀)²), the law of PHYSICS section 4 before it is
divided by the amplitude.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.chi_squared import noise_tails
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import DISAGREEMENT, one_frame_limit_m
from phasemark.render import Sensor
from phasemark.render.sensor.range_noise import phase_image_variance

STRANGE_SIGMA = 5.0
"""Among unknown things, a return farther from the model than this sees something else."""

ResidualKind = Literal["ranges", "phasors"]


@dataclass(frozen=True, eq=False)
class Evidence:
    """Filtered frames as the likelihood sees them; (n, pixels) arrays.

    Parameters
    ----------
    value : complex128
        On ranges exp(iφ), on phasors z in units of |S|; 0 where nothing returned.
    weight : float64
        1/variance of the residual (m⁻² on ranges); 0 where there is none.
    one_frame_std_m : float64
        Noise of a single frame's range; infinite where nothing returned.
    seen : Observation
        The same frames as the coarse search sees them. What one frame cannot measure to 0.1 rad is no return there,
        whether or not the camera dropped it. Those pixels keep their `weight`: where a model is bright enough, a fit
        compares them.
    noise_tails : (n, 2) float64
        What widens the law of χ²; see :func:`~phasemark.matcher.chi_squared.noise_tails`.
    on : {"ranges", "phasors"}
    sensor : Sensor
    tilt_rad : (n, 2) float64
        Pitch and roll of each frame before it is seen: of what is not free as it is, else the mean of the prior.
    """

    value: NDArray[np.complex128]
    weight: NDArray[np.float64]
    one_frame_std_m: NDArray[np.float64]
    seen: Observation
    noise_tails: NDArray[np.float64]
    on: ResidualKind
    sensor: Sensor
    tilt_rad: NDArray[np.float64]

    @classmethod
    def from_frames(cls, frames: FilteredFrames, on: ResidualKind) -> Evidence:
        """Take filtered frames.

        Raises
        ------
        UsageError
            Phasors are asked of frames without amplitude or intensity.
        """
        sensor = frames.sensor
        whole = Observation.from_frames(frames, (0, sensor.rows))
        measured = whole.returned
        n_effective = frames.n_effective.reshape(measured.shape)
        one_frame_m2 = np.divide(n_effective, whole.weight, out=np.full(measured.shape, np.inf), where=measured)
        one_frame_std_m = np.sqrt(one_frame_m2)
        strong = measured & ~(one_frame_m2 > one_frame_limit_m(sensor) ** 2)
        seen = Observation(whole.range_m, whole.weight, strong, whole.not_returned | (measured & ~strong))
        turn = np.asarray(np.where(measured, np.exp(1j * seen.range_m / sensor.metres_per_radian), 0.0), np.complex128)
        tails, tilt_rad = noise_tails(frames), frames.tilts_rad
        if on == "ranges":
            return cls(turn, whole.weight, one_frame_std_m, seen, tails, on, sensor, tilt_rad)
        if frames.amplitude_e is None or frames.intensity_e is None:
            raise UsageError('on="phasors" needs frames with amplitude and intensity: match on="ranges"')
        shape = seen.range_m.shape
        unit = sensor.contrast * sensor.signal_e
        amplitude = np.where(measured, frames.amplitude_e.reshape(shape), 0.0) / unit
        intensity = np.where(measured, frames.intensity_e.reshape(shape), 0.0)
        variance = np.maximum(phase_image_variance(intensity, sensor), 1.0) / (2 * unit**2)
        weight = np.where(measured, n_effective / variance, 0.0)
        return cls(turn * amplitude, weight, one_frame_std_m, seen, tails, on, sensor, tilt_rad)

    def __getitem__(self, index: NDArray[np.integer] | slice) -> Evidence:
        return Evidence(
            self.value[index], self.weight[index], self.one_frame_std_m[index], self.seen[index],
            self.noise_tails[index], self.on, self.sensor, self.tilt_rad[index],
        )  # fmt: skip

    def with_further_noise(self, std_m: float) -> Evidence:
        """Return the same ranges as those of a noisier camera, whose variance is larger by that of `std_m`."""
        return replace(self, weight=self.weight / (1 + self.weight * std_m**2))

    def of_pixels(self, some: NDArray[np.bool_]) -> Evidence:
        """Return the frames with some pixels (pixels,) alone; the others are missing."""
        seen = self.seen
        there = Observation(seen.range_m, seen.weight * some, seen.returned & some, seen.not_returned & some)
        return replace(self, weight=self.weight * some, seen=there)

    @property
    def per_pixel(self) -> int:
        """Residuals that a pixel leaves."""
        return 1 if self.on == "ranges" else 2


@dataclass(frozen=True, eq=False)
class Sums:
    """Gauss–Newton's sums of m models, each against its frame.

    Parameters
    ----------
    cost : (m,) float64
        Whitened squared residual; with a robust loss twice that loss.
    capped : (m,) float64
        The same with no residual adding more than :data:`~phasemark.matcher.pixel_agreement.DISAGREEMENT`, what one
        costs that nothing explains.
    gradient : (m, p) float64
        Jᵀ W r.
    information : (m, p, p) float64
        Jᵀ W J.
    """

    cost: NDArray[np.float64]
    capped: NDArray[np.float64]
    gradient: NDArray[np.float64]
    information: NDArray[np.float64]


def gauss_newton_sums(
    phasor: NDArray[np.complex128],
    slope: NDArray[np.complex128],
    evidence: Evidence,
    frame: NDArray[np.int64],
    use: NDArray[np.bool_],
    huber: float | None,
) -> Sums:
    """Compare m model images with a frame each.

    Parameters
    ----------
    phasor : (m, pixels) complex128
    slope : (m, p, pixels) complex128
        ∂S/∂parameter.
    evidence : Evidence
    frame : (m,) int64
        Number of the frame that each model is compared with.
    use : (m, pixels) bool
        Which pixels count. On ranges, one of them that returns where the model has no light costs
        :data:`~phasemark.matcher.pixel_agreement.DISAGREEMENT`.
    huber : float, optional
        Residual, in σ, from which the loss grows linearly, until it costs what one costs that nothing explains; from
        there it stays, and the pixel no longer counts. None: squares throughout.
    """
    m, p = slope.shape[:2]
    cost, capped, gradient = np.zeros(m), np.zeros(m), np.zeros((m, p))
    information = np.zeros((m, p, p))
    kernel = _sum_ranges if evidence.on == "ranges" else _sum_phasors
    kernel(
        phasor, slope, evidence.value, evidence.weight, frame, use, evidence.sensor.metres_per_radian,
        np.inf if huber is None else huber, cost, capped, gradient, information,
    )  # fmt: skip
    return Sums(cost, capped, gradient, information)


def range_residuals(
    phasor: NDArray[np.complex128], evidence: Evidence, frame: NDArray[np.integer] | Sequence[int]
) -> NDArray[np.float64]:
    """Return the ranges of frames less those of model images, wrapped, in metres; 0 where either has no light.

    Parameters
    ----------
    phasor : (m, pixels) complex128
    evidence : Evidence
    frame : (m,) int
        Which frame each model is compared with.
    """
    return np.asarray(evidence.sensor.metres_per_radian * np.angle(evidence.value[frame] * phasor.conj()))


def range_slopes(phasor: NDArray[np.complex128], slope: NDArray[np.complex128], sensor: Sensor) -> NDArray[np.float64]:
    """Return how the ranges of model images (m, pixels) change, (m, p, pixels); 0 where they have no light."""
    turn = np.divide(1.0, phasor, out=np.zeros_like(phasor), where=phasor != 0)
    return np.asarray(sensor.metres_per_radian * (slope * turn[:, None]).imag)


def robust_weight(
    residual: NDArray[np.float64], weight: NDArray[np.float64], huber: float | None
) -> NDArray[np.float64]:
    """Return the weights that the information is summed with: less beyond Huber's limit, 0 for an outlier.

    Parameters
    ----------
    residual : float64
    weight : float64
        Inverse variances, of a shape that broadcasts with `residual`.
    huber : float, optional
        As in :func:`gauss_newton_sums`.
    """
    weight = np.broadcast_to(weight, residual.shape)
    if huber is None:
        return np.asarray(weight)
    size = np.abs(residual) * np.sqrt(weight)
    share = np.where(size > huber, huber / np.maximum(size, huber), 1.0)
    return np.asarray(np.where(huber * (2 * size - huber) >= DISAGREEMENT, 0.0, weight * share))


_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})


@_compiled
def _angle(across, along):  # type: ignore[no-untyped-def]
    """Return atan2(across, along); small angles, as most residuals are, by their series, to 1e-12."""
    if along > 0.0 and abs(across) < 0.05 * along:
        t = across / along
        square = t * t
        return t * (1.0 - square * (1 / 3 - square * (1 / 5 - square * (1 / 7 - square / 9))))
    return math.atan2(across, along)


@_compiled
def _sum_rows(n, residual, weight, rows, huber, k, cost, capped, gradient, information):  # type: ignore[no-untyped-def]
    """Add n residuals with their rows of the Jacobian, (p, n), to the sums of model k."""
    p = len(rows)
    total, most = 0.0, 0.0
    for i in range(n):
        loss = weight[i] * residual[i] * residual[i]
        if loss > huber * huber:
            size = math.sqrt(loss)
            loss = huber * (2 * size - huber)
            # as iterated least squares has it: the sum stays positive
            weight[i] *= huber / size if loss < DISAGREEMENT else 0.0
            loss = min(loss, DISAGREEMENT)
        total += loss
        most += min(loss, DISAGREEMENT)
    cost[k] += total
    capped[k] += most
    for a in range(p):
        along = 0.0
        for i in range(n):
            along += weight[i] * residual[i] * rows[a, i]
        gradient[k, a] += along
        for b in range(a, p):
            product = 0.0
            for i in range(n):
                product += weight[i] * rows[a, i] * rows[b, i]
            information[k, a, b] += product
    for a in range(p):
        for b in range(a):
            information[k, a, b] = information[k, b, a]


@_compiled
def _sum_ranges(  # type: ignore[no-untyped-def]
    phasor, slope, value, weight, frame, use, metres_per_radian, huber, cost, capped, gradient, information
):
    m, p, pixels = slope.shape
    rows, picked = np.empty((p, pixels)), np.empty(pixels, np.int64)
    residual, weights, share = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    for k in range(m):
        f, n = frame[k], 0
        for q in range(pixels):
            w = weight[f, q]
            if not use[k, q] or w == 0.0:
                continue
            s, v = phasor[k, q], value[f, q]
            size = s.real * s.real + s.imag * s.imag
            if size == 0.0:
                cost[k] += DISAGREEMENT
                capped[k] += DISAGREEMENT
                continue
            across, along = v.imag * s.real - v.real * s.imag, v.real * s.real + v.imag * s.imag
            residual[n], weights[n] = metres_per_radian * _angle(across, along), w
            share[n], picked[n] = metres_per_radian / size, q
            n += 1
        for a in range(p):
            for i in range(n):
                s, d = phasor[k, picked[i]], slope[k, a, picked[i]]
                rows[a, i] = share[i] * (s.real * d.imag - s.imag * d.real)
        _sum_rows(n, residual, weights, rows, huber, k, cost, capped, gradient, information)


@_compiled
def _sum_phasors(  # type: ignore[no-untyped-def]
    phasor, slope, value, weight, frame, use, metres_per_radian, huber, cost, capped, gradient, information
):
    m, p, pixels = slope.shape
    rows, residual, weights = np.empty((p, 2 * pixels)), np.empty(2 * pixels), np.empty(2 * pixels)
    picked = np.empty(pixels, np.int64)
    for k in range(m):
        f, n = frame[k], 0
        for q in range(pixels):
            w = weight[f, q]
            if not use[k, q] or w == 0.0:
                continue
            difference = value[f, q] - phasor[k, q]
            residual[2 * n], residual[2 * n + 1] = difference.real, difference.imag
            weights[2 * n], weights[2 * n + 1], picked[n] = w, w, q
            n += 1
        for a in range(p):
            for i in range(n):
                d = slope[k, a, picked[i]]
                rows[a, 2 * i], rows[a, 2 * i + 1] = d.real, d.imag
        _sum_rows(2 * n, residual, weights, rows, huber, k, cost, capped, gradient, information)
