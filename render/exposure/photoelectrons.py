"""The read-out of the taps, in EMVA 1288's order: electrons arrive, wells fill, taps are read and converted.

Shot noise → full well → read noise → gain, black level, converter → decoding (PHYSICS section 4). Each step is one
function on a row of taps, in place; :func:`read_taps` runs them over frames. Electrons are per tap and phase image.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np

from phasemark.render.exposure.random_streams import Term, fill_normal, fill_uniform, uniform_pair
from phasemark.render.sensor.sensor import Sensor

EXACT_POISSON_BELOW = 500.0
"""Mean in electrons below which counts are drawn from the Poisson distribution itself. Above it one normal of the same
mean and variance stands in: its distribution function is off by 0.066 / √mean at most, 0.3 % here."""

_INVERSION_BELOW = 10.0
_SHOT, _READ = int(Term.SHOT), int(Term.READ)


class ReadOut(NamedTuple):
    """Read-out parameters of a tap in the form that the kernel takes."""

    shot_noise: bool
    full_well_e: float
    read_noise_e: float
    has_converter: bool
    gain: float
    black_level: float
    top_code: float

    @classmethod
    def of(cls, sensor: Sensor) -> ReadOut:
        """Take the fields of a sensor."""
        return cls(
            sensor.shot_noise,
            math.inf if sensor.full_well_e is None else sensor.full_well_e,
            sensor.read_noise_e,
            sensor.adc_bits is not None,
            sensor.gain,
            sensor.black_level,
            2.0 ** (sensor.adc_bits or 0) - 1,
        )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_arrived(means, uniform, normal, samples, frame, view, key, arrived):
    """Draw arrived electrons: Poisson, or above `EXACT_POISSON_BELOW` a normal of the Poisson's mean and variance.

    `means`, `uniform`, `normal` and `arrived` are (2, n): taps a and b of n pixels, with one uniform number and its
    normal deviate; `samples`, (n,), are the pixels' numbers in the random stream.
    """
    for tap in range(2):
        for i in range(means.shape[1]):  # dim ones too: without a branch several run at once
            arrived[tap, i] = means[tap, i] + math.sqrt(means[tap, i]) * normal[tap, i]
        for i in range(means.shape[1]):
            mean = means[tap, i]
            if mean >= EXACT_POISSON_BELOW:
                continue
            if mean >= _INVERSION_BELOW:
                arrived[tap, i] = _poisson_by_rejection(mean, 2 * samples[i] + tap, frame, view, key)
            else:
                arrived[tap, i] = _poisson_by_inversion(mean, uniform[tap, i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _poisson_by_inversion(mean, u):
    """Return the Poisson count at the quantile u, by adding up probabilities from zero."""
    count, term = 0, math.exp(-mean)
    total = term
    while u > total and term > 0.0:
        count += 1
        term *= mean / count
        total += term
    return float(count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _poisson_by_rejection(mean, sample, frame, view, key):
    """Return a Poisson count by transformed rejection (Hörmann 1993, PTRS), for means of 10 and more."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    quick = 0.9277 - 3.6224 / (b - 2.0)
    attempt = 0
    while True:
        attempt += 1
        u, v = uniform_pair(sample, frame, view, _SHOT, attempt, key)
        u -= 0.5
        us = 0.5 - abs(u)
        count = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= quick:
            return float(count)
        if count < 0 or (us < 0.013 and v > us):
            continue
        log_probability = count * math.log(mean) - mean - math.lgamma(count + 1.0)
        if math.log(v * inverse_alpha / (a / (us * us) + b)) <= log_probability:
            return float(count)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_well(taps, full_well_e, saturated):
    """Clip taps (2, n) at the full well, and note the pixels where one reached it."""
    for tap in range(2):
        for i in range(taps.shape[1]):
            saturated[i] |= taps[tap, i] >= full_well_e
            taps[tap, i] = min(taps[tap, i], full_well_e)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_read_noise(taps, read_noise_e, normal):
    """Add Gaussian noise of `read_noise_e` r.m.s. to taps (2, n)."""
    for tap in range(2):
        for i in range(taps.shape[1]):
            taps[tap, i] += read_noise_e * normal[tap, i]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def convert(taps, gain, black_level, top_code, saturated):
    """Turn electrons (2, n) into codes: gain and black level, whole codes, clipped to 0 … `top_code` (noted)."""
    for tap in range(2):
        for i in range(taps.shape[1]):
            code = max(np.rint(taps[tap, i] * gain + black_level), 0.0)
            saturated[i] |= code >= top_code
            taps[tap, i] = min(code, top_code)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def decode(taps, gain, black_level):
    """Turn codes (2, n) into the electrons they stand for with nominal gain and black level."""
    for tap in range(2):
        for i in range(taps.shape[1]):
            taps[tap, i] = (taps[tap, i] - black_level) / gain


