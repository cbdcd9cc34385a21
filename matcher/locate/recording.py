"""Recordings of a rig: depths of columns at the frames of stops, and the odometry there; poses in tables."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from phasemark import InputFileError, UsageError
from phasemark.data.measured.recording import npz_arrays
from phasemark.inputs import read_text, read_whole
from phasemark.inputs.table_cells import cells_of, finite_number
from phasemark.matcher.locate.kernel_arguments import Scan
from phasemark.matcher.locate.rig import Rig, elevations_rad

_Float = NDArray[np.float64]

_MOST_BYTES = 1 << 30
_MOST_NUMBER = 2.0**31
"""Of stops, robots, seconds, metres and radians."""
_FASTEST_M_S, _FASTEST_RAD_S = 5.0, 12.0
"""Odometry that moves faster between two frames has jumped."""
_MOVED_M, _TURNED_RAD = 0.03, 0.05
"""While a robot moves by more, no sensor returns the same depths at each frame."""
_OTHER_WALL_M = 0.1
"""What a column sees changes by more where the robot has moved: noise and outliers of few columns do not."""
FEWEST_TO_STICK, FEWEST_COLUMNS = 3, 3
"""Frames that must agree to the last digit before a sensor counts as stuck, and columns: one may repeat by chance."""
HELD_S = 0.25
"""How long a fast log may hold the last depths of a slower sensor, seconds."""


@dataclass(frozen=True, eq=False)
class RigRecording:
    """Depths that the sensors of a rig measured at n stops of F frames, and the odometry.

    Parameters
    ----------
    depth_m : (n, F, S, C) float64
        Along the boresight, sensors in the order of the rig; NaN where there is none.
    time_s : (n, F) float64
        Times of the frames.
    moved : (n, F, 3) float64
        Odometry since the first frame, in the body's frame there: x, y (m), yaw (rad).
    odometry : (n, 3) float64, optional
        Pose of the odometry at the first frame, in a frame of its own.
    stop, robot : (n,) int64
    run : str
        Name of the recording.
    map_name : str, optional
        Name of the map that it was taken in.
    robot_key : str
        Word for `robot` in the recording and in tables made from it.
    notes : tuple of str
        What each stop has wrong: sensors that are stuck, odometry that jumps; empty strings elsewhere.
    zone_m : (n, F, S, R, C) float64, optional
        The depths of zones that those of columns were made from, row 0 at the top; None: the recording has no rows.
    earlier : (n, 4) float64, optional
        A time before the first frame of each stop, seconds less than 0 after that, and the odometry then, as `moved`.
        Data that are older than the first frame are older than the odometry that a stop begins with.
    """

    depth_m: _Float
    time_s: _Float
    moved: _Float
    odometry: _Float | None
    stop: NDArray[np.int64]
    robot: NDArray[np.int64]
    run: str = ""
    map_name: str | None = None
    robot_key: str = "robot"
    notes: tuple[str, ...] = ()
    zone_m: _Float | None = None
    earlier: _Float | None = None

    def __len__(self) -> int:
        return len(self.depth_m)

    def scan(self, k: int, frames: Sequence[int] | NDArray[np.int64] | None = None) -> Scan:
        """Return the frames of a stop, or some of them."""
        used = np.arange(self.depth_m.shape[1]) if frames is None else np.asarray(frames)
        depth, time_s = np.ascontiguousarray(self.depth_m[k][used]), self.time_s[k] - self.time_s[k, 0]
        track = np.column_stack([time_s, self.moved[k]])
        if self.earlier is not None:
            track = np.vstack([self.earlier[k], track])
        return Scan(time_s[used], depth, track[:, 0].copy(), track[:, 1:].copy())

    def zones(self, k: int, most: int) -> Scan | None:
        """Return the zones of a stop, row by row, in at most `most` of its frames; None without rows or zones."""
        if self.zone_m is None:
            return None
        zones = self.zone_m[k].reshape(*self.zone_m.shape[1:3], -1)
        used = np.flatnonzero(np.isfinite(zones).any(axis=(1, 2)))
        if not len(used):
            return None
        used = np.unique(used[np.linspace(0, len(used) - 1, most).astype(int)])
        return self.scan(k, used)._replace(depth_m=np.ascontiguousarray(zones[used]))

    def one(self, k: int) -> Self:
        """Return the recording of one stop alone."""
        own = slice(k, k + 1)
        cut = {name: getattr(self, name)[own] for name in ("depth_m", "time_s", "moved", "stop", "robot", "notes")}
        cut |= {
            name: value[own] for name in ("odometry", "zone_m", "earlier") if (value := getattr(self, name)) is not None
        }
        return replace(self, **cut)

    def first_frames(self, n: int) -> Self:
        """Return the recording with the first n frames of each stop; the odometry stays."""
        if not 1 <= n <= self.depth_m.shape[1]:
            raise UsageError(f"'frames' must be 1 … {self.depth_m.shape[1]}, got {n}")
        later = np.arange(self.depth_m.shape[1]) >= n
        return self.without(np.broadcast_to(later[:, None], self.depth_m.shape[:3]))

    def without(self, dropped: NDArray[np.bool_]) -> Self:
        """Return the recording without what some sensors measured in some frames, (n, F, S)."""
        zones = None if self.zone_m is None else np.where(dropped[..., None, None], np.nan, self.zone_m)
        return replace(self, depth_m=np.where(dropped[..., None], np.nan, self.depth_m), zone_m=zones)

    def key(self, k: int) -> tuple[str, int, int]:
        """Return run, stop and robot of a stop."""
        return self.run, int(self.stop[k]), int(self.robot[k])


def read_rig_recording(path: str | os.PathLike[str], rig: Rig) -> RigRecording:
    """Read a recording of a rig from an NPZ file.

    Parameters
    ----------
    path : path-like
        Arrays `z_m` or `range_m` (n, F, sensors, columns), or (n, F, sensors, rows, columns), NaN or status where
        invalid; `sensor` (sensors,), names; `frame_time_s` (F,) or (n, F). Optional: `status` like the depths;
        `sensor_read` (n, F, sensors); `odo_dx_m`, `odo_dy_m`, `odo_dyaw_rad` (n, F), odometry since the first frame in
        the axes of the odometry; `odometry_x_m`, `odometry_y_m`, `odometry_yaw_rad` (n,), its pose there; `stop` and
        `robot` or `drone` (n,); `run`, `map`. Without names of sensors they are in the order of the rig.
    rig : Rig
        Which sensors there are, which quantity, and how rows are reduced.

    Returns
    -------
    RigRecording

    Raises
    ------
    InputFileError
        The file cannot be read, an array is missing or of a wrong shape, times do not rise, or the recording lacks a
        sensor of the rig.
    """
    return rig_recording(_arrays(Path(path)), Path(path), rig)


def rig_recording(arrays: Mapping[str, NDArray[Any]], path: Path, rig: Rig) -> RigRecording:
    """Return the recording that the arrays of a file or of another source hold; parameters and errors as above."""
    name = next((name for name in ("z_m", "range_m") if name in arrays), None)
    if name is None:
        raise InputFileError(f"{path}: must have an array 'z_m' or 'range_m', got {', '.join(arrays) or 'nothing'}")
    depth = _number_array(arrays[name], path, name)
    if depth.ndim not in (4, 5):
        raise InputFileError(f"{path}: '{name}' must be (stops, frames, sensors, [rows,] columns), got {depth.shape}")
    if not depth.size:
        raise InputFileError(f"{path}: '{name}' must have at least one number, got {depth.shape}")
    n, frames = depth.shape[:2]
    depth = _of_sensors(_valid(depth, arrays, path, rig), arrays, path, rig)
    depth = _as_depth(depth, "range" if name == "range_m" else rig.quantity, rig)
    zones, depth = (None, depth) if depth.ndim == 4 else (depth, _columns(depth, path, rig))
    times = _needed(arrays, "frame_time_s", path)
    times = _number_array(times, path, "frame_time_s", (n, frames) if times.ndim == 2 else (frames,), True)
    time_s = np.broadcast_to(times, (n, frames))
    backwards = np.argwhere(np.diff(time_s, axis=1) <= 0)
    if len(backwards):
        k, f = backwards[0]
        raise InputFileError(f"{path}: 'frame_time_s' must rise, got {time_s[k, f + 1]:g} s after {time_s[k, f]:g} s in"
                             f" frame {f + 1} of stop {k}")  # fmt: skip
    moved, odometry = _odometry(arrays, path, n, frames)
    robot_key = "drone" if "drone" in arrays else "robot"
    stop, robot = (
        _whole(_number_array(arrays.get(key, default), path, key, (n,), True), path, key)
        for key, default in (("stop", np.arange(n)), (robot_key, np.zeros(n)))
    )
    run = str(arrays["run"]) if "run" in arrays else path.stem
    recording = RigRecording(depth, np.ascontiguousarray(time_s), moved, odometry, stop, robot, run,
                             str(arrays["map"]) if "map" in arrays else None, robot_key, zone_m=zones)  # fmt: skip
    return _judged(recording, rig)


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an NPZ file."""
    content = read_whole(path, most_bytes=_MOST_BYTES)
    if content[:2] != b"PK":
        raise InputFileError(f"{path}: must be an NPZ file of arrays")
    return npz_arrays(content, path)


