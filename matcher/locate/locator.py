"""Localisation among known walls: all poses that explain a stop, and the rules by which one of them is accepted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from phasemark import UsageError
from phasemark.matcher.locate.kernel_arguments import Scan
from phasemark.matcher.locate.plane import difference, relative_pose
from phasemark.matcher.locate.pose_search import pose_grid, promising_poses
from phasemark.matcher.locate.recording import RigRecording
from phasemark.matcher.locate.rig import Rig
from phasemark.matcher.locate.scan_fit import WIDTHS, StopFit, StopModel, along_profiles, fit_stop, std_without_one
from phasemark.matcher.locate.wall_map import WallMap
from phasemark.matcher.locate.zones_in_space import SpaceModel
from phasemark.matcher.match import TOLERATED_SIGMA
from phasemark.matcher.pixel_agreement import DISAGREEMENT

_Float = NDArray[np.float64]

LocateReason = Literal["", "no zones", "odometry jumps", "poor fit", "undetermined", "ambiguous", "unexpected"]
_SAME_FRAMES = 3
"""Frames of a stop that count as one opinion: what the map has wrong is wrong in all of them, and in all rows."""
_MOST_STARTS, _MOST_REFINED = 32, 12
_NARROW = 2.0, 1.0
"""Noise of the rounds of a descent from near a pose, in that of the rig."""
_HOPELESS = 4 * DISAGREEMENT
"""Cost by which a start may exceed the best one after a descent on three frames."""
_MOST_OUTLIERS = 2.0
"""Outliers of a pose that no prior speaks for, in those of the rig's noise: another room explains four columns of five.
"""
_LONGEST_MAP = 500.0
"""Length of a map over the reach of the sensors beyond which one of them has another unit: a room of 3 m in millimetres
has 750 and more."""
_LEAST_STD = 1e-6
"""Smallest standard deviation of a start, m and rad."""
_SPEAKS_FOR, _CONTRADICTS = special.chdtri(3, [1e-2, 1e-4]).tolist()
"""Squared distances of a pose from its prior, in standard deviations: up to which a prior speaks for the pose, and
above which one of them is wrong."""
_REACH_SIGMA = 3.5
"""Half the width of the region that is searched around a prior, in its standard deviations."""


class PoseCandidate(NamedTuple):
    """A pose that explains a stop: x, y (m), yaw (rad), how much more it costs than the best, and its share."""

    x_m: float
    y_m: float
    yaw_rad: float
    cost: float
    weight: float
    explained: float


@dataclass(frozen=True, eq=False)
class LocatedPose:
    """Answer for one stop.

    Parameters
    ----------
    key : (run, stop, robot)
    x_m, y_m, yaw_rad : float
        The best pose at the first frame; NaN where there is none.
    covariance : (3, 3) float64
        Of x, y (m), yaw (rad): noise, the unknowns of the stop, the prior, and the part of the map; NaN without a pose.
    explained : float
        Share of the observed columns that the pose explains.
    observed : int
        Columns that were observed.
    accepted : bool
    reason : str
        No zones, odometry jumps, poor fit, undetermined, ambiguous, unexpected: why it is refused. Empty if accepted.
    alternatives : tuple of PoseCandidate
        All poses that explain the stop nearly as well, best first, the answer itself among them.
    note : str
        What is wrong with the recording there.
    evidence : (pose, information), optional
        Pose and inverse covariance that the stop's frames alone speak for, without the prior and the part of the map.
    tilt : (values, covariance), optional
        Height above the map's zero (m), pitch (down) and roll (rad), (3,), and their covariance, (3, 3), where they
        were asked for.
    """

    key: tuple[str, int, int]
    x_m: float = math.nan
    y_m: float = math.nan
    yaw_rad: float = math.nan
    covariance: _Float = field(default_factory=lambda: np.full((3, 3), np.nan))
    explained: float = 0.0
    observed: int = 0
    accepted: bool = False
    reason: LocateReason = "no zones"
    alternatives: tuple[PoseCandidate, ...] = ()
    note: str = ""
    evidence: tuple[_Float, _Float] | None = None
    tilt: tuple[_Float, _Float] | None = None

    @property
    def pose(self) -> _Float:
        """x, y, yaw, (3,)."""
        return np.array([self.x_m, self.y_m, self.yaw_rad])

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON: metres and degrees, in the covariance too."""
        unit = np.array([1.0, 1.0, math.degrees(1.0)])
        known, bounded = math.isfinite(self.x_m), bool(np.isfinite(self.covariance).all())
        tilt: dict[str, float] = {}
        if self.tilt is not None:
            height, pitch, roll = np.where([True, False, False], self.tilt[0], np.degrees(self.tilt[0])).tolist()
            std = np.sqrt(np.diag(self.tilt[1]))
            tilt = {"z_m": height, "pitch_deg": pitch, "roll_deg": roll, "z_std_m": float(std[0])}
            tilt |= {"pitch_std_deg": math.degrees(std[1]), "roll_std_deg": math.degrees(std[2])}
        return {
            "run": self.key[0],
            "stop": self.key[1],
            "robot": self.key[2],
            "x_m": self.x_m if known else None,
            "y_m": self.y_m if known else None,
            "yaw_deg": math.degrees(self.yaw_rad) if known else None,
            "covariance": (self.covariance * np.outer(unit, unit)).tolist() if bounded else None,
            **tilt,
            "explained": self.explained,
            "observed": self.observed,
            "accepted": self.accepted,
            "reason": self.reason,
            "note": self.note,
            "alternatives": [
                {**one._asdict(), "yaw_rad": None, "yaw_deg": math.degrees(one.yaw_rad)} for one in self.alternatives
            ],
        }