@numba.njit(cache=True, nogil=True, error_model="numpy")
def read_taps(means, start, stop, n_frames, first_view, first_frame, first_phase, key, out, taps, saturated):
    """Read frames start … stop of all views' frames, counted view by view.

    Parameters
    ----------
    means : (views, 4, 2, pixels) float64
        Mean electrons of every tap, of the views from the one that frame `start` belongs to.
    start, stop, n_frames : int
        Frame i is frame i % n_frames of view i // n_frames.
    first_view, first_frame : int
        Numbers of the first view and of each view's first frame in the counters of the random streams.
    first_phase : int
        Number of the first of the four phase images among those of a frame.
    key : (2,) uint64
    out : ReadOut
    taps : (stop − start, 4, 2, pixels) float64
        Filled with the electrons that the camera reports.
    saturated : (stop − start, pixels) bool
        Filled: whether a tap of the pixel reached its full well or the highest code.
    """
    n = means.shape[3]
    every = np.arange(n)
    words, chosen, uniform, normal = _scratch(n)
    for i in range(start, stop):
        mean = means[i // n_frames - start // n_frames]
        view, frame = first_view + i // n_frames, first_frame + i % n_frames
        if i == start or i % n_frames == 0:
            lit = _pixels_with_light(mean)  # no light has no noise: most of a frame may be nothing but background
            light, arrived = np.empty((4, 2, len(lit))), np.empty((2, len(lit)))
            for phase in range(4):
                for tap in range(2):
                    for k in range(len(lit)):
                        light[phase, tap, k] = mean[phase, tap, lit[k]]
            lit_words, lit_chosen, lit_uniform, lit_normal = _scratch(len(lit))
        over = saturated[i - start]
        over[:] = False
        for phase in range(4):
            row = taps[i - start, phase]
            for tap in range(2):  # number by number: numba compiles an array that is set to another at length
                for k in range(n):
                    row[tap, k] = mean[phase, tap, k]
            if out.shot_noise:
                samples = (first_phase + phase) * n + lit
                fill_uniform(samples, frame, view, _SHOT, key, lit_words, lit_uniform)
                fill_normal(lit_uniform.reshape(-1), lit_chosen, lit_normal.reshape(-1))
                draw_arrived(light[phase], lit_uniform, lit_normal, samples, frame, view, key, arrived)
                for k in range(len(lit)):
                    row[0, lit[k]], row[1, lit[k]] = arrived[0, k], arrived[1, k]
            if out.full_well_e < math.inf:
                fill_well(row, out.full_well_e, over)
            if out.read_noise_e > 0.0:
                fill_uniform((first_phase + phase) * n + every, frame, view, _READ, key, words, uniform)
                fill_normal(uniform.reshape(-1), chosen, normal.reshape(-1))
                add_read_noise(row, out.read_noise_e, normal)
            if out.has_converter:
                convert(row, out.gain, out.black_level, out.top_code, over)
                decode(row, out.gain, out.black_level)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _scratch(n):
    """Return room for the random numbers of n pixels: words, chosen, uniform, normal."""
    return np.empty((4, n), np.uint64), np.empty(2 * n, np.int32), np.empty((2, n)), np.empty((2, n))


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _pixels_with_light(mean):
    """Return which pixels of (4, 2, pixels) mean electrons have any."""
    n = mean.shape[2]
    lit, count = np.empty(n, np.int64), 0
    for pixel in range(n):
        lit[count] = pixel
        some = False
        for phase in range(4):
            some |= mean[phase, 0, pixel] > 0.0 or mean[phase, 1, pixel] > 0.0
        count += some
    return lit[:count].copy()