def _needed(arrays: Mapping[str, NDArray[Any]], name: str, path: Path) -> NDArray[Any]:
    if name not in arrays:
        raise InputFileError(f"{path}: must have an array '{name}', got {', '.join(arrays)}")
    return arrays[name]


def _number_array(
    array: NDArray[Any], path: Path, name: str, shape: tuple[int, ...] | None = None, finite: bool = False
) -> _Float:
    """Return numbers of a file, refused unless they are real, of a shape, and finite."""
    if array.dtype.kind not in "fiub":
        raise InputFileError(f"{path}: '{name}' must be numbers, got {array.dtype}")
    if shape is not None and array.shape != shape:
        raise InputFileError(f"{path}: '{name}' must be {shape}, got {array.shape}")
    numbers = np.asarray(array, dtype=np.float64)
    if finite and not (np.abs(numbers) < _MOST_NUMBER).all():
        raise InputFileError(f"{path}: '{name}' must be finite numbers below {_MOST_NUMBER:g}")
    return numbers


def _whole(numbers: _Float, path: Path, name: str) -> NDArray[np.int64]:
    """Return numbers of a file, refused unless they are whole."""
    if len(broken := numbers[numbers != np.rint(numbers)]):
        raise InputFileError(f"{path}: '{name}' must be whole numbers, got {broken[0]:g}")
    return numbers.astype(np.int64)


