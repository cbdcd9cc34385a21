"""Poses in comma-separated values, as ``match --estimates`` writes them and recordings state their truth."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError
from phasemark.inputs import read_text
from phasemark.inputs.table_cells import cells_of, finite_number
from phasemark.matcher.match import named_in_degrees, scale_of_degrees
from phasemark.render import Views
from phasemark.render.view import VIEW_FIELDS

_TRUTH = "truth_"
_TIMES = {"time_s": 1.0, "t_s": 1.0, "t_ms": 1e-3}
_MOST_BYTES = 1 << 26


@dataclass(frozen=True, eq=False)
class PoseTable:
    """Poses of a file.

    Parameters
    ----------
    view : (n, 6) float64
        Distance, δ, bearing, height, pitch, roll; 0 where the file has no such column, NaN where a cell is empty.
    index : (n,) int64, optional
        Number of the position that each belongs to.
    accepted : (n,) bool
        True where the file does not say.
    time_s : (n,) float64, optional
    """

    view: NDArray[np.float64]
    index: NDArray[np.int64] | None
    accepted: NDArray[np.bool_]
    time_s: NDArray[np.float64] | None

    def __len__(self) -> int:
        return len(self.view)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Which rows hold a pose, (n,)."""
        return np.asarray(np.isfinite(self.view).all(axis=1))

    def views(self) -> Views:
        """Return the poses of a table in which every row holds one."""
        return Views.broadcast(*self.view.T)


def read_pose_table(path: str | os.PathLike[str]) -> PoseTable:
    """Read poses from a CSV file with a header; columns that are not named here are ignored.

    Parameters
    ----------
    path : path-like
        Columns `distance_m` and `delta_deg`, optionally `bearing_deg`, `height_m`, `pitch_deg` and `roll_deg`, or the
        same with ``truth_`` before them. Optionally `index`, `accepted` and a time stamp `time_s`, `t_s` or `t_ms`.
        Lines that start with ``#`` are skipped.

    Raises
    ------
    InputFileError
        The file cannot be read, a column is missing, or a value is no number; with file, line and column.
    """
    path = Path(path)
    text = read_text(path, most_bytes=_MOST_BYTES)
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if len(lines) < 2:
        raise InputFileError(f"{path}: must have a header and at least one pose")
    header, *rows = [cells_of(line, f"{path}, line {number}") for number, line in lines]
    names = [name.strip() for name in header]
    prefix = _TRUTH if f"{_TRUTH}distance_m" in names else ""
    for needed in ("distance_m", "delta_deg"):
        if prefix + needed not in names:
            raise InputFileError(f"{path}: no column '{prefix}{needed}', got {', '.join(names[:12])}")
    for (number, _), row in zip(lines[1:], rows, strict=True):
        if len(row) != len(names):
            raise InputFileError(f"{path}, line {number}: {len(row)} values, must have {len(names)}")
    columns: dict[str, tuple[str, ...]] = {}
    for name, cells in zip(names, zip(*rows, strict=True), strict=True):
        columns.setdefault(name, cells)
    place = [f"{path}, line {number}" for number, _ in lines[1:]]

    def column(name: str) -> NDArray[np.float64] | None:
        if name not in columns:
            return None
        cells = zip(columns[name], place, strict=True)
        return np.array([finite_number(cell, where, name, empty_is_nan=True) for cell, where in cells])

    found = {name: column(prefix + named_in_degrees(name)) for name in VIEW_FIELDS}
    zero = np.zeros(len(rows))
    view = [zero if values is None else values / scale_of_degrees(name) for name, values in found.items()]
    index = column("index")
    time_s = next((scale * values for name, scale in _TIMES.items() if (values := column(name)) is not None), None)
    accepted = [cell.strip().lower() in ("true", "1", "yes") for cell in columns.get("accepted", ["true"] * len(rows))]
    return PoseTable(
        np.column_stack(view),
        None if index is None else np.nan_to_num(index, nan=-1.0).astype(np.int64),
        np.array(accepted),
        time_s,
    )
