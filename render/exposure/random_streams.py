"""Counter-based random numbers: each sample's noise follows from (key, term, view, frame, sample) alone.

Philox4x32-10 (Salmon, Moraes, Dror and Shaw, SC 2011) turns a counter of four words and a key of two into four random
words. No state is carried from sample to sample, so frames can be cut into batches and spread over threads at will.
"""

from __future__ import annotations

import math
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError

_MASK = np.uint64(0xFFFFFFFF)
_HALF = np.uint64(32)
_M0, _M1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_W0, _W1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
_LOW_BITS, _HIGH_SHIFT = np.uint64(11), np.uint64(21)
_UNIT = 2.0**-53
_CENTRAL, _NEAR = 0.425, 5.0
_MIDDLE = (
    (2.5090809287301226727e3, 3.3430575583588128105e4, 6.7265770927008700853e4, 4.5921953931549871457e4,
     1.3731693765509461125e4, 1.9715909503065514427e3, 1.3314166789178437745e2, 3.3871328727963666080e0),
    (5.2264952788528545610e3, 2.8729085735721942674e4, 3.9307895800092710610e4, 2.1213794301586595867e4,
     5.3941960214247511077e3, 6.8718700749205790830e2, 4.2313330701600911252e1, 1.0),
)  # fmt: skip
_NEAR_TAIL = (
    (7.74545014278341407640e-4, 2.27238449892691845833e-2, 2.41780725177450611770e-1, 1.27045825245236838258e0,
     3.64784832476320460504e0, 5.76949722146069140550e0, 4.63033784615654529590e0, 1.42343711074968357734e0),
    (1.05075007164441684324e-9, 5.47593808499534494600e-4, 1.51986665636164571966e-2, 1.48103976427480074590e-1,
     6.89767334985100004550e-1, 1.67638483018380384940e0, 2.05319162663775882187e0, 1.0),
)  # fmt: skip
_FAR_TAIL = (
    (2.01033439929228813265e-7, 2.71155556874348757815e-5, 1.24266094738807843860e-3, 2.65321895265761230930e-2,
     2.96560571828504891230e-1, 1.78482653991729133580e0, 5.46378491116411436990e0, 6.65790464350110377720e0),
    (2.04426310338993978564e-15, 1.42151175831644588870e-7, 1.84631831751005468180e-5, 7.86869131145613259100e-4,
     1.48753612908506148525e-2, 1.36929880922735805310e-1, 5.99832206555887937690e-1, 1.0),
)  # fmt: skip
"""Numerators and denominators of AS 241 (Wichura, 1988): the middle of the normal distribution, and its tails."""

_ATTEMPT_SHIFT = np.uint64(8)  # the fourth word of the counter: term in the lowest byte, attempts above it


class Term(IntEnum):
    """The noise terms by number; a number keeps its stream for good."""

    SHOT = 0
    READ = 1
    RANGE = 2


def draw_key(rng: np.random.Generator) -> NDArray[np.uint64]:
    """Draw the two key words, 32 bits each, of all noise of one capture.

    Drawing them, rather than spawning a child, works for every bit generator, advances `rng` by the same amount
    whatever is captured, and makes the next capture with the same `rng` independent of this one.
    """
    if not isinstance(rng, np.random.Generator):
        raise UsageError(f"'rng' must be a numpy.random.Generator, as numpy.random.default_rng(0), got {rng!r}")
    return rng.integers(0, 2**32, size=2, dtype=np.uint64)


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _round(c0, c1, c2, c3, k0, k1):
    p0, p1 = _M0 * c0, _M1 * c2
    return (p1 >> _HALF) ^ c1 ^ k0, p1 & _MASK, (p0 >> _HALF) ^ c3 ^ k1, p0 & _MASK


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _rounds(c0, c1, c2, c3, k0, k1):
    for _ in range(10):
        c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
        k0, k1 = (k0 + _W0) & _MASK, (k1 + _W1) & _MASK
    return c0, c1, c2, c3


