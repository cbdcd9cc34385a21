"""The table that ``phasemark locate`` writes: a line a stop, with its covariance and all poses that explain it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from phasemark.data.files.csv_cell import csv_text, nine_digits
from phasemark.matcher.locate.locator import LocatedPose

_COVARIANCE = {"xx": (0, 0), "xy": (0, 1), "xa": (0, 2), "yy": (1, 1), "ya": (1, 2), "aa": (2, 2)}


def pose_csv(answers: Sequence[LocatedPose], robot_key: str = "robot") -> str:
    """Return answers as CSV: metres and degrees, covariances in m², m °, °².

    Parameters
    ----------
    answers : sequence of LocatedPose
    robot_key : str
        Heading of the column of robots.

    Returns
    -------
    str
        Alternatives stand as (x y yaw: weight). Height, pitch and roll follow where they were asked for.
    """
    head = ["run", "stop", robot_key, "x_m", "y_m", "yaw_deg", *_COVARIANCE, "accepted", "reason", "explained",
            "observed", "note", "alternatives"]  # fmt: skip
    unit = (1.0, 1.0, math.degrees(1.0))
    tilts = ["z_m", "pitch_deg", "roll_deg", "z_std_m", "pitch_std_deg", "roll_std_deg"]
    tilts = tilts if any(one.tilt is not None for one in answers) else []
    rows = [head + tilts]
    for one in answers:
        covariance = [float(one.covariance[i, j]) * unit[i] * unit[j] for i, j in _COVARIANCE.values()]
        others = " ".join(
            f"({c.x_m:.4f} {c.y_m:.4f} {math.degrees(c.yaw_rad):.3f}: {c.weight:.4g})" for c in one.alternatives
        )
        row = [*one.key, one.x_m, one.y_m, math.degrees(one.yaw_rad), *covariance, one.accepted, one.reason,
               one.explained, one.observed, one.note, others]  # fmt: skip
        if tilts:
            numbers = one.as_dict()
            row += [numbers.get(name, math.nan) for name in tilts]
        rows.append([nine_digits(value) for value in row])
    return csv_text(rows)
