"""The instrument response of each zone, from histograms of a plane: a smooth curve by linear least squares."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from phasemark.render.direct.fit_model import AMBIENT_BINS, FitModel, Parameters, Responses, cycles_of, undo_pile_up
from phasemark.render.direct.recordings import PlaneRecording

SHAPE_FLOOR = 0.01
"""Share of a count by which the response may be off, in its fit."""

_FINE = np.arange(-2.5, 4.0, 0.25)
_TAIL = (4, 4.5, 5, 5.5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 18, 20, 23, 26, 30, 34, 40)
_FOOT = (-8.0, -6.5, -5.5, -4.5, -4.0, -3.5, -3.0)
_KNOTS = np.concatenate([_FOOT, _FINE, _TAIL])
"""Knots of a cubic spline, bins after the highest bin: a quarter of a bin about the peak, wider in the tail."""

_STEP = 1 / 32
_WINDOW = (8, 32)  # bins before and behind the highest that are fitted
_ROUNDS = 4
_RIDGE = 1e-6


@lru_cache(maxsize=1)
def _basis() -> NDArray[np.float64]:
    """Return every spline of the basis, already the mean over a bin, on a fine axis of delays."""
    padded = np.concatenate([[_KNOTS[0]] * 3, _KNOTS, [_KNOTS[-1]] * 3])
    x = np.clip(np.arange(_KNOTS[0], _KNOTS[-1] + _STEP / 2, _STEP), _KNOTS[0], _KNOTS[-1] - 1e-9)
    return np.asarray(BSpline.design_matrix(x, padded, 3).toarray())


def _at(delay: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the basis at delays in bins, (...,) to (..., splines)."""
    table = _basis()
    x = (delay - _KNOTS[0]) / _STEP
    inside = (x >= 0) & (x < len(table) - 1)
    k = np.clip(x, 0, len(table) - 2).astype(np.int64)
    f = np.clip(x - k, 0, 1)[..., None]
    return np.where(inside[..., None], table[k] * (1 - f) + table[k + 1] * f, 0.0)


def fit_responses(model: FitModel, p: Parameters, plane: PlaneRecording, crosstalk: NDArray[np.float64]) -> Responses:
    """Fit the response of each zone.

    Parameters
    ----------
    model : FitModel
    p : Parameters
        The geometry; delays count as part of the response, as if they were 0.
    plane : PlaneRecording
    crosstalk : (zones, bins) float64
        Expected counts of light from the sensor's own window.

    Returns
    -------
    Responses
    """
    light = model.transients(p, plane).sum(axis=1)
    measured = plane.frames.zone_counts
    drift = p["reference_gain"] * plane.frames.reference_shift_bins
    coefficients = [
        _fit_zone(light[:, k], model.axis.nodes_m / width, measured[:, k], drift, cycles_of(p), crosstalk[k])
        for k, width in enumerate(model.bin_widths_m(p))
    ]
    return _responses_of(np.stack(coefficients), crosstalk)


