"""Known poses of the camera for a calibration, measured by the user and read from a CSV file."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import InputFileError, UsageError
from phasemark.inputs import read_text
from phasemark.inputs.table_cells import cells_of, finite_number
from phasemark.render.frames import MOST_TILT_DEG
from phasemark.render.view import VIEW_FIELDS, wrap_delta_rad

POLAR = ("distance_m", "delta_deg")
CARTESIAN = ("x_m", "y_m", "heading_deg")
TIMES = {"t_s": 1.0, "t_ms": 1e-3}
"""Columns of time stamps, with their unit in seconds."""
OPTIONAL = ("height_m", "pitch_deg", "roll_deg", "wall_m", "frames", *TIMES)
COLUMNS = (
    "either distance_m,delta_deg (and bearing_deg if the camera does not point at the landmark's axis) or"
    " x_m,y_m,heading_deg of the lens; optional height_m, pitch_deg, roll_deg, wall_m, frames, t_s or t_ms"
)
"""What a file of poses may have, in words."""
POSE_UNITS = (("distance_mm", 1e3), ("delta_deg", math.degrees(1)), ("bearing_deg", math.degrees(1)))
"""How the errors of a pose are told."""
_MOST_BYTES = 1 << 26
"""A pose is a line: this is half a million of them."""


@dataclass(frozen=True, eq=False)
class KnownPoses:
    """K poses of the camera, as views of the landmark (PHYSICS section 1).

    Parameters
    ----------
    distance_m, delta_rad, bearing_rad, height_m : (K,) float64
        The view as measured, before the mounting's own bearing and height are added.
    pitch_rad, roll_rad : (K,) float64, optional
        Tilt of what the camera is mounted on, outside the mounting's own (PHYSICS section 9). None: level.
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
    pitch_rad: NDArray[np.float64] = None  # type: ignore[assignment]
    roll_rad: NDArray[np.float64] = None  # type: ignore[assignment]
    wall_m: NDArray[np.float64] | None = None
    frames: NDArray[np.int64] | None = None
    place: tuple[str, ...] = ()
    time_s: NDArray[np.float64] | None = None

    def __post_init__(self) -> None:
        n = len(self.distance_m)
        for name in VIEW_FIELDS[4:]:
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(n))
        for name in (*VIEW_FIELDS, "wall_m", "time_s"):
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
        for name in VIEW_FIELDS[4:]:
            tilt_deg = np.degrees(getattr(self, name))
            if n and np.abs(tilt_deg).max() > MOST_TILT_DEG:
                k = int(np.abs(tilt_deg).argmax())
                raise UsageError(
                    f"{self.where(k)}: {name.removesuffix('_rad')} must be within ± {MOST_TILT_DEG:g}° (a positive"
                    f" pitch looks down), got {tilt_deg[k]:g}°"
                )

    def __len__(self) -> int:
        return len(self.distance_m)

    def __getitem__(self, index: slice | NDArray[np.integer]) -> KnownPoses:
        """Return some of the poses."""
        which = np.arange(len(self))[index]
        place = tuple(self.place[k] for k in which) if self.place else ()
        arrays = {name: values for name, values in vars(self).items() if name != "place"}
        taken: dict[str, Any] = {name: None if a is None else a[which] for name, a in arrays.items()}
        return KnownPoses(**taken, place=place)

    @classmethod
    def joined(cls, parts: Sequence[KnownPoses]) -> KnownPoses:
        """Return the poses of several recordings; what one of them lacks all lack."""
        joined: dict[str, Any] = {}
        for name in vars(parts[0]):
            values = [getattr(part, name) for part in parts]
            if name == "place":
                joined[name] = sum(values, ()) if all(values) else ()
            else:
                joined[name] = None if any(one is None for one in values) else np.concatenate(values)
        return cls(**joined)

    @property
    def are_tilted(self) -> bool:
        """Whether any pose has a pitch or a roll."""
        return bool(self.pitch_rad.any() or self.roll_rad.any())

    def where(self, k: int) -> str:
        """Name one pose in a message."""
        return self.place[k] if self.place else f"pose {k}"

    @classmethod
    def of_views(
        cls, view: NDArray[np.float64], *, place: tuple[str, ...] = (), time_s: NDArray[np.float64] | None = None
    ) -> KnownPoses:
        """Take whole views, (K, 6)."""
        columns = dict(zip(VIEW_FIELDS, np.ascontiguousarray(view.T), strict=True))
        return cls(**columns, place=place, time_s=time_s)

    @classmethod
    def polar(
        cls, distance_m: ArrayLike, delta_rad: ArrayLike, bearing_rad: ArrayLike = 0.0, height_m: ArrayLike = 0.0
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
    path: str | os.PathLike[str], *, landmark_xy_m: tuple[float, float] = (0.0, 0.0), landmark_yaw_rad: float = 0.0
) -> KnownPoses:
    """Read a CSV file with one pose a line and a header.

    Parameters
    ----------
    path : path-like
        Columns ``distance_m`` and ``delta_deg``, optionally ``bearing_deg``; or ``x_m``, ``y_m`` and ``heading_deg`` of
        the lens. In both cases optionally ``height_m`` (of the landmark above where it usually stands), ``wall_m``,
        ``frames``, ``t_s`` or ``t_ms``, the time stamp in the clock of the frames, and ``pitch_deg`` and ``roll_deg``,
        the tilt of what the camera is mounted on (a positive pitch looks down). Lines that start with ``#`` and empty
        ones are skipped.
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
    lines = [
        (f"{path}, line {k}", line)
        for k, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.startswith("#")
    ]
    if not lines:
        raise InputFileError(f"{path}: is empty; its columns must be {COLUMNS}")
    separator = next((sign for sign in ";\t" if sign in lines[0][1]), ",")
    (_, header), *table = [(where, cells_of(line, where, separator)) for where, line in lines]
    names = [name.strip() for name in header]
    is_polar = _check_header(path, names)
    if not table:
        raise InputFileError(f"{path}: has a header and no poses")
    columns: dict[str, list[float]] = {name: [] for name in names}
    for where, cells in table:
        if len(cells) != len(names):
            raise InputFileError(f"{where}: {len(cells)} values, must have {len(names)}")
        for name, cell in zip(names, cells, strict=True):
            columns[name].append(finite_number(cell if separator == "," else cell.replace(",", "."), where, name))
    values = {name: np.array(column) for name, column in columns.items()}
    x, y = landmark_xy_m
    distances = values["distance_m"] if is_polar else np.hypot(values["x_m"] - x, values["y_m"] - y)
    farthest_m = 20.0
    for (where, _), distance, count in zip(table, distances, values.get("frames", np.ones(len(table))), strict=True):
        if not 0 < distance < farthest_m:
            raise InputFileError(
                f"{where}: the lens is {distance:g} m from the landmark, must be more than 0 and less than"
                f" {farthest_m:g} m: the columns are in metres"
            )
        if count != int(count) or count < 1:
            raise InputFileError(f"{where}: 'frames' must be a number of frames, got {count:g}")
    if is_polar:
        bearing_rad = np.radians(values.get("bearing_deg", 0.0))
        poses = KnownPoses.polar(values["distance_m"], np.radians(values["delta_deg"]), bearing_rad)
    else:
        heading_rad = np.radians(values["heading_deg"])
        poses = KnownPoses.cartesian(
            values["x_m"], values["y_m"], heading_rad, landmark_xy_m=landmark_xy_m, landmark_yaw_rad=landmark_yaw_rad
        )
    none = np.zeros(len(table))
    try:
        return replace(
            poses,
            height_m=values.get("height_m", poses.height_m),
            pitch_rad=np.radians(values.get("pitch_deg", none)),
            roll_rad=np.radians(values.get("roll_deg", none)),
            wall_m=values.get("wall_m"),
            frames=values["frames"].astype(np.int64) if "frames" in values else None,
            place=tuple(where for where, _ in table),
            time_s=next((scale * values[name] for name, scale in TIMES.items() if name in values), None),
        )
    except UsageError as error:  # an angle that cannot be
        raise InputFileError(str(error)) from None


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
