"""Files of a drive: tables of the path and of the stops, a summary and a figure."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark.data.files.atomic_write import write_files
from phasemark.data.files.csv_cell import csv_text, nine_digits
from phasemark.data.files.json_text import json_text
from phasemark.matcher.drive.simulate import Drive, Stop, pose_error
from phasemark.render.png import figure_png

OUTPUTS = ("path.csv", "stops.csv", "summary.json", "drive.png")
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
    return csv_text([header, *(list(map(nine_digits, row)) for row in rows.tolist())])


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
    return csv_text([header, *map(_stop_row, drive.stops)])


def _stop_row(stop: Stop) -> list[object]:
    match = stop.match
    measured = [math.nan] * 3 if stop.measured is None else (stop.measured * _DEGREES).tolist()
    errors = [pose_error(pose, stop.true) * _DEGREES for pose in (stop.before, stop.after)]
    covariances = _flat(np.stack([stop.covariance_before, stop.covariance_after]))
    values = [
        *(stop.time_s, stop.way_m, stop.landmark.name, stop.landmark.class_name, stop.used),
        *(stop.predicted_across_std_m, stop.view[0], math.degrees(stop.view[1]), math.degrees(stop.view[2])),
        *(math.degrees(stop.pan_rad), match.class_name or "none", bool(match.accepted), match.p_value),
        *(match.distance_m, math.degrees(match.delta_rad), math.degrees(match.bearing_rad), stop.distance_squared),
        *(*measured, *(stop.true * _DEGREES), *errors[0], *errors[1], *covariances.ravel()),
    ]
    return list(map(nine_digits, values))


def write_drive(drive: Drive, folder: Path, *, force: bool = False) -> list[Path]:
    """Write :data:`OUTPUTS` into a folder that exists.

    Parameters
    ----------
    drive : Drive
        The drive.
    folder : Path
        Folder that the files go to.
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
    from phasemark.matcher.drive.figures import drive_figure  # matplotlib is slow to import

    figure = figure_png(drive_figure(drive), dpi=130)
    text = json_text(drive.as_dict(), indent=2, allow_nan=False) + "\n"
    contents = (path_csv(drive).encode(), stops_csv(drive).encode(), text.encode(), figure)
    return write_files(folder, dict(zip(OUTPUTS, contents, strict=True)), force=force)


def _flat(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the upper triangle of covariances of (x, y, heading), headings in degrees, (n, 6)."""
    scaled = covariance * np.outer(_DEGREES, _DEGREES)
    return np.stack([scaled[:, i, j] for i, j in _UPPER], axis=1)