def _valid(depth: _Float, arrays: Mapping[str, NDArray[Any]], path: Path, rig: Rig) -> _Float:
    """Return depths with NaN where they are no measurement."""
    good = np.isfinite(depth) & (depth > 0)
    if "status" in arrays:
        status = _number_array(arrays["status"], path, "status", depth.shape)
        good &= np.isin(status, rig.reduction.valid_status)
    if "sensor_read" in arrays:
        read = _number_array(arrays["sensor_read"], path, "sensor_read", depth.shape[:3]) != 0
        good &= read.reshape(*read.shape, *(1,) * (depth.ndim - 3))
    return np.where(good, depth, np.nan)


def _of_sensors(depth: _Float, arrays: Mapping[str, NDArray[Any]], path: Path, rig: Rig) -> _Float:
    """Return the sensors of the rig in its order."""
    count = depth.shape[2]
    names = [str(name) for name in np.ravel(arrays.get("sensor", rig.names))]
    if len(names) != count:
        raise InputFileError(f"{path}: has {count} sensors, but {len(names)} names of sensors")
    for name in rig.names:
        if names.count(name) != 1:
            found = "no sensor" if name not in names else "several sensors"
            raise InputFileError(f"{path}: {found} '{name}' of the rig, got {', '.join(names)}")
    most = {"columns": rig.numbers().columns.max()}
    if depth.ndim == 5:
        most["rows"] = max(rows for rows, _ in rig.rows())
    for (word, allowed), got in zip(most.items(), (depth.shape[-1], depth.shape[3]), strict=False):
        if got != allowed:
            raise InputFileError(f"{path}: has {got} {word}, but the sensors of the rig {allowed}")
    return np.ascontiguousarray(depth[:, :, [names.index(name) for name in rig.names]], dtype=np.float64)