def _fit_zone(
    light: NDArray[np.float64],
    nodes_bins: NDArray[np.float64],
    measured: NDArray[np.float64],
    drift: NDArray[np.float64],
    cycles: float,
    crosstalk: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the spline of one zone, and at its end the delay of the highest bin, bins."""
    tops = measured.argmax(axis=1)
    mean_range = (light @ nodes_bins) / light.sum(axis=1)
    delay = float(np.median(tops - mean_range - drift))
    pieces = []
    for i, top in enumerate(tops):
        counts = undo_pile_up(measured[i], cycles)
        left = np.exp(-np.cumsum(counts) / cycles)  # how much an error of a count grows
        std = np.sqrt(np.maximum(measured[i], 1.0) / left**2 + (SHAPE_FLOOR * counts) ** 2)
        counts = counts - crosstalk
        ambient = counts[AMBIENT_BINS].mean()
        window = slice(max(top - _WINDOW[0], 0), min(top + _WINDOW[1], len(counts)))
        at, weight = _gathered(nodes_bins, light[i])
        bins = np.arange(len(counts))[window]
        design = np.einsum("bgs,g->bs", _at(bins[:, None] - at - delay - drift[i]), weight)
        pieces.append((design / std[window, None], ((counts - ambient) / std)[window], (counts - ambient).sum()))
    target = np.concatenate([y for _, y, _ in pieces])
    bright = np.array([b for *_, b in pieces])
    spline = np.zeros(_basis().shape[1])
    for turn in range(_ROUNDS):
        if turn:
            model = [design @ spline for design, *_ in pieces]
            bright = np.array([(m @ y) / (m @ m) for m, (_, y, _) in zip(model, pieces, strict=True)])
        stacked = np.vstack([b * design for b, (design, *_) in zip(bright, pieces, strict=True)])
        square = stacked.T @ stacked
        ridge = _RIDGE * np.trace(square) / len(square) * np.eye(len(square))
        spline = np.linalg.solve(square + ridge, stacked.T @ target)
    return np.concatenate([spline, [delay]])


def _gathered(
    nodes: NDArray[np.float64], light: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a zone's ranges gathered in a few pieces, and the share of light of each."""
    lit = np.flatnonzero(light > 1e-6 * light.max())
    groups = 24  # pieces that the ranges of a zone are gathered in
    group = np.arange(len(lit)) * min(groups, len(lit)) // len(lit)
    total = np.bincount(group, light[lit])
    return np.bincount(group, light[lit] * nodes[lit]) / total, total / total.sum()


def _responses_of(coefficients: NDArray[np.float64], crosstalk: NDArray[np.float64]) -> Responses:
    """Return cumulative responses from splines, beside the crosstalk that was taken out.

    The spline is the mean of the response over a bin about a delay. Its integral over delays, taken at the lower
    edges of bins, is the cumulative response convolved with half a bin's shift; sums of whole bins then telescope.
    """
    table = np.maximum(_basis() @ coefficients[:, :-1].T, 0.0).T  # (zones, delays)
    per_bin = round(1 / _STEP)
    n = table.shape[1]
    # C(x) = Σ_{m ≥ 0} mean(x − m): counts up to an edge at x, bins of one width
    padded = np.concatenate([table, np.zeros((len(table), per_bin))], axis=1)
    cumulative = np.zeros_like(padded)
    for k in range(padded.shape[1]):
        cumulative[:, k] = padded[:, k] + (cumulative[:, k - per_bin] if k >= per_bin else 0.0)
    scale = cumulative[:, n - 1 : n + per_bin - 1].mean(axis=1, keepdims=True)
    cumulative = cumulative / scale
    # a response is nowhere negative: halfway between the rising curves just above and just below
    above = np.maximum.accumulate(cumulative, axis=1)
    below = np.minimum.accumulate(cumulative[:, ::-1], axis=1)[:, ::-1]
    cumulative = 0.5 * (above + below)
    delays = coefficients[:, -1:]
    # zones have delays of their own, and one axis holds them all
    first = float(_KNOTS[0] + delays.min())
    length = n + per_bin + int(np.ceil((delays.max() - delays.min()) / _STEP))
    out = np.ones((len(table), length))
    x = first + _STEP * np.arange(length)
    own = _KNOTS[0] + _STEP * np.arange(padded.shape[1])
    for zone, row in enumerate(cumulative):
        out[zone] = np.interp(x, own + delays[zone], row, left=0.0, right=1.0)
    # the bin whose lower edge is b has its mean at delay b: the cumulative at its upper edge holds it
    return Responses(out, first + 1.0, _STEP, crosstalk)


def delays_of(responses: Responses) -> NDArray[np.float64]:
    """Return where half of each zone's response has arrived, bins; (zones,)."""
    x = responses.delays
    return np.array([np.interp(0.5, row, x) for row in np.maximum.accumulate(responses.cumulative, axis=1)])
