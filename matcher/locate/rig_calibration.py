"""Calibration of a rig: what its sensors share over recordings, the unknowns of each stop eliminated.

Minimised are the costs of all stops, their priors, the priors of the rig, and for each stop the difference between its
pose and the one that was measured, in which each robot of each recording has a marker frame of its own. A turn of all
sensors is a turn of all marker frames: the mean yaw of the sensors stays as the rig states it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.locate.kernel_arguments import RigNumbers, Scan
from phasemark.matcher.locate.plane import difference, turn_of
from phasemark.matcher.locate.recording import RigRecording
from phasemark.matcher.locate.rig import Rig
from phasemark.matcher.locate.scan_fit import StopModel, fit_stop
from phasemark.matcher.locate.scan_rows import AGE, N_BODY, SCALE, SENSOR_X, SENSOR_Y, SENSOR_YAW, STEP
from phasemark.matcher.locate.wall_map import WallMap

_Float = NDArray[np.float64]

FREE = ("yaw", "position", "delay", "offset", "scale", "fov")
"""Parameters of a rig that are estimated by default; ``walls`` may be added."""


class _Parameter(NamedTuple):
    """A free number of each sensor, or of all: what it adds to, its prior, and how it is shown."""

    part_of: str
    number: str
    """Field of :class:`RigNumbers`."""
    std: str
    """Field of :class:`~phasemark.matcher.locate.rig.SensorStd`, in `unit_of_std`."""
    unit_of_std: float
    column: int | None
    """Of the slopes; None: the slope is 1."""
    shown: tuple[float, str]
    """Factor and unit."""
    common: bool = False


_PARAMETERS = {
    "yaw": _Parameter("yaw", "yaw_rad", "yaw_deg", math.radians(1.0), SENSOR_YAW, (math.degrees(1.0), "°")),
    "x": _Parameter("position", "x_m", "position_m", 1.0, SENSOR_X, (1e3, "mm")),
    "y": _Parameter("position", "y_m", "position_m", 1.0, SENSOR_Y, (1e3, "mm")),
    "delay": _Parameter("delay", "delay_s", "delay_s", 1.0, AGE, (1e3, "ms")),
    "offset": _Parameter("offset", "offset_m", "range_offset_m", 1.0, None, (1e3, "mm")),
    "scale": _Parameter("scale", "scale", "range_scale", 1.0, SCALE, (1.0, ""), common=True),
    # sensors may have different fields of view: the part that is added to each
    "fov": _Parameter("fov", "step_rad", "fov_deg", math.radians(1.0), STEP, (1.0, "of itself"), common=True),
}
_MARKER_STD = (0.005, 0.005, math.radians(3.0))
"""Of the body in the frame of its markers: x, y (m), yaw (rad)."""
_TRUTH_STD = (0.002, 0.002, math.radians(0.15))
"""Of a measured pose, beside the part of the map."""
_DOUBTFUL = 2.0
"""Standard deviations from which a measured pose counts for half."""
_MOST_ROUNDS, _DONE = 8, 0.02
"""Rounds end when no parameter moves by more than this part of its prior standard deviation."""
_TIED = 1e10
"""Weight, in inverse squares of prior standard deviations, of what the gauge fixes."""
_FAR = 5.0
"""Prior standard deviations from which a result is doubted."""
_FEWEST_STOPS = 5


@dataclass(frozen=True, eq=False)
class RigCalibration:
    """A calibrated rig.

    Parameters
    ----------
    rig : Rig
    numbers : tuple of (name, sensor, value, std, unit)
        Every estimated number; the sensor is "" where all share it.
    markers : tuple of (recording, robot, (3,) float64)
        x, y (m), yaw (rad) of the body in the frame that the poses are of.
    wall_m : tuple of (walls,) float64
        By how much the walls of each map are displaced along their normals.
    rms : (before, after)
        Root mean square of the explained columns' residuals, in standard deviations.
    stops : int
    doubts : tuple of str
        Reasons not to trust the result.
    """

    rig: Rig
    numbers: tuple[tuple[str, str, float, float, str], ...]
    markers: tuple[tuple[str, int, _Float], ...]
    wall_m: tuple[_Float, ...]
    rms: tuple[float, float]
    stops: int
    doubts: tuple[str, ...]

    def as_dict(self) -> dict[str, object]:
        """Return the calibration as plain numbers."""
        names = "name", "sensor", "change", "std", "unit"
        return {
            "numbers": [dict(zip(names, row, strict=True)) for row in self.numbers],
            "markers": [
                {"recording": run, "robot": robot, "x_m": x, "y_m": y, "yaw_deg": math.degrees(yaw)}
                for run, robot, (x, y, yaw) in self.markers
            ],
            "stops": self.stops,
            "rms_before": self.rms[0],
            "rms_after": self.rms[1],
            "doubts": list(self.doubts),
        }


def calibrate_rig(
    rig: Rig,
    recordings: Sequence[RigRecording],
    wall_maps: Sequence[WallMap],
    poses: Sequence[_Float],
    free: Sequence[str] = FREE,
    progress: Callable[[int, int], None] | None = None,
) -> RigCalibration:
    """Estimate what the stops of several recordings share.

    Parameters
    ----------
    rig : Rig
        The assumed rig, with its priors.
    recordings : sequence of RigRecording
    wall_maps : sequence of WallMap
        Of each recording; the same object where recordings share their walls.
    poses : sequence of (n, 3) float64
        Measured x, y (m), yaw (rad) of each recording's stops; NaN where there is none: that stop takes no part.
    free : sequence of str
        Of ``yaw, position, delay, offset, scale, fov, walls``. Scale and field of view are common to all sensors. Walls
        move along their normals, by the map's `std_m`.
    progress : callable, optional
        Takes the number of rounds that are done, and of all.

    Returns
    -------
    RigCalibration

    Raises
    ------
    UsageError
        An unknown name, lists of different lengths, too few stops, walls without a standard deviation.
    """
    problem = _Problem(rig, recordings, wall_maps, poses, tuple(free))
    first = last = problem.round()
    for k in range(1, _MOST_ROUNDS):
        if progress is not None:
            progress(k, _MOST_ROUNDS)
        if problem.step() < _DONE:
            break
        last = problem.round()
    return problem.result(first, last)


def _unit(name: str, numbers: RigNumbers) -> _Float:
    """Return the unit of a parameter for each sensor, rad, m or s: of the field of view the whole of it."""
    return np.abs(numbers.step_rad) * numbers.columns if name == "fov" else np.ones(len(numbers.columns))


class _Problem:
    """Stops, what they share, and the normal equations of that."""

    def __init__(
        self,
        rig: Rig,
        recordings: Sequence[RigRecording],
        wall_maps: Sequence[WallMap],
        poses: Sequence[_Float],
        free: tuple[str, ...],
    ) -> None:
        for name in free:
            if name not in (*FREE, "walls"):
                raise UsageError(f"'free' must be of {', '.join((*FREE, 'walls'))}, got '{name}'")
        if not len(recordings) == len(wall_maps) == len(poses):
            raise UsageError(
                f"each recording must have a map and poses, got {len(recordings)} recordings, {len(wall_maps)} maps and"
                f" {len(poses)} tables of poses"
            )
        self.rig, self.start, self.recordings, self.truth = rig, rig.numbers(), recordings, poses
        self.free = {name: one for name, one in _PARAMETERS.items() if one.part_of in free}
        self.maps = list({id(one): one for one in wall_maps}.values())
        self.of_map = [next(m for m, other in enumerate(self.maps) if other is one) for one in wall_maps]
        self.stops = [(r, k) for r, table in enumerate(poses) for k in range(len(table)) if np.isfinite(table[k]).all()]
        if len(self.stops) < _FEWEST_STOPS:
            raise UsageError(
                f"at least {_FEWEST_STOPS} stops must have a pose, got {len(self.stops)} by the recording's run, stop"
                " and robot"
            )
        self.theta: dict[tuple[int, int], _Float] = {}
        self.doubt = {stop: np.ones(3) for stop in self.stops}
        self.groups = sorted({(r, int(recordings[r].robot[k])) for r, k in self.stops})
        self._layout("walls" in free)
        self.value = np.zeros(len(self.std))

    def _layout(self, walls: bool) -> None:
        """Lay out the parameters: of the rig, of the marker frames, of the walls; with prior standard deviations."""
        blocks: dict[object, Sequence[float] | _Float] = {}
        for name, one in self.free.items():
            std = one.unit_of_std * np.array([getattr(sensor.std, one.std) for sensor in self.rig.sensor])
            std /= _unit(name, self.start)
            blocks[name] = std[:1] if one.common else std
        blocks |= dict.fromkeys(self.groups, _MARKER_STD)
        for m, outline in enumerate([self.rig.outline_of(one) for one in self.maps] if walls else []):
            if not (outline.std_m > 0).any():
                raise UsageError("'std_m' of a map's walls must be positive where walls are free")
            blocks["walls", m] = outline.std_m
        self.std = np.maximum(np.concatenate(list(blocks.values())), 1e-9)
        ends = np.cumsum([len(std) for std in blocks.values()])
        self.place = {key: slice(end - len(std), end) for (key, std), end in zip(blocks.items(), ends, strict=True)}

    @property
    def numbers(self) -> RigNumbers:
        """Present numbers of the rig."""
        moved = {}
        for name, one in self.free.items():
            before = getattr(self.start, one.number)
            moved[one.number] = before + self.value[self.place[name]] * (before if name == "fov" else 1.0)
        return self.start._replace(**moved)

    def round(self) -> float:
        """Fit every stop, gather the normal equations, and return the r.m.s. residual of what is explained."""
        self.information, self.gradient = np.diag(self.std**-2.0), -self.value / self.std**2
        if "yaw" in self.place:
            own = np.zeros(len(self.std))
            own[self.place["yaw"]] = 1.0
            weight = _TIED / self.std[self.place["yaw"]].mean() ** 2
            self.information += weight * np.outer(own, own)
            self.gradient -= weight * own * (own @ self.value)
        models = []
        for m, one in enumerate(self.maps):
            if ("walls", m) in self.place:
                one = one.with_walls_moved(self.value[self.place["walls", m]][: len(one.walls)])
            models.append(StopModel(self.rig, self.rig.outline_of(one), self.numbers))
        self.columns = np.zeros((2, len(self.rig.sensor)))
        added = np.array([self._add(stop, models[self.of_map[stop[0]]]) for stop in self.stops])
        squares, count = added.sum(axis=0)
        return math.sqrt(squares / max(count, 1.0))

    def _add(self, stop: tuple[int, int], model: StopModel) -> tuple[float, float]:
        """Add one stop, its unknowns eliminated; return weighted squares and weights."""
        r, k = stop
        recording, truth, m = self.recordings[r], self.truth[r][k], self.of_map[r]
        scan, marker = recording.scan(k), self.place[r, int(recording.robot[k])]
        turn = turn_of(truth[2]).T  # into the body's frame
        std = np.sqrt(np.diag(self.maps[m].part) + np.square(_TRUTH_STD))
        weight = np.diag(self.doubt[stop] / std**2)
        mean = truth + turn.T @ self.value[marker]
        known = stop in self.theta
        fit = fit_stop(model, scan, self.theta.get(stop, mean), (mean, turn.T @ weight @ turn),
                       (1.0,) if known else (8.0, 3.0, 1.0))  # fmt: skip
        self.theta[stop] = fit.theta
        own, common, residual, total = self._linearised(model, scan, fit.theta, ("walls", m))
        left = turn @ difference(fit.theta[:3], mean)
        n = len(fit.theta)
        own_information, pull = own.T @ own, own.T @ residual
        own_information[range(3, n), range(3, n)] += model.unknowns_std**-2.0
        pull[3:] -= fit.theta[3:] / model.unknowns_std**2
        by_pose = np.zeros((3, n))
        by_pose[:, :3] = turn
        own_information += by_pose.T @ weight @ by_pose
        pull -= by_pose.T @ weight @ left
        cross, information, gradient = common.T @ own, common.T @ common, common.T @ residual
        cross[marker] -= weight @ by_pose
        information[marker, marker] += weight
        gradient[marker] += weight @ left
        solved = np.linalg.solve(own_information, np.column_stack([cross.T, pull]))
        self.information += information - cross @ solved[:, :-1]
        self.gradient += gradient - cross @ solved[:, -1]
        off = np.abs(left) / std
        off[:2] = off[:2].max()
        self.doubt[stop] = 1 / (1 + (off / _DOUBTFUL) ** 2)
        return float(residual @ residual), total

    def _linearised(
        self, model: StopModel, scan: Scan, theta: _Float, walls: tuple[str, int]
    ) -> tuple[_Float, _Float, _Float, float]:
        """Return slopes by the stop's unknowns and by common parameters, residuals, all whitened, and the weight."""
        seen, sensors = model.prediction(theta, scan, walls=walls in self.place), len(self.rig.sensor)
        used = np.isfinite(scan.depth_m) & np.isfinite(seen.depth_m)
        sigma = model.sigma_m(seen)[used]
        r = (scan.depth_m - seen.depth_m)[used] / sigma
        weight = model.explained(r, sigma)
        slope, of = seen.slope[used], np.nonzero(used)[1]
        own, common, row = np.zeros((len(r), len(theta))), np.zeros((len(r), len(self.std))), np.arange(len(r))
        own[:, :N_BODY] = slope[:, :N_BODY]
        own[row, N_BODY + of] = 1.0
        own[row, N_BODY + sensors + of] = slope[:, SENSOR_YAW]
        for name, one in self.free.items():
            values = np.ones(len(r)) if one.column is None else slope[:, one.column]
            at = self.place[name].start + (0 if one.common else of)
            common[row, at] = values * model.numbers.step_rad[of] if name == "fov" else values
        if walls in self.place:
            common[:, self.place[walls]] = seen.wall_slope[used]
        observed = np.isfinite(scan.depth_m).sum(axis=(0, 2))
        self.columns += np.stack([np.bincount(of, weight, sensors), observed])  # of each sensor: explained, observed
        scale = (np.sqrt(weight) / sigma)[:, None]
        return own * scale, common * scale, r * np.sqrt(weight), float(weight.sum())

    def step(self) -> float:
        """Move the common parameters, and return the largest move in prior standard deviations."""
        moved = np.linalg.solve(self.information * np.outer(self.std, self.std), self.gradient * self.std)
        self.value = self.value + moved * self.std
        return float(np.abs(moved).max())

    def result(self, first: float, last: float) -> RigCalibration:
        """Return the calibration; frames of a stop see the same walls, and count as fewer."""
        scaled = np.linalg.inv(self.information * np.outer(self.std, self.std))
        frames = np.mean([np.isfinite(self.recordings[r].depth_m[k]).any(axis=(1, 2)).sum() for r, k in self.stops])
        std = np.minimum(self.std * np.sqrt(np.diag(scaled) * max(1.0, float(frames) / 3)), self.std)
        numbers, doubts, of_rig = [], [], dict[str, _Float]()
        for name, one in self.free.items():
            by, unit = one.shown
            place = self.place[name]
            for j, value in enumerate(self.value[place]):
                sensor = "" if one.common else self.rig.names[j]
                numbers.append((name, sensor, by * float(value), by * float(std[place][j]), unit))
                if (off := abs(value) / self.std[place][j]) > _FAR:
                    doubts.append(f"{name} of {sensor or 'all'} moved by {off:.1f} prior standard deviations")
            own = std[place] * _unit(name, self.numbers) / one.unit_of_std
            of_rig[one.std] = np.maximum(own, of_rig.get(one.std, 0.0))
        for r, robot in self.groups:
            off = np.abs(self.value[self.place[r, robot]] / _MARKER_STD)
            if off.max() > _FAR:
                x, y, yaw = self.value[self.place[r, robot]]
                doubts.append(
                    f"poses of {self.recordings[r].run}, robot {robot}, are of a point {1e3 * math.hypot(x, y):.0f}"
                    f" mm from the robot's, {math.degrees(yaw):.1f}° off"
                )
        least_explained, growth, most_left = 0.7, 0.05, 1.2  # residuals of a right rig come and go by less
        for name, (explained, observed) in zip(self.rig.names, self.columns.T, strict=True):
            if not observed:
                doubts.append(f"{name} has no depths")
            elif explained < least_explained * observed:
                share = f"{100 * explained / observed:.0f} % of the columns of {name} are explained"
                doubts.append(f"{share}, {100 * least_explained:.0f} % are needed")
        if last > first + growth:
            doubts.append(f"residuals grew from {first:.2f} to {last:.2f} standard deviations")
        elif last > most_left:
            doubts.append(
                f"residuals of {last:.2f} standard deviations are left, {most_left:g} may be: is 'quantity' of the rig"
                " right, and [noise]?"
            )
        markers = tuple((self.recordings[r].run, robot, self.value[self.place[r, robot]]) for r, robot in self.groups)
        walls = [self.value[self.place["walls", m]] for m in range(len(self.maps)) if ("walls", m) in self.place]
        return RigCalibration(self.rig.with_numbers(self.numbers, of_rig), tuple(numbers), markers, tuple(walls),
                              (first, last), len(self.stops), tuple(doubts))  # fmt: skip