def reduced_rows(zones_m: _Float, rig: Rig) -> _Float:
    """Return the depths of columns, (n, F, S, C), each of the valid zones in the rows that the rig names.

    Depths of rows of a sensor that is pitched are made those of the rows' mean, for walls.

    Raises
    ------
    UsageError
        The sensors do not have these rows.
    """
    first, last = rig.reduction.rows or (0, zones_m.shape[3] - 1)
    if not first <= last < (fewest := min(rows for rows, _ in rig.rows())) and rig.reduction.rows:
        raise UsageError(f"'reduction.rows' of the rig must be within its {fewest} rows, got {first, last}")
    zones_m = zones_m.copy()
    for s, level in enumerate(rig.levels()):
        if len(level) > 1:
            zones_m[:, :, s, first : last + 1] *= (level / level.mean())[:, None]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a column without a valid row is NaN
        reduce = np.nanmedian if rig.reduction.how == "median" else np.nanmean
        return np.ascontiguousarray(reduce(zones_m[:, :, :, first : last + 1], axis=3))


def _columns(zones_m: _Float, path: Path, rig: Rig) -> _Float:
    """Return the depths of columns of a file with rows."""
    try:
        return reduced_rows(zones_m, rig)
    except UsageError as error:
        raise InputFileError(f"{path}: {error}") from None


def _as_depth(depth: _Float, quantity: str, rig: Rig) -> _Float:
    """Return distances along the boresight."""
    if quantity == "z":
        return depth
    columns, step = rig.numbers().columns[:, None], rig.column_steps_rad()[:, None]
    across = np.tan((0.5 * (columns - 1) - np.arange(depth.shape[-1])) * step)
    if depth.ndim == 4:
        return np.asarray(depth / np.hypot(1.0, across))
    up = np.full((len(across), depth.shape[3]), np.nan)  # which a sensor with fewer rows has not
    for of_sensor, own in zip(up, rig.rows(), strict=True):
        of_sensor[: own[0]] = np.tan(elevations_rad(*own))
    return np.asarray(depth / np.sqrt(1.0 + across[:, None] ** 2 + up[:, :, None] ** 2))


def _odometry(arrays: Mapping[str, NDArray[Any]], path: Path, n: int, frames: int) -> tuple[_Float, _Float | None]:
    """Return the motion within each stop in the body's frame, and the pose at its first frame."""
    at_first = None
    names = ("odometry_x_m", "odometry_y_m", "odometry_yaw_rad")
    if any(name in arrays for name in names):
        columns = [_number_array(_needed(arrays, name, path), path, name, (n,), True) for name in names]
        at_first = np.column_stack(columns)
    within = ("odo_dx_m", "odo_dy_m", "odo_dyaw_rad")
    if not any(name in arrays for name in within):
        return np.zeros((n, frames, 3)), at_first
    columns = [_number_array(_needed(arrays, name, path), path, name, (n, frames), True) for name in within]
    world = np.stack(columns, axis=-1)
    world[..., 2] = np.unwrap(world[..., 2], axis=1)
    if at_first is None:
        raise InputFileError(f"{path}: '{within[-1]}' needs '{names[2]}', the yaw at the first frame")
    cos, sin = np.cos(at_first[:, 2, None]), np.sin(at_first[:, 2, None])
    x, y = cos * world[..., 0] + sin * world[..., 1], cos * world[..., 1] - sin * world[..., 0]
    return np.stack([x, y, world[..., 2]], axis=-1), at_first


