"""Test whether camera and scene stood still while the frames at a position were taken.

Three findings speak against it. *Order*: at rest the frames of a pixel could have come in any order. While something
moves, neighbours in time are alike, and successive differences are small compared with the total scatter (von Neumann's
ratio). This needs no noise level. *Scatter*: most pixels scatter far more than the noise law of the sensor says.
*Wholes*: one frame is nearer or farther than the others in its pixels together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.render import Frames, measured_range_std, predicted_range_std
from phasemark.render.phasor_images import wrap_difference_m

FEWEST_FOR_ORDER = 4
"""Valid frames of a pixel below which its order says next to nothing."""
LEAST_CORRELATION = 0.05
"""Smaller correlations, though significant in a long recording, do no harm to the mean: drift of a warming sensor."""
EXCESS_VARIANCE = 4.0
"""Variance over that of the noise law beyond which a pixel speaks of motion: noise is known to a factor of 2 or so."""
LEAST_SHIFT, FEWEST_PIXELS = 0.5, 4
"""Shift of a whole frame in standard deviations of its pixels below which it is noise that they share, and how many
pixels make one."""

_VALUES_AT_ONCE = 1 << 20


@dataclass(frozen=True, eq=False)
class MotionTest:
    """Tests of the frames at n positions for motion.

    Parameters
    ----------
    p_value : (n,) float64
        Probability of frames that look at least as moved as these, if nothing moved and the noise is independent
        between frames and pixels. 1 where there are too few frames to tell.
    correlation : (n,) float64
        Mean over the pixels of 1 − ratio / 2, with the von Neumann ratio of the ranks: 0 at rest, towards 1 when the
        motion is slow and larger than the noise. NaN where there are too few frames.
    excess_scatter : (n,) float64
        Median over the pixels of the standard deviation over that of the noise law. NaN if the sensor has no law for
        these frames.
    """

    p_value: NDArray[np.float64]
    correlation: NDArray[np.float64]
    excess_scatter: NDArray[np.float64]

    def moved(self, false_alarm: float = 1e-3) -> NDArray[np.bool_]:
        """Return at which positions something moved, (n,).

        Parameters
        ----------
        false_alarm : float
            Probability that any of the positions is named though nothing moved at any of them (Bonferroni).
        """
        return self.p_value < false_alarm / max(len(self.p_value), 1)


def motion_test(frames: Frames) -> MotionTest:
    """Test whether camera and scene stood still while the frames at each position were taken.

    *Order.* With the centred ranks a of the n valid ranges of a pixel, in the order of time,
    C = 1 − Σ(aᵢ − aᵢ₊₁)² / (2 Σ aᵢ²). If all orders are equally probable, C has mean 0 and variance
    1/n − k/2n − (1 + k) / (2n(n − 1)) with k = Σa⁴ / (Σa²)², whatever the distribution of the noise and its ties
    (without ties it is that of Bartels 1982). The pixels are independent, so Σ C/var(C) over √(Σ 1/var(C)) is normal.

    *Scatter.* The variance of a pixel over that of the law is χ²(ν)/ν. The number of pixels that exceed
    `EXCESS_VARIANCE` is binomial; half of the pixels have to.

    *Wholes.* Ranges less their mean over time, over the standard deviation of the pixel, add up over the pixels of a
    frame to a normal variable; the largest of all frames counts.

    The p-value is three times the smallest of them; 1 for the order where the mean of C is below `LEAST_CORRELATION`,
    and for wholes where the pixels of the frame are off by less than `LEAST_SHIFT` in the mean.

    Parameters
    ----------
    frames : Frames
        (n, frames, rows, cols).

    Returns
    -------
    MotionTest

    Examples
    --------
    >>> import numpy as np
    >>> from phasemark.render import Frames, preset
    >>> sensor, rng = preset("vl53l5cx-8x8"), np.random.default_rng(1)
    >>> still = 0.7 + rng.normal(0, 0.004, (1, 20, 8, 8))
    >>> driving = still + np.linspace(0, 0.05, 20)[:, None, None]
    >>> [bool(motion_test(Frames(ranges, sensor=sensor)).moved()[0]) for ranges in (still, driving)]
    [False, True]
    """
    ranges = unwrapped_alike(frames).reshape(len(frames), frames.n_frames, -1)
    p_order, correlation = _order(ranges)
    p_scatter, excess = _scatter(ranges, frames)
    smallest = np.minimum.reduce([p_order, p_scatter, _wholes(ranges)])
    return MotionTest(np.minimum(1.0, 3 * smallest), correlation, excess)


def motion_note(places: Sequence[Frames]) -> str:
    """Return in words at which positions something moved, "" if nowhere.

    Parameters
    ----------
    places : sequence of Frames
        Those of some positions after those of others.
    """
    tests = [motion_test(frames) for frames in places]
    test = MotionTest(*(np.concatenate([getattr(one, name) for one in tests]) for name in vars(tests[0])))
    n, moved = len(test.p_value), np.flatnonzero(test.moved())
    if not moved.size:
        return ""
    where = "the file" if n == 1 else f"{len(moved)} of {n} positions, the first being {moved[0]}"
    return f"the camera or the scene moved during {where}, so that the mean of the frames is no single view"


def unwrapped_alike(frames: Frames) -> NDArray[np.float64]:
    """Return ranges on the same side of the wrap as the first valid one of their pixel; NaN where invalid."""
    ranges = frames.range_m
    if not ranges.shape[1]:
        return ranges
    first = np.take_along_axis(ranges, np.isfinite(ranges).argmax(axis=1)[:, None], axis=1)
    return np.asarray(first + wrap_difference_m(ranges - first, frames.sensor))


def _order(ranges: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return p-value and mean correlation of successive ranks; (n,) each."""
    n, n_frames, n_pixels = ranges.shape
    p_value, mean = np.ones(n), np.full(n, np.nan)
    if n_frames < FEWEST_FOR_ORDER:
        return p_value, mean
    at_once = max(1, _VALUES_AT_ONCE // (n_frames * n_pixels))
    for start in range(0, n, at_once):
        some = slice(start, min(start + at_once, n))
        series = ranges[some].transpose(1, 0, 2).reshape(n_frames, -1)
        correlation, variance = (values.reshape(-1, n_pixels) for values in _correlations(series))
        told = np.isfinite(correlation)
        weight = np.where(told, 1 / variance, 0.0)
        correlation = np.where(told, correlation, 0.0)
        any_told = told.any(axis=1)
        mean[some] = np.where(any_told, correlation.sum(axis=1) / np.maximum(told.sum(axis=1), 1), np.nan)
        total = np.where(any_told, weight.sum(axis=1), 1.0)
        p = special.ndtr(-(weight * correlation).sum(axis=1) / np.sqrt(total))
        p_value[some] = np.where(mean[some] >= LEAST_CORRELATION, p, 1.0)
    return p_value, mean


def _correlations(series: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return C and its variance for each pixel of (frames, pixels); NaN where too few frames are valid or all alike."""
    from scipy import stats  # slow to import

    valid = np.isfinite(series)
    n = valid.sum(axis=0)
    in_time = np.argsort(~valid, axis=0, kind="stable")  # the valid ones first, in their order
    ranks = stats.rankdata(np.take_along_axis(series, in_time, axis=0), axis=0, nan_policy="omit")
    centred = np.nan_to_num(ranks - (n + 1) / 2)
    pairs = np.arange(1, len(series))[:, None] < n
    squares = (centred**2).sum(axis=0)
    told = (n >= FEWEST_FOR_ORDER) & (squares > 0)
    n, squares = np.where(told, n, FEWEST_FOR_ORDER), np.where(told, squares, 1.0)
    steps = (np.diff(centred, axis=0) ** 2).sum(axis=0, where=pairs)
    kurtosis = (centred**4).sum(axis=0) / squares**2
    variance = 1 / n - kurtosis / (2 * n) - (1 + kurtosis) / (2 * n * (n - 1))
    return np.where(told, 1 - steps / (2 * squares), np.nan), variance


def _wholes(ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the p-value of the frame that is off most in all its pixels together, (n,)."""
    n, n_frames, n_pixels = ranges.shape
    p_value, fewest = np.ones(n), 3
    if n_frames < fewest:
        return p_value
    at_once = max(1, _VALUES_AT_ONCE // (n_frames * n_pixels))
    for start in range(0, n, at_once):
        some = ranges[start : start + at_once]
        valid = np.isfinite(some)
        count = np.maximum(valid.sum(axis=1, keepdims=True), 1)
        off = some - some.sum(axis=1, keepdims=True, where=valid) / count
        variance = np.square(off).sum(axis=1, keepdims=True, where=valid) / count
        told = valid & (variance > 1e-12)  # (1 µm)²: pixels that show one value are off by rounding
        off = np.abs(np.divide(off, np.sqrt(variance), out=np.zeros(off.shape), where=told).sum(axis=2))
        pixels = np.maximum(told.sum(axis=2), FEWEST_PIXELS)
        z = np.where(off >= LEAST_SHIFT * pixels, off / np.sqrt(pixels), 0.0).max(axis=1)
        p_value[start : start + at_once] = np.minimum(1.0, 2 * n_frames * special.ndtr(-z))
    return p_value


def _scatter(ranges: NDArray[np.float64], frames: Frames) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return p-value and excess of the scatter over the noise law; (n,) each."""
    p_value, excess = np.ones(len(ranges)), np.full(len(ranges), np.nan)
    law_m2 = _law_variance_m2(frames)
    if law_m2 is None or ranges.shape[1] < 2:
        return p_value, excess
    valid = np.isfinite(ranges)
    nu = valid.sum(axis=1) - 1
    mean = np.where(valid, ranges, 0.0).sum(axis=1) / np.maximum(nu + 1, 1)
    squares = (np.where(valid, ranges - mean[:, None], 0.0) ** 2).sum(axis=1)
    told = (nu >= 1) & np.isfinite(law_m2) & (law_m2 > 0)
    ratio = np.divide(squares, nu * law_m2, out=np.full(squares.shape, np.nan), where=told)
    for k in np.flatnonzero(told.any(axis=1)):
        one, n_pixels = ratio[k, told[k]], int(told[k].sum())
        excess[k] = np.sqrt(np.median(one))
        beyond = int((one > EXCESS_VARIANCE).sum())
        if 2 * beyond >= n_pixels:
            chance = special.chdtrc(nu[k, told[k]], EXCESS_VARIANCE * nu[k, told[k]]).max()
            p_value[k] = special.bdtrc(beyond - 1, n_pixels, chance)
    return p_value, excess


def _law_variance_m2(frames: Frames) -> NDArray[np.float64] | None:
    """Return the variance of one frame by the noise law, (n, pixels); None without amplitudes."""
    shape = (len(frames), -1)
    if frames.sensor.kind == "direct":
        one = float(predicted_range_std(1.0, 1.0, frames.sensor)) ** 2
        return np.full(frames.range_m[:, 0].reshape(shape).shape, one)
    if frames.amplitude_e is None or frames.intensity_e is None:
        return None
    count = np.maximum(frames.valid.sum(axis=1), 1)
    means = [values.sum(axis=1, where=frames.valid) / count for values in (frames.amplitude_e, frames.intensity_e)]
    return np.asarray(measured_range_std(means[0], means[1], frames.sensor) ** 2).reshape(shape)
