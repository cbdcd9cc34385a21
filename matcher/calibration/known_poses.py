"""Known poses of the camera for a calibration, measured by the user and read from a CSV file."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import InputFileError, UsageError
from phasemark.inputs import read_text
from phasemark.inputs.table_cells import cells_of, finite_number
from phasemark.render import Frames
from phasemark.render.view import wrap_delta_rad

POLAR = ("distance_m", "delta_deg")
CARTESIAN = ("x_m", "y_m", "heading_deg")
TIMES = {"t_s": 1.0, "t_ms": 1e-3}
"""Columns of time stamps, with their unit in seconds."""
OPTIONAL = ("height_m", "wall_m", "frames", *TIMES)
COLUMNS = (
    "either distance_m,delta_deg (and bearing_deg if the camera does not point at the landmark's axis) or"
    " x_m,y_m,heading_deg of the lens; optional height_m, wall_m, frames, t_s or t_ms"
)
"""What a file of poses may have, in words."""
POSE_UNITS = (("distance_mm", 1e3), ("delta_deg", math.degrees(1)), ("bearing_deg", math.degrees(1)))
"""How the errors of a pose are told."""
_FARTHEST_M = 20.0
_MOST_BYTES = 1 << 26
"""A pose is a line: this is half a million of them."""


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """K poses of the camera, as views of the landmark (PHYSICS section 1).

    Parameters
    ----------
    distance_m, delta_rad, bearing_rad, height_m : (K,) float64
        The view as measured, before the mounting's own bearing and height are added.
    wall_m : (K,) float64, optional
        Distance of a wall behind the landmark from the lens.
    frames : (K,) int64, optional
        Number of frames taken at each, where the file states it.
    place : tuple of str
        Where each stands in its file, for messages.
    time_s : (K,) float64, optional
        Time stamp of each pose, seconds, in the clock of the frames. Stamps may repeat or run backwards.
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    height_m: NDArray[np.float64]
    wall_m: NDArray[np.float64] | None = None
    frames: NDArray[np.int64] | None = None
    place: tuple[str, ...] = ()
    time_s: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        n = len(self.distance_m)
        for name in ("distance_m", "delta_rad", "bearing_rad", "height_m", "wall_m", "time_s"):
            values = getattr(self, name)
            if values is None:
                continue
            if values.shape != (n,):
                raise UsageError(f"'{name}' must have shape ({n},), one for each pose, got {values.shape}")
            if not np.isfinite(values).all():
                k = int(np.flatnonzero(~np.isfinite(values))[0])
                raise UsageError(f"{self.where(k)}: '{name}' must be a finite number, got {values[k]}")
        if n and not (self.distance_m > 0).all():
            k = int(self.distance_m.argmin())
            raise UsageError(f"{self.where(k)}: 'distance_m' must be positive, got {self.distance_m[k]:g}")

    def __len__(self) -> int:
        return len(self.distance_m)

    def __getitem__(self, index: slice | NDArray[np.integer]) -> KnownPoses:
        """Return some of the poses."""
        which = np.arange(len(self))[index]
        return KnownPoses(
            self.distance_m[which],
            self.delta_rad[which],
            self.bearing_rad[which],
            self.height_m[which],
            None if self.wall_m is None else self.wall_m[which],
            None if self.frames is None else self.frames[which],
            tuple(self.place[k] for k in which) if self.place else (),
            None if self.time_s is None else self.time_s[which],
        )

    def where(self, k: int) -> str:
        """Name one pose in a message."""
        return self.place[k] if self.place else f"pose {k}"

    @classmethod
    def polar(
        cls,
        distance_m: ArrayLike,
        delta_rad: ArrayLike,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
    ) -> KnownPoses:
        """Take distances and angles; scalars hold for all poses."""
        arrays = np.broadcast_arrays(
            *(np.asarray(v, np.float64) for v in (distance_m, delta_rad, bearing_rad, height_m))
        )
        distance, delta, bearing, height = (np.array(values, np.float64).ravel() for values in arrays)
        return cls(distance, delta, bearing, height)

    @classmethod
    def cartesian(
        cls,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
        heading_rad: NDArray[np.float64],
        *,
        landmark_xy_m: tuple[float, float] = (0.0, 0.0),
        landmark_yaw_rad: float = 0.0,
    ) -> KnownPoses:
        """Take places of the lens and headings of the optical axis, in the frame the landmark's own pose is given in.

        The inverse of equations (11) and (12), PHYSICS section 8: with the azimuth a of the line from lens to landmark,
        D is its length, δ = a − ψ and b = a − heading.
        """
        dx, dy = landmark_xy_m[0] - np.asarray(x_m, np.float64), landmark_xy_m[1] - np.asarray(y_m, np.float64)
        azimuth = np.arctan2(dy, dx)
        delta = wrap_delta_rad(azimuth - landmark_yaw_rad, 2 * math.pi)
        bearing = azimuth - np.asarray(heading_rad, np.float64)
        return cls(np.hypot(dx, dy), delta, np.angle(np.exp(1j * bearing)), np.zeros_like(dx))


