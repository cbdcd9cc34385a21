"""Poses of a moving camera by time: smoothed, interpolated at the times of frames, with their rates.

Recorders of poses stamp in coarse steps, repeat stamps and sometimes run backwards. A stamp that is not later than all
before it is dropped. Between gaps, the rest is smoothed by a quadratic fitted about each knot with Gaussian weights
(local polynomial regression), which keeps positions and rates of turn free of the jitter of single poses; knots are
joined by cubic Hermite splines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import interpolate

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.filters.stamps import stamp_jitter
from phasemark.render.view import VIEW_FIELDS

LONGEST_GAP_S = 0.25
"""Longest time between two poses that is bridged."""
_WIDTH_STEPS, _LEAST_WIDTH_S = 1.5, 0.03
"""Standard deviation of the weights: in median steps of the stamps, and at least in seconds."""
_REACH = 4.0
"""Standard deviations beyond which a pose has no weight."""
_FEWEST = 4
"""Poses between two gaps that make a piece of track."""


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Views of a moving camera by time.

    Parameters
    ----------
    pieces : tuple of (start_s, end_s, spline)
        Stretches of time without gaps; each spline gives (..., 6) metres and radians.
    dropped : int
        Number of poses left out because their stamp repeats or runs backwards.
    jitter_s : float
        How far stamps are at least uncertain, standard deviation: 0 where none repeats.
    """

    pieces: tuple[tuple[float, float, interpolate.CubicHermiteSpline], ...]
    dropped: int
    jitter_s: float = 0.0

    @classmethod
    def of(cls, poses: KnownPoses) -> PoseTrack:
        """Smooth poses with time stamps.

        Parameters
        ----------
        poses : KnownPoses
            With `time_s`.

        Raises
        ------
        UsageError
            The poses have no time stamps, or too few of them follow one another.
        """
        if poses.time_s is None:
            raise UsageError("the poses have no time stamps: a moving camera takes a column t_ms or t_s")
        first = np.concatenate([[True], poses.time_s[1:] > np.maximum.accumulate(poses.time_s)[:-1]])
        time = poses.time_s[first]
        values = np.column_stack(
            [np.unwrap(getattr(poses, name)) if name.endswith("_rad") else getattr(poses, name) for name in VIEW_FIELDS]
        )[first]
        ends = np.flatnonzero(np.diff(time) > LONGEST_GAP_S) + 1
        parts = np.split(np.arange(len(time)), ends)
        pieces = [_smooth(time[part], values[part]) for part in parts if len(part) >= _FEWEST]
        if not pieces:
            raise UsageError(
                f"no {_FEWEST} poses follow one another within {LONGEST_GAP_S:g} s each: are their stamps in the unit"
                " of their column, t_ms or t_s?"
            )
        return cls(tuple(pieces), int((~first).sum()), stamp_jitter(poses.time_s))

    def known(self, start_s: NDArray[np.float64], end_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return True where a stretch of time lies between two gaps, (n,)."""
        inside = [(start_s >= start) & (end_s <= end) for start, end, _ in self.pieces]
        return np.asarray(np.any(inside, axis=0))

    def at(self, time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return poses and their rates at some times.

        Parameters
        ----------
        time_s : (n,) float64
            Times in a gap get the nearest end of a piece, without motion.

        Returns
        -------
        value, rate : (n, 6) float64
            Distance, δ, bearing, height, pitch, roll; metres and radians, and per second.
        """
        starts = np.array([start for start, _, _ in self.pieces])
        stops = np.array([end for _, end, _ in self.pieces])
        away = np.maximum(np.maximum(starts - time_s[:, None], time_s[:, None] - stops), 0.0)
        piece = away.argmin(axis=1)
        value, rate = np.empty((len(time_s), 6)), np.empty((len(time_s), 6))
        for k, (start, end, spline) in enumerate(self.pieces):
            own = piece == k
            if own.any():
                inside = np.clip(time_s[own], start, end)
                value[own] = spline(inside)
                rate[own] = np.where((inside == time_s[own])[:, None], spline(inside, 1), 0.0)
        return value, rate


def _smooth(
    time: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[float, float, interpolate.CubicHermiteSpline]:
    """Return a piece of track: local quadratics at evenly spaced knots, joined by a cubic Hermite spline."""
    step = float(np.median(np.diff(time)))
    width = max(_WIDTH_STEPS * step, _LEAST_WIDTH_S)
    knots = np.linspace(time[0], time[-1], max(2, int(np.ceil((time[-1] - time[0]) / (width / 1.5))) + 1))
    value, rate = np.empty((len(knots), values.shape[1])), np.empty((len(knots), values.shape[1]))
    for k, knot in enumerate(knots):
        low, high = np.searchsorted(time, [knot - _REACH * width, knot + _REACH * width])
        low, high = min(low, max(len(time) - _FEWEST, 0)), max(high, min(low + _FEWEST, len(time)))
        x = (time[low:high] - knot) / width
        root = np.exp(-(x**2) / 4) + 1e-6
        design = np.stack([np.ones_like(x), x, x**2], axis=1) * root[:, None]
        found = np.linalg.lstsq(design, values[low:high] * root[:, None], rcond=None)[0]
        value[k], rate[k] = found[0], found[1] / width
    return float(time[0]), float(time[-1]), interpolate.CubicHermiteSpline(knots, value, rate)
