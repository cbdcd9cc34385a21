"""What a drive leaves behind: tables of the path and of the stops, a summary, a figure and an animation."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.data import write_atomically
from phasemark.data.files.csv_cell import as_cell
from phasemark.matcher.drive.simulate import Drive, Stop, pose_error
from phasemark.matcher.statistics import nees

OUTPUTS = ("path.csv", "stops.csv", "summary.json", "drive.png", "drive.gif")
"""Files that :func:`write_drive` writes."""

_POSES = ("true", "dead", "corrected")
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_COVARIANCE = ("xx_m2", "xy_m2", "xh_m_deg", "yy_m2", "yh_m_deg", "hh_deg2")
_DEGREES = np.array([1.0, 1.0, math.degrees(1.0)])


def path_csv(drive: Drive) -> str:
    """Return every step: time, way, true, dead-reckoned and corrected pose, and the covariance of the last."""
    header = ["time_s", "way_m"]
    header += [f"{pose}_{name}" for pose in _POSES for name in ("x_m", "y_m", "heading_deg")]
    header += [f"covariance_{name}" for name in _COVARIANCE]
    poses = (drive.true, drive.dead_reckoned, drive.corrected)
    columns = [drive.time_s[:, None], drive.way_m[:, None], *(pose * _DEGREES for pose in poses)]
    rows = np.concatenate([*columns, _flat(drive.covariance)], axis=1)
    return _csv(header, ([f"{value:.9g}" for value in row] for row in rows))


def stops_csv(drive: Drive) -> str:
    """Return every stop: true view, match, measured pose, errors before and after, and both covariances."""
    header = [
        *("time_s", "way_m", "landmark", "class", "used", "predicted_across_std_m"),
        *("true_distance_m", "true_delta_deg", "true_bearing_deg", "pan_deg"),
        *("found", "accepted", "p_value", "distance_m", "delta_deg", "bearing_deg", "distance_squared"),
        *(f"measured_{name}" for name in ("x_m", "y_m", "heading_deg")),
        *(f"true_{name}" for name in ("x_m", "y_m", "heading_deg")),
        *(f"{when}_error_{name}" for when in ("before", "after") for name in ("x_m", "y_m", "heading_deg")),
        *(f"{when}_covariance_{name}" for when in ("before", "after") for name in _COVARIANCE),
    ]
    return _csv(header, (_stop_row(stop) for stop in drive.stops))


def _stop_row(stop: Stop) -> list[object]:
    match = stop.match
    measured = [math.nan] * 3 if stop.measured is None else (stop.measured * _DEGREES).tolist()
    errors = [pose_error(pose, stop.true) * _DEGREES for pose in (stop.before, stop.after)]
    covariances = _flat(np.stack([stop.covariance_before, stop.covariance_after]))
    numbers = [
        *(match.p_value, match.distance_m, math.degrees(match.delta_rad), math.degrees(match.bearing_rad)),
        *(stop.distance_squared, *measured, *(stop.true * _DEGREES), *errors[0], *errors[1], *covariances.ravel()),
    ]
    view = [stop.view[0], math.degrees(stop.view[1]), math.degrees(stop.view[2]), math.degrees(stop.pan_rad)]
    return [
        *(f"{stop.time_s:.9g}", f"{stop.way_m:.9g}", stop.landmark.name, stop.landmark.class_name, int(stop.used)),
        *(f"{value:.9g}" for value in (stop.predicted_across_std_m, *view)),
        *(match.class_name or "none", int(match.accepted)),
        *(f"{value:.9g}" if math.isfinite(value) else "" for value in numbers),
    ]


def summary(drive: Drive) -> dict[str, Any]:
    """Return the figures of a drive as plain numbers, for JSON; None where there is nothing to tell."""
    used = drive.corrections
    after = np.array([pose_error(stop.after, stop.true) for stop in used]).reshape(-1, 3)
    before = np.array([pose_error(stop.before, stop.true) for stop in used]).reshape(-1, 3)
    consistency = {}
    for when, errors in (("before", before), ("after", after)):
        covariances = np.array([getattr(stop, f"covariance_{when}") for stop in used]).reshape(-1, 3, 3)
        consistency[when] = float(nees(errors, covariances).mean()) / 3 if used else None
    return {
        "seed": drive.seed,
        "way_m": float(drive.way_m[-1]),
        "time_s": float(drive.time_s[-1]),
        "stops": len(drive.stops),
        "corrections": len(used),
        "position_rms_after_correction_m": _rms(after[:, :2]) if used else None,
        "heading_rms_after_correction_deg": math.degrees(_rms(after[:, 2:])) if used else None,
        "position_rms_before_correction_m": _rms(before[:, :2]) if used else None,
        "heading_rms_before_correction_deg": math.degrees(_rms(before[:, 2:])) if used else None,
        "nees_per_dimension_before_correction": consistency["before"],
        "nees_per_dimension_after_correction": consistency["after"],
        **_drift("dead_reckoned", drive.dead_reckoned, drive.true),
        **_drift("corrected", drive.corrected, drive.true),
        "plan": drive.plan.model_dump(mode="json", by_alias=True),
    }


def _drift(name: str, pose: NDArray[np.float64], true: NDArray[np.float64]) -> dict[str, float]:
    """Return how far a path is off at the end, and at its worst."""
    error = pose_error(pose, true)
    distance, heading = np.hypot(error[:, 0], error[:, 1]), np.degrees(np.abs(error[:, 2]))
    return {
        f"{name}_final_position_error_m": float(distance[-1]),
        f"{name}_final_heading_error_deg": float(heading[-1]),
        f"{name}_largest_position_error_m": float(distance.max()),
        f"{name}_largest_heading_error_deg": float(heading.max()),
    }


def write_drive(drive: Drive, folder: Path, *, force: bool = False) -> list[Path]:
    """Write :data:`OUTPUTS` into a folder that exists.

    Parameters
    ----------
    drive : Drive
    folder : Path
    force : bool
        Whether existing files may be replaced.

    Returns
    -------
    list of Path

    Raises
    ------
    OutputExistsError, StorageError
        A file cannot be written.
    """
    from phasemark.matcher.drive.figures import drive_animation, drive_figure  # matplotlib is slow to import

    figure = io.BytesIO()
    drive_figure(drive).savefig(figure, format="png", dpi=130)
    text = json.dumps(summary(drive), indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    contents = (
        path_csv(drive).encode(),
        stops_csv(drive).encode(),
        text.encode(),
        figure.getvalue(),
        drive_animation(drive),
    )
    return [
        write_atomically(folder / name, content, force=force) for name, content in zip(OUTPUTS, contents, strict=True)
    ]


def _flat(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the upper triangle of covariances of (x, y, heading), headings in degrees, (n, 6)."""
    scaled = covariance * np.outer(_DEGREES, _DEGREES)
    return np.stack([scaled[:, i, j] for i, j in _UPPER], axis=1)


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))


def _csv(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(map(as_cell, row) for row in rows)
    return buffer.getvalue()
