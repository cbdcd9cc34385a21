"""Weighted linear least squares, as the data sheet and the fit of a sensor use it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def weighted_fit(design: Floats, target: Floats, std_error: Floats) -> tuple[Floats, Floats]:
    """Solve weighted least squares, columns scaled; return the solution and its covariance.

    Parameters
    ----------
    design : (n, m) float64
    target : (n,) float64
    std_error : (n,) float64
        Standard deviation of each target.

    Returns
    -------
    (m,) float64, (m, m) float64
    """
    weighted = design / std_error[:, None]
    scale = np.linalg.norm(weighted, axis=0)
    weighted /= scale
    covariance = np.linalg.inv(weighted.T @ weighted)
    return covariance @ (weighted.T @ (target / std_error)) / scale, covariance / np.outer(scale, scale)