@dataclass(frozen=True)
class PoseStd:
    """Standard deviations of the stated poses, independent from pose to pose.

    Parameters
    ----------
    position_m : float
        Of the lens, in both horizontal directions.
    heading_rad : float
        Of the optical axis.
    delta_rad : float
        Of the side δ beside that: how well the landmark is turned to it.
    """

    position_m: float = 0.0
    heading_rad: float = 0.0
    delta_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("position_m", "heading_rad", "delta_rad"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"'{name}' must be a standard deviation, zero or more, got {value!r}")

    @property
    def exact(self) -> bool:
        """Whether the poses are taken as they are."""
        return not (self.position_m or self.heading_rad or self.delta_rad)

    def factor(self, poses: KnownPoses) -> NDArray[np.float64]:
        """Return L with L Lᵀ the covariance of (D, δ, b) of each pose, (K, 3, 4).

        A lens moved along the line of sight changes D; moved across it by s it changes δ and b by s / D each; a heading
        changes b alone.
        """
        out = np.zeros((len(poses), 3, 4))
        across = self.position_m / poses.distance_m
        out[:, 0, 0] = self.position_m
        out[:, 1, 1] = out[:, 2, 1] = across
        out[:, 2, 2] = self.heading_rad
        out[:, 1, 3] = self.delta_rad
        return out


