"""Outcome of a frame in a live session, and its form in JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.live.tracker import Located
from phasemark.matcher.locate.recording import RigRecording
from phasemark.render import Frames


@dataclass(frozen=True, eq=False)
class Update:
    """Outcome of one frame.

    Parameters
    ----------
    number : int
        Of the frame, from 0.
    frames : Frames or RigRecording
        The frame.
    stamp_s : float
        Its stamp on the source's clock; when it arrived where the source has none.
    pose_stamp_s : float
        Time of the pose on that clock: the stamp with the sensor's delay.
    time_s : float
        Time of the pose on our clock, seconds since 1970; of a recording the same as `pose_stamp_s`.
    located : Located
        What was found.
    reason : str
        Why the pose is not published; empty where it is.
    latency_s : float
        From the last byte of the frame to this.
    """

    number: int
    frames: Frames | RigRecording
    stamp_s: float
    pose_stamp_s: float
    time_s: float
    located: Located
    reason: str
    latency_s: float

    @property
    def zones_m(self) -> NDArray[np.float64]:
        """Ranges as a grid, or a row for each sensor of a rig."""
        own = self.frames
        return np.asarray(own.range_m[0, 0] if isinstance(own, Frames) else own.depth_m[0, -1])

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON: metres and degrees, in the covariance too."""
        found = self.located.estimate
        row: dict[str, Any] = {
            "index": self.number,
            **{name: getattr(self, name) for name in ("stamp_s", "pose_stamp_s", "time_s")},
            "accepted": not self.reason,
            "reason": self.reason,
            "latency_ms": 1e3 * self.latency_s,
            "tracked": self.located.tracked,
            "match": None if self.located.match is None else self.located.match.reason,
        }
        if not self.reason and found.pose is not None and found.covariance is not None:
            unit = np.array([1.0, 1.0, math.degrees(1.0)])
            x_m, y_m, heading = (unit * found.pose).tolist()
            row |= {"x_m": x_m, "y_m": y_m, "heading_deg": heading}
            row["covariance"] = (np.outer(unit, unit) * found.covariance).tolist()
        return row


def plain_rows(values: NDArray[np.float64]) -> Any:
    """Return numbers as lists for JSON, None where there is none."""
    if values.ndim > 1:
        return [plain_rows(row) for row in values]
    return [value if math.isfinite(value) else None for value in values.tolist()]