def _judged(recording: RigRecording, rig: Rig) -> RigRecording:
    """Leave out sensors that are stuck while the robot moves, and note them and odometry that jumps."""
    stuck, notes = _stuck(recording), []
    for k in range(len(recording)):
        moved = recording.moved[k]
        found = [f"{name} is stuck" for name, one in zip(rig.names, stuck[k].any(axis=0), strict=True) if one]
        step = np.abs(np.diff(moved, axis=0)) / np.diff(recording.time_s[k])[:, None]
        if (step[:, :2] > _FASTEST_M_S).any() or (step[:, 2] > _FASTEST_RAD_S).any():
            found.append("odometry jumps")
        notes.append(", ".join(found))
    return replace(recording.without(stuck), notes=tuple(notes))


def _stuck(recording: RigRecording) -> NDArray[np.bool_]:
    """Return which frames of which sensors, (n, F, S), repeat others though the robot has moved.

    Odometry tells that; without it the other sensors, of which one sees other walls.
    """
    (n, frames, sensors), poses, time_s = recording.depth_m.shape[:3], recording.moved, recording.time_s
    series, stuck = recording.robot, np.zeros((n, frames, sensors), np.bool_)
    if recording.odometry is not None:
        yaw, moved = recording.odometry[:, None, 2], recording.moved
        x, y = (np.cos(yaw) * moved[..., k] + by * np.sin(yaw) * moved[..., 1 - k] for k, by in ((0, -1), (1, 1)))
        poses = recording.odometry[:, None] + np.stack([x, y, moved[..., 2]], axis=-1)
    for one in np.unique(series):
        k, f = np.repeat(np.flatnonzero(series == one), frames), np.tile(np.arange(frames), (series == one).sum())
        for s in range(sensors):
            seen = np.isfinite(recording.depth_m[k, f, s]).sum(axis=1) >= FEWEST_COLUMNS
            own_k, own_f = k[seen], f[seen]
            depth = recording.depth_m[own_k, own_f, s]
            runs = np.cumsum(np.r_[False, ~same_depths(depth[1:], depth[:-1])])[: len(depth)]
            for run in np.flatnonzero(np.bincount(runs) >= FEWEST_TO_STICK):
                where = own_k[runs == run], own_f[runs == run]
                lasts = len(set(where[0])) > 1 or np.ptp(time_s[where]) > HELD_S
                if recording.odometry is None:
                    has_gone = _see_others(np.delete(recording.depth_m[where], s, axis=1))
                else:
                    way = poses[where]
                    way[:, 2] = np.unwrap(way[:, 2])
                    has_gone = bool(has_moved(np.ptp(way, axis=0)))
                stuck[*where, s] = lasts and has_gone
    return stuck


def _see_others(depth_m: _Float) -> bool:
    """Return whether half of the columns of a sensor change by more than noise, from the first to the last frames.

    `depth_m` is (frames, S, C).
    """
    third = len(depth_m) // 3
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of columns without a depth
        step_m = np.abs(np.nanmedian(depth_m[:third], axis=0) - np.nanmedian(depth_m[-third:], axis=0))
    known = np.isfinite(step_m).sum(axis=1)
    return bool((2 * (step_m > _OTHER_WALL_M).sum(axis=1) > np.maximum(known, FEWEST_COLUMNS)).any())