class Locator:
    """Localisation of a rig in a map.

    Parameters
    ----------
    wall_map : WallMap
    rig : Rig
    tolerance_m, tolerance_rad : float
        How far off an accepted pose may be: three standard deviations must be within it, and no other pose that
        explains the stop may be farther away.
    least_explained : float
        Share of the observed columns that an accepted pose must explain; where no start speaks
        for it, at least all but twice the outliers of the rig's noise.
    with_tilt : bool
        Whether height, pitch and roll are estimated, too, from the zones of recordings with rows: from the poses that
        the columns have found, in the scene of the map. An answer is accepted by x, y and yaw.

    Raises
    ------
    UsageError
        A tolerance that is not positive, a share outside (0, 1), sensors that see different faces of the map, or a map
        500 times as long as the sensors see, as one in millimetres is.

    Examples
    --------
    >>> room = WallMap(walls_m=[[0, 0, 4, 0], [4, 0, 4, 3], [4, 3, 0, 3], [0, 3, 0, 0]])
    >>> Locator(room, Rig(sensor=[{"name": "front"}])).tolerance_m
    0.1
    """

    def __init__(
        self,
        wall_map: WallMap,
        rig: Rig,
        *,
        tolerance_m: float = 0.1,
        tolerance_rad: float = math.radians(5.0),
        least_explained: float = 0.7,
        with_tilt: bool = False,
    ) -> None:
        for name, value in (("tolerance_m", tolerance_m), ("tolerance_rad", tolerance_rad)):
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"'{name}' must be positive, got {value!r}")
        if not 0 < least_explained < 1:
            raise UsageError(f"'least_explained' must be in (0, 1), got {least_explained!r}")
        self.tolerance_m, self.tolerance_rad, self.least_explained = tolerance_m, tolerance_rad, least_explained
        self.wall_map, self.rig = wall_map, rig
        self.model = StopModel(rig, rig.outline_of(wall_map, in_space=with_tilt), rig.numbers())
        low_x, low_y, high_x, high_y = self.model.outline.bounds_m
        longest, reach = max(high_x - low_x, high_y - low_y), rig.noise.max_range_m
        if longest > _LONGEST_MAP * reach:
            raise UsageError(
                f"the map is {longest:.4g} m long, and 'noise.max_range_m' of the rig {reach:g} m: are both in metres?"
            )
        self._grid = pose_grid(self.model.outline, rig.noise.max_range_m)
        self.with_tilt = with_tilt

    def locate(
        self,
        recording: RigRecording,
        start: ArrayLike | None = None,
        start_std: ArrayLike = (0.5, 0.5, 0.26),
    ) -> list[LocatedPose]:
        """Locate each stop of a recording.

        Parameters
        ----------
        recording : RigRecording
        start : (n, 3) array_like, optional
            Where the robot is believed to be: x, y (m), yaw (rad). Stops with NaN, and all without `start`, are
            searched for in the whole map.
        start_std : (3,) or (n, 3) array_like
            Standard deviations of `start`, which is a prior.

        Returns
        -------
        list of LocatedPose

        Raises
        ------
        UsageError
            Starts of a wrong shape, standard deviations that are not positive, or a tilt is asked of a recording
            without rows.
        """
        n = len(recording)
        starts = np.full((n, 3), np.nan) if start is None else np.asarray(start, np.float64)
        if starts.shape != (n, 3):
            raise UsageError(f"'start' must be {(n, 3)}, one pose a stop, got {starts.shape}")
        std = _positive(start_std, (n, 3))
        return [
            self._located(recording, k, (starts[k], np.diag(std[k] ** 2)) if np.isfinite(starts[k]).all() else None)
            for k in range(n)
        ]

    def follow(
        self,
        recording: RigRecording,
        start: Mapping[int, ArrayLike] | None = None,
        start_std: ArrayLike = (0.2, 0.2, 0.09),
    ) -> list[LocatedPose]:
        """Locate the stops of each robot one after the other, each from the last accepted pose and the odometry.

        Parameters
        ----------
        recording : RigRecording
            With odometry at its stops.
        start : mapping of int to (3,) array_like, optional
            First pose of each robot; that of the odometry where it is left out. NaN: the whole map is searched.
        start_std : (3,) array_like

        Returns
        -------
        list of LocatedPose
            In the order of the recording. A stop that is refused is searched for in the whole map, too.

        Raises
        ------
        UsageError
            The recording has no odometry, or standard deviations are not positive.
        """
        if recording.odometry is None:
            raise UsageError(
                "the recording must have odometry at its stops: odometry_x_m, odometry_y_m, odometry_yaw_rad"
            )
        first = np.diag(np.square(_positive(start_std, (3,))))
        answers: dict[int, LocatedPose] = {}
        for robot in np.unique(recording.robot):
            own = np.flatnonzero(recording.robot == robot)
            mean = np.asarray((start or {}).get(int(robot), recording.odometry[own[0]]), np.float64)
            prior = (mean, first) if np.isfinite(mean).all() else None
            for k, before in zip(own, [None, *own[:-1]], strict=True):
                if before is not None and prior is not None:
                    step = relative_pose(recording.odometry[before], recording.odometry[k])
                    prior = self.rig.odometry.moved(*prior, step)
                answers[int(k)], prior = self.locate_next(recording, int(k), prior)
        return [answers[k] for k in range(len(recording))]

    def locate_next(
        self, recording: RigRecording, k: int, prior: tuple[_Float, _Float] | None
    ) -> tuple[LocatedPose, tuple[_Float, _Float] | None]:
        """Locate a stop from where the robot is expected, in the whole map where that fails, or without a prior.

        A pose of the whole map that contradicts the prior is refused, but the next stop is expected from there: two
        that agree with each other are believed.

        Returns
        -------
        LocatedPose
        prior : (mean, covariance) or None
            What is known of the pose then.
        """
        answer = self._located(recording, k, prior)
        if prior is not None and answer.reason in ("poor fit", "ambiguous", "unexpected"):
            anywhere = self._located(recording, k, None)
            if anywhere.accepted and self._squared_distance(anywhere.pose, prior) > _CONTRADICTS:
                return replace(anywhere, accepted=False, reason="unexpected"), (anywhere.pose, anywhere.covariance)
            answer = anywhere if anywhere.accepted else answer
        return answer, (answer.pose, answer.covariance) if answer.accepted else prior

    def _located(self, recording: RigRecording, k: int, prior: tuple[_Float, _Float] | None) -> LocatedPose:
        """Locate one stop; `prior`: mean and covariance."""
        answer = self.locate_scan(recording.scan(k), prior, self.zones(recording, k))
        note = recording.notes[k] if recording.notes else ""
        if "odometry jumps" in note:
            answer = replace(answer, accepted=False, reason="odometry jumps")
        return replace(answer, key=recording.key(k), note=note)

    def zones(self, recording: RigRecording, k: int) -> tuple[SpaceModel, Scan] | None:
        """Return the zones of a stop and the model of them; None where no tilt is asked for."""
        if not self.with_tilt:
            return None
        if recording.zone_m is None:
            raise UsageError(f"z, pitch and roll need rows of zones, and '{recording.run}' has columns alone")
        scan = recording.zones(k, _SAME_FRAMES)
        return None if scan is None else (self._in_space, scan)

    @cached_property
    def _in_space(self) -> SpaceModel:
        """The model of zones, made when it is first needed."""
        return SpaceModel(self.rig, self.model.outline, self.model.numbers, self.wall_map)

    def locate_scan(
        self,
        scan: Scan,
        prior: tuple[_Float, _Float] | None = None,
        zones: tuple[SpaceModel, Scan] | None = None,
    ) -> LocatedPose:
        """Locate one stop.

        Parameters
        ----------
        scan : Scan
        prior : (mean, covariance), optional
            (3,) and (3, 3). None: the whole map is searched.
        zones : (SpaceModel, Scan), optional
            Rows of zones, which tell the tilt.

        Returns
        -------
        LocatedPose
        """
        used = np.isfinite(scan.depth_m).any(axis=(1, 2))
        scan = Scan(scan.time_s[used], scan.depth_m[used], scan.odometry_time_s, scan.odometry)
        observed = int(np.isfinite(scan.depth_m).sum())
        if not observed:
            return LocatedPose(("", 0, 0))
        model, given, fits = self.model, _given(prior), self._fits(scan, prior)
        if zones is not None:
            model, scan = zones
            fits = self._distinct([fit_stop(model, scan, fit.theta, given, _NARROW) for fit in fits])
        if not fits:
            return LocatedPose(("", 0, 0), observed=observed, reason="poor fit")
        if zones is None:
            fits[0] = along_profiles(model, scan, fits[0], given)
        return self._answer(model, scan, fits, prior)

    def _fits(self, scan: Scan, prior: tuple[_Float, _Float] | None) -> list[StopFit]:
        """Return distinct fits, best first: descents on three frames from a grid, then on all frames."""
        few = np.unique(np.linspace(0, len(scan.time_s) - 1, 3).astype(int))
        thin = Scan(scan.time_s[few], scan.depth_m[few], scan.odometry_time_s, scan.odometry)
        around = None if prior is None else (prior[0], _REACH_SIGMA * np.sqrt(np.diag(prior[1])))
        given = _given(prior)
        starts = promising_poses(self._grid, self.model.numbers, thin, _MOST_STARTS, around)
        if prior is not None:
            starts = np.vstack([prior[0], starts])
        # noise that is wide at first leads out of small basins, and past the right one
        ways = [(pose, widths) for pose in starts for widths in (WIDTHS, _NARROW)]
        fits = self._distinct([fit_stop(self.model, thin, pose, given, widths) for pose, widths in ways])
        fits = [fit for fit in fits if fit.cost < fits[0].cost + _HOPELESS][:_MOST_REFINED]
        if len(scan.time_s) > len(few):
            fits = self._distinct([fit_stop(self.model, scan, fit.theta, given, _NARROW) for fit in fits])
        return fits

    def _distinct(self, fits: list[StopFit]) -> list[StopFit]:
        """Return fits at places where a robot may be, best first, one of those that have nearly the same pose."""
        low_x, low_y, high_x, high_y = self._grid.bounds_m
        kept: list[StopFit] = []
        for fit in sorted(fits, key=lambda one: one.cost):
            x, y, _ = fit.pose
            if not (low_x <= x <= high_x and low_y <= y <= high_y):
                continue
            if not any((np.abs(difference(fit.pose, other.pose)) < 0.2 * self._tolerance).all() for other in kept):
                kept.append(fit)
        return kept

    def is_determined(self, std: _Float) -> bool:
        """Return whether three standard deviations of a pose, (3,), are within the tolerance."""
        return bool((TOLERATED_SIGMA * std <= self._tolerance).all())

    @property
    def _tolerance(self) -> _Float:
        return np.array([self.tolerance_m, self.tolerance_m, self.tolerance_rad])

    def _answer(
        self, model: StopModel, scan: Scan, fits: list[StopFit], prior: tuple[_Float, _Float] | None
    ) -> LocatedPose:
        """Return the best fit as the answer, or the reason to refuse it, with what explains the stop nearly as well."""
        best = fits[0]
        opinions = max(1.0, len(scan.time_s) / _SAME_FRAMES) * model.rows
        excess = np.array([fit.cost - best.cost for fit in fits]) / opinions
        near = [k for k in range(len(fits)) if excess[k] < DISAGREEMENT and fits[k].share >= self.least_explained]
        weight = np.exp(-0.5 * excess)
        weight /= weight.sum()
        candidates = []
        for k in near:
            x, y, yaw = fits[k].pose.tolist()
            candidates.append(PoseCandidate(x, y, yaw, float(excess[k]), float(weight[k]), fits[k].share))
        covariance = best.covariance[:3, :3] + self.wall_map.part
        x, y, yaw = best.pose.tolist()
        least = self.least_explained
        off = math.inf if prior is None else self._squared_distance(best.pose, prior)
        if off > _SPEAKS_FOR:
            least = max(least, 1 - _MOST_OUTLIERS * self.rig.noise.outliers)
        reason = self._reason(
            least, fits, near, np.sqrt(np.diag(self.wall_map.part) + std_without_one(model, scan, best) ** 2)
        )
        if not reason and _CONTRADICTS < off < math.inf:
            reason = "unexpected"
        return LocatedPose(
            ("", 0, 0),
            x,
            y,
            yaw,
            covariance=covariance,
            explained=best.share,
            observed=best.observed,
            accepted=not reason,
            reason=reason,
            alternatives=tuple(candidates),
            evidence=_without(best, prior),
            tilt=self._tilt(best),
        )

    def _squared_distance(self, pose: _Float, prior: tuple[_Float, _Float]) -> float:
        """Return the squared distance of a pose from its prior, in standard deviations."""
        off = difference(pose, prior[0])
        return float(off @ np.linalg.solve(prior[1] + self.wall_map.part, off))

    def _tilt(self, fit: StopFit) -> tuple[_Float, _Float] | None:
        """Return height, pitch and roll of a fit in space and their covariance, height above the map's zero."""
        first = len(self.model.longest)
        if len(fit.theta) == first:
            return None
        return fit.theta[first:] + np.array([self.wall_map.height_m, 0.0, 0.0]), fit.covariance[first:, first:]

    def _reason(self, least: float, fits: list[StopFit], near: list[int], std: _Float) -> LocateReason:
        """Return why the best fit, which must explain a least share, is refused; empty where it is accepted."""
        if fits[0].share < least:
            return "poor fit"
        if not self.is_determined(std):
            return "undetermined"
        for other in (fits[k] for k in near[1:]):  # the truth may be on the far side of another pose
            off = np.abs(difference(other.pose, fits[0].pose))
            if (off + TOLERATED_SIGMA * np.sqrt(np.diag(other.covariance)[:3]) > self._tolerance).any():
                return "ambiguous"
        return ""


