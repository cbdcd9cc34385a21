"""Information of a fit, lessened where its cost rises more slowly than the slopes at the answer say.

A covariance from slopes holds where the cost is a parabola. Costs with jumps and second hollows near the answer rise
less than it to a side. What a few standard deviations away costs is compared along some axes, and the information along
each is that of the slowest rise: the covariance then covers what explains the frame about as well.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

_AWAY = (1.0, 2.0, 3.0, 4.0)
"""Standard deviations away from the answer at which costs are compared, to both sides."""
_LEAST = 0.02
"""Share of the information along an axis that is left at least: seven times the standard deviation."""
_UNSEEN = 1e-9


def principal_axes(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the principal axes of some information, (p, p).

    A row an axis, as long as one standard deviation; NaN where nothing is known along it.
    """
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    known, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    seen = known > _UNSEEN
    return np.asarray(np.where(seen, vectors / scale[:, None] / np.sqrt(np.where(seen, known, 1.0)), np.nan).T)


def axes_of_parameters(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the step of least cost by which each parameter is one standard deviation off, (p, p), a row an axis.

    Where parameters are hardly correlated, the principal axes may lie between them, and show the slow rise of none.
    """
    axes = principal_axes(information)
    covariance = np.nansum(axes[:, :, None] * axes[:, None, :], axis=0)
    return np.asarray(covariance / np.sqrt(np.maximum(np.diag(covariance), 1e-300))[:, None])


def points_along(view: NDArray[np.float64], columns: Sequence[int], axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points at which the cost must be known, (a, k, 6).

    Parameters
    ----------
    view : (6,) float64
    columns : sequence of int
        Which numbers of the view are free.
    axes : (a, p) float64
    """
    away = np.array([side * k for k in _AWAY for side in (-1.0, 1.0)])
    points = np.tile(view, (len(axes), len(away), 1))
    points[:, :, columns] += away[None, :, None] * np.nan_to_num(axes)[:, None, :]
    return points


def lessened(
    information: NDArray[np.float64], axes: NDArray[np.float64], rise: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the information with no axis better known than the cost shows.

    Parameters
    ----------
    information : (p, p) float64
    axes : (a, p) float64
        As long as one standard deviation.
    rise : (a, k) float64
        How much more each point costs than the answer; NaN where it is outside of what is looked for.
    """
    away = np.array([k for k in _AWAY for _ in range(2)])
    share = np.fmin.reduce(rise / away**2, axis=1, initial=1.0)
    left = information.copy()
    for axis, of_axis in zip(axes, np.clip(share, _LEAST, 1.0), strict=True):
        if np.isfinite(axis).all():
            along = left @ axis
            known = max(float(axis @ along), 1e-300)  # 1, where no axis before it had a share of this one
            left -= max(1 - of_axis / known, 0.0) / known * np.outer(along, along)
    return left