def same_depths(one: _Float, other: _Float) -> NDArray[np.bool_]:
    """Return which sensors measured the same to the last digit, (…,), of depths (…, C)."""
    return np.asarray(((one == other) | np.isnan(one) & np.isnan(other)).all(axis=-1))


def has_moved(way: _Float) -> NDArray[np.bool_]:
    """Return whether steps x, y (m), yaw (rad), (…, 3), are so long that no sensor measures the same at both ends."""
    return np.asarray((way[..., :2].max(axis=-1) > _MOVED_M) | (way[..., 2] > _TURNED_RAD))


def read_stop_poses(path: str | os.PathLike[str]) -> dict[tuple[str, int, int], _Float]:
    """Read poses of stops from a CSV file with a header.

    Parameters
    ----------
    path : path-like
        Columns `x_m`, `y_m`, `yaw_deg`, `stop`, and where there are several `robot` or `drone` and `run`. Rows with an
        empty cell there, or `accepted` 0, are left out.

    Returns
    -------
    dict of (run, stop, robot) to (3,) float64
        x, y (m), yaw (rad); run is "" and robot 0 where the file does not say.

    Raises
    ------
    InputFileError
        The file cannot be read, a column is missing, or a value is no number; with file, line and column.
    """
    path = Path(path)
    text = read_text(path, most_bytes=_MOST_BYTES).splitlines()
    lines = [(number, line) for number, line in enumerate(text, 1) if line.strip()]
    header = [name.strip() for name in cells_of(lines[0][1], f"{path}, line {lines[0][0]}")] if lines else []
    if len(set(header)) < len(header):
        raise InputFileError(f"{path}: two columns have the same name, got {', '.join(header)}")
    for needed in ("stop", "x_m", "y_m", "yaw_deg"):
        if needed not in header:
            raise InputFileError(f"{path}: no column '{needed}', got {', '.join(header) or 'nothing'}")
    found = {}
    robot_key = "drone" if "drone" in header else "robot"
    for number, line in lines[1:]:
        where = f"{path}, line {number}"
        cells = cells_of(line, where)
        if len(cells) != len(header):
            raise InputFileError(f"{where}: {len(cells)} values, must have {len(header)}")
        row = dict(zip(header, cells, strict=True))
        x, y, yaw, stop = (
            finite_number(row[name], where, name, empty_is_nan=True) for name in ("x_m", "y_m", "yaw_deg", "stop")
        )
        if np.isnan([x, y, yaw, stop]).any() or row.get("accepted", "1").strip().lower() in ("0", "false", "no"):
            continue
        robot = finite_number(row.get(robot_key, "0"), where, robot_key)
        key = row.get("run", "").strip(), int(stop), int(robot)
        if key[1:] != (stop, robot):
            raise InputFileError(f"{where}: numbers of stops and robots must be whole, got {stop:g} and {robot:g}")
        if key in found:
            raise InputFileError(f"{where}: a second pose of stop {key[1]}")
        found[key] = np.array([x, y, np.radians(yaw)])
    return found


def refuse_stops_twice(recordings: Sequence[RigRecording]) -> None:
    """Refuse recordings of which two hold the same stop, which would count twice.

    Raises
    ------
    UsageError
    """
    counted = Counter(recording.key(k) for recording in recordings for k in range(len(recording)))
    for (run, stop, robot), times in counted.items():
        if times > 1:
            raise UsageError(
                f"run '{run}' has stop {stop} of robot {robot} {times} times in the recordings: give each stop once,"
                " and each run a name of its own"
            )


def poses_of(recording: RigRecording, table: Mapping[tuple[str, int, int], _Float]) -> _Float:
    """Return the pose of each stop of a recording in a table of poses, (n, 3); NaN where it has none."""
    missing = np.full(3, np.nan)
    found = []
    for k in range(len(recording)):
        run, stop, robot = recording.key(k)
        found.append(table.get((run, stop, robot), table.get(("", stop, robot), missing)))
    return np.array(found).reshape(-1, 3)