def _positive(start_std: ArrayLike, shape: tuple[int, ...]) -> _Float:
    """Return standard deviations of starts in a shape."""
    std = np.broadcast_to(np.asarray(start_std, np.float64), shape)
    if not (np.isfinite(std) & (std >= _LEAST_STD)).all():
        raise UsageError(f"'start_std' must be at least {_LEAST_STD:g}, got {np.min(std):g}")
    return std


def _given(prior: tuple[_Float, _Float] | None) -> tuple[_Float, _Float] | None:
    """Return a prior with the inverse of its covariance."""
    return None if prior is None else (prior[0], np.asarray(np.linalg.inv(prior[1]), np.float64))


def _without(fit: StopFit, prior: tuple[_Float, _Float] | None) -> tuple[_Float, _Float]:
    """Return the pose and information of a fit less those of its prior: Λ = P − P₀, m = x + Λ⁺ P₀ (x − x₀)."""
    information = np.asarray(np.linalg.inv(fit.covariance[:3, :3]), np.float64)
    if prior is None:
        return fit.pose, information
    of_prior = np.linalg.inv(prior[1])
    off = difference(fit.pose, prior[0])
    root = np.sqrt(np.diag(information))
    values, axes = np.linalg.eigh((information - of_prior) / np.outer(root, root))
    values, axes = values[values > 1e-6], axes[:, values > 1e-6]  # the rest is the prior's alone
    along, across = axes / root[:, None], axes * root[:, None]
    own = across * values @ across.T
    return fit.pose + along / values @ along.T @ of_prior @ off, np.asarray(own, np.float64)
