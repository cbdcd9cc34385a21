"""The test of a fit: how probable a larger χ² is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.filters.filtered_frames import FilteredFrames


def noise_tails(frames: FilteredFrames) -> NDArray[np.float64]:
    """Return what widens the law of χ² of each frame, (n, 2).

    The first is ν where the variances were estimated from the scatter of ν + 1 exposures, infinite elsewhere; the
    second the `overdispersion` of the sensor where they are those of its noise law, and that of the frames beside it.
    """
    if not frames.std_from_scatter:
        tails = np.tile([np.inf, frames.sensor.overdispersion], (len(frames), 1))
        if frames.overdispersion is not None:
            tails[:, 1] += frames.overdispersion
        return tails
    # the variance of F(1, ν) exists above 4
    return np.column_stack([np.maximum(usual_count(frames) - 1, 5.0), np.zeros(len(frames))])


def usual_count(frames: FilteredFrames) -> NDArray[np.float64]:
    """Return how many exposures the pixels of each frame are worth in the median of those that are any, (n,)."""
    count = frames.n_effective.reshape(len(frames), -1)
    known = (count > 0).sum(axis=1)
    ordered = np.sort(np.where(count > 0, count, np.inf), axis=1)
    middle = [ordered[np.arange(len(known)), np.maximum(rank, 0) // 2] for rank in (known - 1, known)]
    return np.where(known > 0, (middle[0] + middle[1]) / 2, 0.0)


def p_values_of(
    cost: NDArray[np.float64], dof: NDArray[np.integer] | NDArray[np.float64], tails: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the probability of a larger χ² for every fit, (m,); 0 where nothing is left to test.

    `tails`, (m, 2), are those of :func:`noise_tails`. Where variances were estimated from the scatter of ν + 1 frames,
    each squared residual follows F(1, ν); their sum is given a scaled χ² of the same mean and variance.
    """
    freedom, scale = _scaled(dof, tails)
    # a cost of 0 is a difference of sums, which may come out a hair below
    return np.asarray(np.where(dof > 0, special.chdtrc(freedom, np.maximum(cost, 0.0) / scale), 0.0))


def largest_costs(p: float, dof: NDArray[np.integer], tails: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the χ² whose p-value is p for every fit, (m,); arguments as for :func:`p_values_of`."""
    freedom, scale = _scaled(dof, tails)
    return np.asarray(scale * special.chdtri(freedom, p))


def _scaled(
    dof: NDArray[np.integer] | NDArray[np.float64], tails: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return degrees of freedom and factor of the scaled χ² of sums of `dof` squared residuals."""
    n, nu = np.maximum(dof, 1.0), np.minimum(tails[:, 0], 1e9)
    mean = n * nu / (nu - 2)
    variance = n * 2 * nu**2 * (nu - 1) / ((nu - 2) ** 2 * (nu - 4)) * (1 + tails[:, 1])
    return 2 * mean**2 / variance, variance / (2 * mean)


def worse_of_two(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the p-value of the smaller of two independent ones (Šidák)."""
    return np.asarray(1 - (1 - np.minimum(first, second)) ** 2)
