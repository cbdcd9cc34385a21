"""Photon counts drawn from their expectation, from counters alone, so that any frame can be drawn by itself."""

from __future__ import annotations

import math

import numba
import numpy as np

from phasemark.render.exposure.photoelectrons import EXACT_POISSON_BELOW, _poisson_by_rejection
from phasemark.render.exposure.random_streams import Term, fill_normal, fill_uniform

_SHOT = int(Term.SHOT)
_INVERSION_BELOW = 10.0


@numba.njit(cache=True, nogil=True, error_model="numpy")
def draw_counts(means, start, stop, n_frames, first_view, first_frame, key, out):
    """Draw frames start … stop of all views' frames, counted view by view.

    Parameters
    ----------
    means : (views, cells) float64
        Expected counts of every zone's bins.
    start, stop, n_frames : int
        Frame i is frame i % n_frames of view i // n_frames.
    first_view, first_frame : int
        Numbers of the first view and of each view's first frame in the counters of the random streams.
    key : (2,) uint64
    out : (views · n_frames, cells) float64
        Rows start … stop are filled.
    """
    n = means.shape[1]
    half = (n + 1) // 2
    samples = np.arange(half)
    words, chosen = np.empty((4, half), np.uint64), np.empty(half, np.int32)
    uniform, normal = np.empty((2, half)), np.empty(half)
    bright = np.empty(2, np.bool_)
    most_inverted = 80  # largest count drawn by inversion: a mean of 10 exceeds it once in 1e40
    reciprocal = 1.0 / np.arange(1.0, most_inverted + 2)
    none, last_view = np.empty(n), -1  # the probability of no count
    for i in range(start, stop):
        view = i // n_frames
        frame = first_frame + i % n_frames
        fill_uniform(samples, frame, first_view + view, _SHOT, key, words, uniform)
        row, mean = out[i], means[view]
        if view != last_view:
            none[:] = np.exp(-mean)
            last_view = view
        for side in range(2):
            first, last = side * half, min((side + 1) * half, n)
            bright[side] = False
            for k in range(first, last):
                m = mean[k]
                if m < _INVERSION_BELOW:
                    u, term, count = uniform[side, k - first], none[k], 0
                    total = term
                    while u > total and count < most_inverted:  # add up probabilities from zero
                        term *= m * reciprocal[count]
                        count += 1
                        total += term
                    row[k] = count
                elif m < EXACT_POISSON_BELOW:
                    row[k] = _poisson_by_rejection(m, k, frame, first_view + view, key)
                else:
                    bright[side] = True
            if bright[side]:
                fill_normal(uniform[side], chosen, normal)
                for k in range(first, last):
                    if mean[k] >= EXACT_POISSON_BELOW:
                        row[k] = max(np.rint(mean[k] + math.sqrt(mean[k]) * normal[k - first]), 0.0)