@numba.njit(cache=True, nogil=True, error_model="numpy")
def philox(words, key):
    """Turn n counters of four 32-bit words, (4, n) uint64, into the words drawn, in place; the key has two words."""
    k0, k1 = key[0], key[1]
    for i in range(words.shape[1]):  # the compiler runs several counters at once, their words in registers
        words[0, i], words[1, i], words[2, i], words[3, i] = _rounds(
            words[0, i], words[1, i], words[2, i], words[3, i], k0, k1
        )


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _fractions(c0, c1, c2, c3):
    """Return two numbers in the open interval (0, 1), of 53 bits each, from four words."""
    first = np.int64((c0 << _HIGH_SHIFT) | (c1 >> _LOW_BITS))  # signed: quick to make a float
    second = np.int64((c2 << _HIGH_SHIFT) | (c3 >> _LOW_BITS))
    return (float(first) + 0.5) * _UNIT, (float(second) + 0.5) * _UNIT


@numba.njit(cache=True, nogil=True, error_model="numpy")
def uniform_pair(sample, frame, view, term, attempt, key):
    """Return two independent numbers, uniform in (0, 1); a term that needs more of them counts its attempts."""
    c0, c1, c2 = np.uint64(sample), np.uint64(frame), np.uint64(view)
    c3 = np.uint64(term) | (np.uint64(attempt) << _ATTEMPT_SHIFT)
    c0, c1, c2, c3 = _rounds(c0, c1, c2, c3, key[0], key[1])
    return _fractions(c0, c1, c2, c3)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_uniform(samples, frame, view, term, key, words, out):
    """Fill `out`, (2, n), with the uniform pairs of n samples, by number; `words` is scratch, (4, n) uint64."""
    for i in range(out.shape[1]):
        words[0, i] = np.uint64(samples[i])
        words[1, i] = np.uint64(frame)
        words[2, i] = np.uint64(view)
        words[3, i] = np.uint64(term)
    philox(words, key)
    for i in range(out.shape[1]):
        out[0, i], out[1, i] = _fractions(words[0, i], words[1, i], words[2, i], words[3, i])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fill_normal(uniform, chosen, out):
    """Fill `out` with the standard normal deviates below which the shares `uniform` lie; `chosen` is scratch, int32.

    All flat, of one length. The middle 85 % and the tails each in a loop that the compiler can run several at once.
    """
    for i in range(len(uniform)):
        out[i] = _central_quantile(uniform[i] - 0.5)
    n_tail = 0
    for i in range(len(uniform)):
        chosen[n_tail] = i
        n_tail += abs(uniform[i] - 0.5) > _CENTRAL
    root, size = np.empty(n_tail), np.empty(n_tail)
    for j in range(n_tail):
        p = uniform[chosen[j]]
        root[j] = math.sqrt(-math.log(p if p < 0.5 else 1.0 - p))
    for j in range(n_tail):
        size[j] = _near_tail(root[j])
    for j in range(n_tail):
        i = chosen[j]
        above = size[j] if root[j] <= _NEAR else _far_tail(root[j])
        out[i] = -above if uniform[i] < 0.5 else above


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _central_quantile(q):
    """Return the normal quantile for |q| = |p − ½| up to 0.425: AS 241 (Wichura, 1988), good to 1e-15."""
    top, bottom = _both(_MIDDLE, _CENTRAL * _CENTRAL - q * q)
    return q * top / bottom


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _near_tail(r):
    """Return the size of the normal quantile by AS 241 for r = √(−ln p) up to 5, p being the smaller share."""
    top, bottom = _both(_NEAR_TAIL, r - 1.6)
    return top / bottom


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _far_tail(r):
    """Return the size of the normal quantile by AS 241 for r above 5."""
    top, bottom = _both(_FAR_TAIL, r - _NEAR)
    return top / bottom


@numba.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _both(coefficients, r):
    """Return the values at r of two polynomials of degree 7, whose coefficients begin with the highest power."""
    above, below = coefficients
    top, bottom = above[0], below[0]
    for k in range(1, 8):
        top, bottom = top * r + above[k], bottom * r + below[k]
    return top, bottom
