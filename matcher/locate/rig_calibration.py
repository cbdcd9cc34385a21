"""Calibration of a rig: what its sensors share over recordings, the unknowns of each stop eliminated.

Minimised are the costs of all stops, their priors, the priors of the rig, and for each stop the difference between its
pose and the one that was measured, in which each robot of each recording has a marker frame of its own. A turn of all
sensors is a turn of all marker frames: the mean yaw of the sensors stays as the rig states it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.locate.kernel_arguments import RigNumbers, Scan
from phasemark.matcher.locate.recording import RigRecording
from phasemark.matcher.locate.rig import Rig
from phasemark.matcher.locate.scan_fit import StopModel, fit_stop
from phasemark.matcher.locate.scan_rows import AGE, N_BODY, SCALE, SENSOR_X, SENSOR_Y, SENSOR_YAW, STEP
from phasemark.matcher.locate.wall_map import WallMap

_Float = NDArray[np.float64]

FREE = ("yaw", "position", "delay", "offset", "scale", "fov")
"""Parameters of a rig that are estimated by default; ``walls`` may be added."""
_MARKER_STD = (0.005, 0.005, math.radians(3.0))
"""Of a marker frame in the body: x, y (m), yaw (rad)."""
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
        x, y (m), yaw (rad) of the marker frame in the body.
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
        self.rig, self.recordings, self.free = rig, recordings, free
        self.maps = list({id(one): one for one in wall_maps}.values())
        self.of_map = [next(m for m, other in enumerate(self.maps) if other is one) for one in wall_maps]
        self.stops = [(r, k) for r, table in enumerate(poses) for k in range(len(table)) if np.isfinite(table[k]).all()]
        if len(self.stops) < _FEWEST_STOPS:
            raise UsageError(f"at least {_FEWEST_STOPS} stops must have a pose, got {len(self.stops)}")
        self.truth = [poses[r][k] for r, k in self.stops]
        self.theta: dict[int, _Float] = {}
        self.doubt = [np.ones(3)] * len(self.stops)
        self.groups = sorted({(r, int(recordings[r].robot[k])) for r, k in self.stops})
        self._layout()
        self.value = np.zeros(len(self.std))
        self.information, self.gradient = np.zeros((len(self.std),) * 2), np.zeros(len(self.std))

    def _layout(self) -> None:
        """Lay out the parameters: of the rig, of the marker frames, of the walls; with prior standard deviations."""
        own = [one.std for one in self.rig.sensor]
        self.place: dict[str, slice] = {}
        std: list[float] = []

        def add(name: str, values: Sequence[float]) -> None:
            self.place[name] = slice(len(std), len(std) + len(values))
            std.extend(max(value, 1e-9) for value in values)

        for name in self.free:
            if name == "yaw":
                add("yaw", [math.radians(one.yaw_deg) for one in own])
            elif name == "position":
                add("x", [one.position_m for one in own])
                add("y", [one.position_m for one in own])
            elif name == "delay":
                add("delay", [one.delay_s for one in own])
            elif name == "offset":
                add("offset", [one.range_offset_m for one in own])
            elif name == "scale":
                add("scale", [own[0].range_scale])
            elif name == "fov":  # relative: sensors may have different ones
                add("fov", [own[0].fov_deg / (math.degrees(abs(self.start.step_rad[0])) * self.start.columns[0])])
        for group in self.groups:
            add(f"marker {group}", _MARKER_STD)
        for m, one in enumerate(self.maps if "walls" in self.free else []):
            outline = one.outline()
            if not (outline.std_m > 0).any():
                raise UsageError("'std_m' of a map's walls must be positive where walls are free")
            add(f"walls {m}", np.where(outline.std_m > 0, outline.std_m, 1e-9).tolist())
        self.std = np.array(std)

    @property
    def start(self) -> RigNumbers:
        """Numbers of the assumed rig."""
        return self.rig.numbers()

    def _of(self, name: str) -> _Float:
        """Return the present values of a parameter, 0 where it is not free."""
        return self.value[self.place[name]] if name in self.place else np.zeros(1)

    @property
    def numbers(self) -> RigNumbers:
        """Present numbers of the rig."""
        s = self.start
        return RigNumbers(
            s.yaw_rad + self._of("yaw"), s.x_m + self._of("x"), s.y_m + self._of("y"), s.delay_s + self._of("delay"),
            s.offset_m + self._of("offset"), s.scale + self._of("scale"), s.step_rad * (1 + self._of("fov")),
            s.columns, s.footprint,
        )  # fmt: skip

    def round(self) -> float:
        """Fit every stop, gather the normal equations, and return the r.m.s. residual of what is explained."""
        n = len(self.std)
        self.information, self.gradient = np.diag(self.std**-2.0), -self.value / self.std**2
        if "yaw" in self.place:
            own = np.zeros(n)
            own[self.place["yaw"]] = 1.0
            weight = _TIED / self.std[self.place["yaw"]].mean() ** 2
            self.information += weight * np.outer(own, own)
            self.gradient -= weight * own * (own @ self.value)
        models = []
        for m, one in enumerate(self.maps):
            moved = self._of(f"walls {m}")[: len(one.walls)]
            outline = (one.with_walls_moved(moved) if f"walls {m}" in self.place else one).outline()
            models.append(StopModel.of(self.rig, outline, self.numbers))
        squares, count, self.explained = 0.0, 0.0, 0.0
        for i in range(len(self.stops)):
            added = self._add(i, models[self.of_map[self.stops[i][0]]])
            squares, count, self.explained = squares + added[0], count + added[1], self.explained + added[2]
        self.explained /= len(self.stops)
        return math.sqrt(squares / max(count, 1.0))

    def _add(self, i: int, model: StopModel) -> tuple[float, float, float]:
        """Add one stop, its unknowns eliminated; return weighted squares, weights and the explained share."""
        r, k = self.stops[i]
        recording, truth = self.recordings[r], self.truth[i]
        scan = recording.scan(k)
        marker = f"marker {(r, int(recording.robot[k]))}"
        cos, sin = math.cos(truth[2]), math.sin(truth[2])
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])  # into the body's frame
        std = np.sqrt(np.diag(self.maps[self.of_map[r]].part) + np.square(_TRUTH_STD))
        precision = turn.T @ np.diag(self.doubt[i] / std**2) @ turn
        mean = truth + turn.T @ self._of(marker)
        fit = fit_stop(model, scan, self.theta.get(i, mean), (mean, precision),
                       (1.0,) if i in self.theta else (8.0, 3.0, 1.0))  # fmt: skip
        self.theta[i] = fit.theta
        own, common, residual = self._linearised(model, scan, fit.theta, i)
        left = fit.theta[:3] - mean
        left[2] = math.remainder(left[2], math.tau)
        left = turn @ left
        n = len(fit.theta)
        own_information, pull = own.T @ own, own.T @ residual
        own_information[range(3, n), range(3, n)] += model.unknowns_std**-2.0
        pull[3:] -= fit.theta[3:] / model.unknowns_std**2
        weight = np.diag(self.doubt[i] / std**2)
        by_pose = np.zeros((3, n))
        by_pose[:, :3] = turn
        own_information += by_pose.T @ weight @ by_pose
        pull -= by_pose.T @ weight @ left
        cross, information, gradient = common.T @ own, common.T @ common, common.T @ residual
        place = self.place[marker]
        cross[place] -= weight @ by_pose
        information[place, place] += weight
        gradient[place] += weight @ left
        solved = np.linalg.solve(own_information, np.column_stack([cross.T, pull]))
        self.information += information - cross @ solved[:, :-1]
        self.gradient += gradient - cross @ solved[:, -1]
        worst = float((np.abs(left[:2]) / std[:2]).max())
        off = np.array([worst, worst, abs(left[2]) / std[2]])
        self.doubt[i] = 1 / (1 + (off / _DOUBTFUL) ** 2)
        return float(residual @ residual), float(self.weight_sum), fit.share

    def _linearised(self, model: StopModel, scan: Scan, theta: _Float, i: int) -> tuple[_Float, _Float, _Float]:
        """Return slopes by the stop's unknowns and by common parameters, and residuals; whitened and weighted."""
        m = self.of_map[self.stops[i][0]]
        seen = model.prediction(theta, scan, walls=f"walls {m}" in self.place)
        sigma, sensors = model.sigma_m(seen), len(self.rig.sensor)
        used = np.isfinite(scan.depth_m) & np.isfinite(seen.depth_m)
        r = (scan.depth_m - seen.depth_m)[used] / sigma[used]
        kappa = model.outlier_density * sigma[used] * math.sqrt(2 * math.pi)
        likely = np.exp(-0.5 * np.minimum(r**2, 1400.0))
        weight = likely / (likely + kappa)
        self.weight_sum = weight.sum()
        scale = np.sqrt(weight) / sigma[used]
        slope, of = seen.slope[used], np.nonzero(used)[1]
        own = np.zeros((len(r), len(theta)))
        common = np.zeros((len(r), len(self.std)))
        row = np.arange(len(r))
        own[:, :N_BODY] = slope[:, :N_BODY]
        own[row, N_BODY + of] = 1.0
        own[row, N_BODY + sensors + of] = slope[:, SENSOR_YAW]
        columns = {
            "yaw": SENSOR_YAW,
            "x": SENSOR_X,
            "y": SENSOR_Y,
            "delay": AGE,
            "offset": None,
            "scale": SCALE,
            "fov": STEP,
        }
        for name, column in columns.items():
            if name not in self.place:
                continue
            first = self.place[name].start
            at = first + (of if name not in ("scale", "fov") else 0 * of)
            values = np.ones(len(r)) if column is None else slope[:, column]
            common[row, at] = values * model.numbers.step_rad[of] if name == "fov" else values
        if f"walls {m}" in self.place:
            common[:, self.place[f"walls {m}"]] = seen.wall_slope[used]
        return own * scale[:, None], common * scale[:, None], r * np.sqrt(weight)

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
        numbers, doubts, of_rig = [], [], {}
        units = {"yaw": (math.degrees(1.0), "°"), "x": (1e3, "mm"), "y": (1e3, "mm"), "delay": (1e3, "ms"),
                 "offset": (1e3, "mm"), "scale": (1.0, ""), "fov": (1.0, "of itself")}  # fmt: skip
        for name, (by, unit) in units.items():
            for j in range(*self.place[name].indices(len(std))) if name in self.place else ():
                k = j - self.place[name].start
                sensor = "" if name in ("scale", "fov") else self.rig.names[k]
                numbers.append((name, sensor, by * float(self.value[j]), by * float(std[j]), unit))
                if abs(self.value[j]) > _FAR * self.std[j]:
                    doubts.append(f"{name} of {sensor or 'all'} moved by {abs(self.value[j]) / self.std[j]:.1f} prior"
                                  " standard deviations")  # fmt: skip
        if self.explained < 0.7:
            doubts.append(f"{100 * self.explained:.0f} % of the columns are explained, 70 % are needed")
        if last > first:
            doubts.append(f"residuals grew from {first:.2f} to {last:.2f} standard deviations")
        sensors = np.ones(len(self.rig.sensor))
        for name, key, by in (("yaw", "yaw_deg", math.degrees(1.0)), ("delay", "delay_s", 1.0),
                              ("offset", "range_offset_m", 1.0), ("scale", "range_scale", 1.0)):  # fmt: skip
            if name in self.place:
                of_rig[key] = by * std[self.place[name]] * sensors
        if "x" in self.place:
            of_rig["position_m"] = np.maximum(std[self.place["x"]], std[self.place["y"]])
        if "fov" in self.place:
            of_rig["fov_deg"] = np.degrees(np.abs(self.numbers.step_rad)) * self.start.columns * std[self.place["fov"]]
        markers = tuple((self.recordings[r].run, robot, self._of(f"marker {(r, robot)}")) for r, robot in self.groups)
        walls = tuple(self._of(f"walls {m}") for m in range(len(self.maps))) if "walls" in self.free else ()
        return RigCalibration(self.rig.with_numbers(self.numbers, of_rig), tuple(numbers), markers, walls,
                              (first, last), len(self.stops), tuple(doubts))  # fmt: skip
