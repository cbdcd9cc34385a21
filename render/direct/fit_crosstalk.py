"""The crosstalk of a cover glass, from what a plane's histograms hold before the plane's own light."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar


class Crosstalk(NamedTuple):
    """Light that comes back from the sensor's own window.

    Parameters
    ----------
    counts : float
        Expected counts of a histogram, the same in every zone; 0 where the histograms show none.
    range_m : float
        Where it lies.
    counts_std, range_std_m : float
        Standard deviations, scaled by the residuals; that of the counts is the limit below which none is seen where
        `counts` is 0, and that of the range is then infinite.
    """

    counts: float
    range_m: float
    counts_std: float
    range_std_m: float


NO_CROSSTALK = Crosstalk(0.0, 0.0, math.nan, math.inf)
"""What is known where every histogram begins with the plane's own light."""


class _Early(NamedTuple):
    """Means over frames of the bins before the plane's light: counts and their variance, 0 where nothing is known."""

    counts: NDArray[np.float64]
    weight: NDArray[np.float64]


def fit_crosstalk(
    counts: NDArray[np.float64],
    cumulative: NDArray[np.float64],
    first: float,
    step: float,
    bin_widths_m: NDArray[np.float64],
) -> Crosstalk:
    """Estimate one peak at one range in all zones, above an ambient level of each zone.

    Counts are linear in the peak's height and in the levels, so both are solved for at every range tried.

    Parameters
    ----------
    counts : (n, zones, bins) float64
        Histograms of a plane at different distances, without pile-up.
    cumulative : (zones, nodes) float64
        Cumulative response of each zone.
    first, step : float
        Delay of node 0 and distance of nodes, bins.
    bin_widths_m : (zones,) float64

    Returns
    -------
    Crosstalk
    """
    early = _before_the_plane(counts)
    least_bins = 6
    known = (early.weight > 0).sum(axis=1) >= least_bins
    if not known.any():
        return NO_CROSSTALK
    early = _Early(early.counts[known], early.weight[known])
    widths, cumulative = bin_widths_m[known], cumulative[known]

    def peak_at(range_m: float) -> _Peak:
        return _peak(early, peak_shapes(cumulative, first, step, range_m / widths, early.counts.shape[1]))

    delay = float(np.mean([first + step * np.searchsorted(row, 0.5) for row in cumulative]))
    last = int(np.flatnonzero(early.weight.any(axis=0)).max())
    width = float(widths.mean())
    grid_bins = 0.25
    ranges = np.arange(-delay + 1, last - delay - 1, grid_bins) * width
    if not len(ranges):
        return NO_CROSSTALK
    gains = [peak_at(float(r)).gain for r in ranges]
    best = float(ranges[int(np.argmax(gains))])
    found = minimize_scalar(
        lambda r: -peak_at(r).gain,
        bounds=(best - grid_bins * width, best + grid_bins * width),
        method="bounded",
    )
    peak = peak_at(float(found.x))
    scale = max(peak.reduced_chi2, 1.0)
    std = math.sqrt(scale / peak.information) if peak.information > 0 else math.inf
    sure = 25.0  # by how much χ² must fall for a crosstalk to be told: five standard deviations
    if not (peak.height > 0 and peak.gain > sure * scale):
        return Crosstalk(0.0, 0.0, std, math.inf)
    aside_bins = 0.05  # for the curvature of χ²
    aside = aside_bins * width
    curvature = (2 * peak.gain - peak_at(found.x - aside).gain - peak_at(found.x + aside).gain) / aside**2
    range_std = math.sqrt(2 * scale / curvature) if curvature > 0 else math.inf
    return Crosstalk(peak.height, float(found.x), std, range_std)


def peak_shapes(
    cumulative: NDArray[np.float64], first: float, step: float, range_bins: NDArray[np.float64], bins: int
) -> NDArray[np.float64]:
    """Return the share of a peak that falls into each bin, (zones, bins).

    Parameters
    ----------
    cumulative : (zones, nodes) float64
        Cumulative response of each zone.
    first, step : float
        Delay of node 0 and distance of nodes, bins.
    range_bins : (zones,) float64
        Where the peak lies, in bins of each zone.
    bins : int
    """
    edges, delays = np.arange(bins + 1), first + step * np.arange(cumulative.shape[1])
    rows = [
        np.interp(edges - at, delays, row, left=0.0, right=1.0) for at, row in zip(range_bins, cumulative, strict=True)
    ]
    return np.diff(rows, axis=1)


class _Peak(NamedTuple):
    """A peak of given shapes: its height, its information, and by how much it lowers χ²."""

    height: float
    information: float
    gain: float
    reduced_chi2: float


def _peak(early: _Early, shapes: NDArray[np.float64]) -> _Peak:
    """Solve for the height of a peak, with a level of each zone, by weighted least squares."""
    w = early.weight
    total = w.sum(axis=1, keepdims=True)
    y = early.counts - (w * early.counts).sum(axis=1, keepdims=True) / total
    s = shapes - (w * shapes).sum(axis=1, keepdims=True) / total
    information = float((w * s * s).sum())
    if information <= 0:
        return _Peak(0.0, 0.0, 0.0, 0.0)
    height = float((w * s * y).sum()) / information
    gain = height * height * information if height > 0 else 0.0
    chi2 = float((w * (y - height * s) ** 2).sum())
    return _Peak(height, information, gain, chi2 / max(int(np.count_nonzero(w)) - len(w) - 2, 1))


def _before_the_plane(counts: NDArray[np.float64]) -> _Early:
    """Gather the bins before the plane's light over the frames in which they are."""
    n_bins = counts.shape[2]
    clear_bins = 10  # between the last bin that is taken and the highest one: the foot of the response is left out
    clear = np.arange(n_bins) < counts.argmax(axis=2)[..., None] - clear_bins
    n = clear.sum(axis=0)
    total = np.where(clear, counts, 0.0).sum(axis=0)
    mean = total / np.maximum(n, 1)
    # a mean of n Poisson counts has the variance mean / n; an empty bin still says something
    frames = np.maximum(n, 1)
    least_frames = 4
    weight: NDArray[np.float64] = np.where(n >= least_frames, frames / np.maximum(mean, 1.0 / frames), 0.0)
    return _Early(mean, weight)
