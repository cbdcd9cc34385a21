"""Initial guess of a calibration: the mounting whose landmark outlines agree best with the pixels that returned."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.calibration.mounting import HALF_ANGLES, columns_of
from phasemark.matcher.calibration.mounting_model import LONGEST_STEP, CalibrationModel
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render.sensor.lens_fields import TERMS

_Float = NDArray[np.float64]

_PLACES = ("pitch", "roll", "height", "bearing")
OUTLINE = (*_PLACES, *HALF_ANGLES, *TERMS)
"""What an outline tells."""
_PLACE_STD, _OTHER_STD = 3.0, 0.7
"""Standard deviation of each about its initial guess, in natural units; the registration alone uses it."""
_RETURNS_FROM, _PREVAILS_FROM = 0.2, 0.6
"""Coverage that is enough for a return, and for one from the landmark if something stands behind; below, the chance of
it is taken to rise evenly."""
_TRIED = (-3.0, -1.5, 0.0, 1.5, 3.0)
"""Pitches and bearings, degrees, from which the registration may start: a pixel apart."""
_BESIDE = 0.02
"""Share of pixels with a return from elsewhere, above which something stands behind."""
_NEARBY_M = 0.1
"""A return so much farther from the landmark than its own size is something else."""


def register(model: CalibrationModel, evidence: Evidence, theta: _Float, free: Sequence[str]) -> _Float:
    """Move a mounting to where the landmark's outlines agree with which pixels returned from near it.

    Gauss–Newton on coverage less return, over differences of a seventh of a pixel, from the best of several pitches
    and bearings. It needs no amplitudes, comes from two degrees away to some tenths of a pixel, and cares little what
    stands behind.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
    theta : (22,) float64
        Initial guess of the mounting.
    free : sequence of str
        What may move.

    Returns
    -------
    (22,) float64
    """
    if not free:
        return theta
    seen = evidence.seen
    near = np.abs(seen.range_m - model.poses.distance_m[:, None]) < model.reach_m + _NEARBY_M
    target = np.where(seen.returned & near, 1.0, 0.0)
    known = seen.returned | seen.not_returned
    if not (known & ~seen.returned).any() and (target[known] == 1).all():
        known = np.ones_like(known)  # nothing was distinguished: a missing pixel returned nothing
    enough = _PREVAILS_FROM if (seen.returned & ~near).mean() > _BESIDE else _RETURNS_FROM
    columns = columns_of(free)
    scale = model.scale[columns]
    prior = np.where(np.isin(free, _PLACES), _PLACE_STD, _OTHER_STD)

    outline_noise = 0.2  # of a pixel: how much of it the model says returns, against whether it did

    def difference(at: _Float) -> _Float:
        returns = np.minimum(model.coverage(at) / enough, 1.0)
        return np.asarray(np.where(known, target - returns, 0.0) / outline_noise).ravel()

    def cost(at: _Float) -> float:
        away = (at - theta)[columns] / scale / prior
        return float((difference(at) ** 2).sum() + (away**2).sum())

    outline_width = 0.2  # half width of its differences, natural units: a seventh of a pixel

    def slope(at: _Float, column: int) -> _Float:
        unit = model.scale[column]
        high, low, span = model.beside(at, column, unit * outline_width)
        return np.asarray((difference(low) - difference(high)) / (span / unit))

    tried = [theta]
    for name in ("pitch", "bearing"):
        if name in free:
            own = columns_of([name])
            tried = [model.stepped(one, own, side * model.scale[own]) for one in tried for side in _TRIED]
    best = min(tried, key=cost)
    outline_steps = 6
    for _ in range(outline_steps):
        design = np.array([slope(best, column) for column in columns])
        away = (best - theta)[columns] / scale
        matrix = design @ design.T + np.diag(1 / prior**2)
        step = np.linalg.solve(matrix, design @ difference(best) - away / prior**2)
        step /= max(1.0, float(np.abs(step).max()) / LONGEST_STEP)
        moved = model.stepped(best, columns, scale * step)
        if cost(moved) >= cost(best):
            break
        best = moved
    return best