def read_poses(
    path: str | os.PathLike[str],
    *,
    landmark_xy_m: tuple[float, float] = (0.0, 0.0),
    landmark_yaw_rad: float = 0.0,
) -> KnownPoses:
    """Read a CSV file with one pose a line and a header.

    Parameters
    ----------
    path : path-like
        Columns ``distance_m`` and ``delta_deg``, optionally ``bearing_deg``; or ``x_m``, ``y_m`` and ``heading_deg`` of
        the lens. In both cases optionally ``height_m`` (of the landmark above where it usually stands), ``wall_m``,
        ``frames``, and ``t_s`` or ``t_ms``, the time stamp in the clock of the frames. Lines that start with ``#`` and
        empty ones are skipped.
    landmark_xy_m : (float, float)
        Where the landmark stands on the map, for the second form.
    landmark_yaw_rad : float
        Which way its front looks there.

    Returns
    -------
    KnownPoses

    Raises
    ------
    InputFileError
        The file cannot be read, a column is missing or unknown, or a value is no number, not finite or impossible; one
        line that names file, line and column.
    """
    path = Path(path)
    text = read_text(path, most_bytes=_MOST_BYTES)
    lines = [(k, line) for k, line in enumerate(text.splitlines(), 1) if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputFileError(f"{path}: is empty; its columns must be {COLUMNS}")
    separator = ";" if ";" in lines[0][1] else "\t" if "\t" in lines[0][1] else ","
    table = [cells_of(line, f"{path}, line {number}", separator) for number, line in lines]
    names = [name.strip() for name in table[0]]
    is_polar = _check_header(path, names)
    if len(table) == 1:
        raise InputFileError(f"{path}: has a header and no poses")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for (number, _), cells in zip(lines[1:], table[1:], strict=True):
        if len(cells) != len(names):
            raise InputFileError(f"{path}, line {number}: {len(cells)} values, must have {len(names)}")
        for name, cell in zip(names, cells, strict=True):
            text = cell if separator == "," else cell.replace(",", ".")
            columns[name].append(finite_number(text, f"{path}, line {number}", name))
    place = tuple(f"{path}, line {number}" for number, _ in lines[1:])
    values = {name: np.array(column) for name, column in columns.items()}
    zero = np.zeros(len(place))
    distances = values.get("distance_m")
    if distances is None:
        distances = np.hypot(values["x_m"] - landmark_xy_m[0], values["y_m"] - landmark_xy_m[1])
    for where, distance in zip(place, distances, strict=True):
        if not 0 < distance < _FARTHEST_M:
            raise InputFileError(
                f"{where}: the lens is {distance:g} m from the landmark, must be more than 0 and less than"
                f" {_FARTHEST_M:g} m: the columns are in metres"
            )
    if is_polar:
        bearing = np.radians(values.get("bearing_deg", zero))
        seen = KnownPoses.polar(values["distance_m"], np.radians(values["delta_deg"]), bearing)
    else:
        seen = KnownPoses.cartesian(
            values["x_m"],
            values["y_m"],
            np.radians(values["heading_deg"]),
            landmark_xy_m=landmark_xy_m,
            landmark_yaw_rad=landmark_yaw_rad,
        )
    frames = None
    if "frames" in values:
        frames = values["frames"].astype(np.int64)
        for where, given, whole in zip(place, values["frames"], frames, strict=True):
            if given != whole or whole < 1:
                raise InputFileError(f"{where}: 'frames' must be a number of frames, got {given:g}")
    return KnownPoses(
        seen.distance_m,
        seen.delta_rad,
        seen.bearing_rad,
        values.get("height_m", zero),
        values.get("wall_m"),
        frames,
        place,
        next((scale * values[name] for name, scale in TIMES.items() if name in values), None),
    )


def _check_header(path: Path, names: list[str]) -> bool:
    """Return whether poses are polar; refuse a header that is neither form."""
    own = POLAR if POLAR[0] in names or POLAR[1] in names else CARTESIAN
    allowed = (*own, *OPTIONAL, *(("bearing_deg",) if own is POLAR else ()))
    for name in own:
        if name not in names:
            raise InputFileError(f"{path}: no column '{name}'; its columns must be {COLUMNS}")
    for name in names:
        if name not in allowed or names.count(name) > 1:
            problem = "unknown" if name not in allowed else "repeated"
            raise InputFileError(f"{path}: {problem} column '{name}'; its columns must be {COLUMNS}")
    if set(TIMES) <= set(names):
        raise InputFileError(f"{path}: columns 't_s' and 't_ms' state the same stamps twice: keep one of them")
    return own is POLAR


def frames_of_poses(frames: Sequence[Frames], poses: KnownPoses) -> list[Frames]:
    """Assign frames to each pose.

    Parameters
    ----------
    frames : sequence of Frames
        What was read from each file, in order: one position a pose; or one position whose frames belong to all poses
        in turn, `KnownPoses.frames` each or all the same number.
    poses : KnownPoses
        Known poses of the camera.

    Returns
    -------
    list of Frames
        One position each, as many as poses.

    Raises
    ------
    UsageError
        The numbers do not fit.
    """
    positions = [one[k : k + 1] for one in frames for k in range(len(one))]
    n = len(poses)
    if len(positions) == n:
        if poses.frames is not None:
            for k, (own, stated) in enumerate(zip(positions, poses.frames, strict=True)):
                if own.n_frames != stated:
                    raise UsageError(f"{poses.where(k)}: 'frames' says {stated}, but there are {own.n_frames}")
        return positions
    if len(positions) != 1:
        raise UsageError(f"there are {n} poses, but frames of {len(positions)} positions: each pose needs its own")
    whole = positions[0]
    total = whole.n_frames
    counts = poses.frames
    if counts is None:
        if total % n:
            raise UsageError(
                f"{total} frames cannot be shared among {n} poses alike: give each pose a file of its own, or a column"
                " 'frames' with the number of each"
            )
        counts = np.full(n, total // n)
    if counts.sum() != total:
        raise UsageError(f"the poses claim {counts.sum()} frames in all, but there are {total}")
    ends = np.cumsum(counts)
    return [whole.some_frames(int(end - count), int(end)) for count, end in zip(counts, ends, strict=True)]
