"""Times at which a sensor that runs by itself exposes frames and reports them."""

from __future__ import annotations

import math

import numpy as np

from phasemark import UsageError

_ON_TIME = 1e-6
"""Share of a period by which a sum of time steps may miss a multiple of it."""


class Cadence:
    """Schedule of frames that are exposed at a rate and reported some frames later, held until the next.

    The first frame is exposed when the time is first asked for, frame k of the following ones k periods later. Before
    that the sensor has looked at the same scene. What lies between two times that are asked for is not known: a frame
    shows the scene at the first of these that is not before its own.

    Parameters
    ----------
    rate_hz : float
    latency_frames : int
        Periods between a frame's exposure and its report.

    Raises
    ------
    UsageError
        The rate is not positive, or the latency negative.
    """

    def __init__(self, rate_hz: float, latency_frames: int) -> None:
        if not isinstance(rate_hz, int | float | np.number) or not (math.isfinite(rate_hz) and rate_hz > 0):
            raise UsageError(f"'rate_hz' must be positive, got {rate_hz!r}")
        if not isinstance(latency_frames, int | np.integer) or latency_frames < 0:
            raise UsageError(f"'latency_frames' must be 0, 1, 2, …, got {latency_frames!r}")
        self.rate_hz, self.latency_frames = float(rate_hz), int(latency_frames)
        self.restart()

    def restart(self) -> None:
        """Forget all frames: the next time that is asked for is the first."""
        self._start_s: float | None = None
        self._last_s, self._exposed = -math.inf, -1

    def restarts(self, time_s: float) -> bool:
        """Return True if a time is the first, or before the last."""
        return self._start_s is None or time_s < self._last_s

    def frames(self, time_s: float) -> tuple[range, int]:
        """Return the frames that are exposed at a time, and the one that is reported.

        Parameters
        ----------
        time_s : float
            Not before the last one.

        Returns
        -------
        exposed : range
            Numbers of frames, counted from the start.
        reported : int
            Number of the frame that was finished last.
        """
        if self._start_s is None:
            self._start_s = time_s
        self._last_s = time_s
        reported = math.floor((time_s - self._start_s) * self.rate_hz + _ON_TIME)
        newest = reported + self.latency_frames
        exposed = range(max(self._exposed + 1, reported), newest + 1)
        self._exposed = newest
        return exposed, reported
