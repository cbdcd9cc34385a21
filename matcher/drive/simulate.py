"""A whole drive: follow the path, look out for landmarks, stop, measure, correct, drive on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import BankPlan, build_bank
from phasemark.data.progress import Progress
from phasemark.data.seeds import stream
from phasemark.landmarks import LandmarkSpec, build_mesh, catalog
from phasemark.matcher.accuracy.cramer_rao import cramer_rao
from phasemark.matcher.drive.follow import Path, World, pan_towards
from phasemark.matcher.drive.plan import DrivePlan
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.match import Match
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.position.landmark_map import MappedLandmark
from phasemark.matcher.sequence.odometry import moved
from phasemark.matcher.sequence.planar import lens_pose, view_of
from phasemark.matcher.sequence.pose_filter import PoseFilter
from phasemark.matcher.statistics import nees
from phasemark.render import Background, Renderer, Sensor, Views, capture

FREE = ("distance_m", "delta_rad", "bearing_rad")
"""The robot points the camera by its own wrong estimate, so the bearing is unknown too."""
_BANK_STEP_M, _BANK_STEP_DEG, _BANK_MARGIN_M = 0.02, 2.0, 0.3


@dataclass(frozen=True, eq=False)
class Stop:
    """One stop before a landmark; poses are (x, y, heading), metres and radians.

    Parameters
    ----------
    time_s : float
        Time at which all frames were taken, seconds.
    way_m : float
        Way that the wheels had turned by then, metres.
    landmark : MappedLandmark
        Which one the robot stopped for.
    predicted_across_std_m : float
        D·σ_δ of the Cramér–Rao bound at the view that the robot believed in.
    view : (D, δ, b)
        The true one.
    pan_rad : float
        Which the pan unit was told.
    match : Match
        Match of the frames at the stop.
    measured : (3,) float64, or None
        The robot's pose after the match, of all solutions the one nearest to what the filter believed.
    measured_covariance : (3, 3) float64, or None
        Covariance of the measured pose; None if the match was refused.
    distance_squared : float
        Its squared Mahalanobis distance from that belief.
    used : bool
        Whether it passed.
    true, before, after : (3,) float64
        The true pose, and the filter's before and after the correction.
    covariance_before, covariance_after : (3, 3) float64
        Covariance of the pose before and after the correction.
    """

    time_s: float
    way_m: float
    landmark: MappedLandmark
    predicted_across_std_m: float
    view: tuple[float, float, float]
    pan_rad: float
    match: Match
    measured: NDArray[np.float64] | None
    measured_covariance: NDArray[np.float64] | None
    distance_squared: float
    used: bool
    true: NDArray[np.float64]
    before: NDArray[np.float64]
    after: NDArray[np.float64]
    covariance_before: NDArray[np.float64]
    covariance_after: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drive:
    """Result of a drive; poses are (x, y, heading) by row, metres and radians.

    Parameters
    ----------
    plan : DrivePlan
        Plan of the drive.
    seed : int
        Seed of the drive.
    time_s : (n,) float64
        Time of every step, seconds.
    way_m : (n,) float64
        Way that the wheels had turned by then, metres.
    true : (n, 3) float64
        True pose.
    dead_reckoned : (n, 3) float64
        Pose from the odometry alone.
    corrected : (n, 3) float64
        Pose of the filter, corrected at the stops.
    covariance : (n, 3, 3) float64
        Covariance of the corrected pose.
    stops : tuple of Stop
        Stops at landmarks, in order.
    """

    plan: DrivePlan
    seed: int
    time_s: NDArray[np.float64]
    way_m: NDArray[np.float64]
    true: NDArray[np.float64]
    dead_reckoned: NDArray[np.float64]
    corrected: NDArray[np.float64]
    covariance: NDArray[np.float64]
    stops: tuple[Stop, ...]

    @property
    def corrections(self) -> tuple[Stop, ...]:
        """The stops whose measurement was used."""
        return tuple(stop for stop in self.stops if stop.used)

    def as_dict(self) -> dict[str, Any]:
        """Return the figures of a drive as plain numbers, for JSON; None where there is nothing to tell."""
        used = self.corrections
        facts: dict[str, Any] = {
            "seed": self.seed,
            "way_m": float(self.way_m[-1]),
            "time_s": float(self.time_s[-1]),
            "stops": len(self.stops),
            "corrections": len(used),
        }
        consistency = {}
        for when in ("after", "before"):
            error = np.array([pose_error(getattr(stop, when), stop.true) for stop in used]).reshape(-1, 3)
            covariance = np.array([getattr(stop, f"covariance_{when}") for stop in used]).reshape(-1, 3, 3)
            facts[f"position_rms_{when}_correction_m"] = _rms(error[:, :2]) if used else None
            facts[f"heading_rms_{when}_correction_deg"] = math.degrees(_rms(error[:, 2:])) if used else None
            consistency[when] = float(nees(error, covariance).mean()) / 3 if used else None
        return {
            **facts,
            **{f"nees_per_dimension_{when}_correction": consistency[when] for when in ("before", "after")},
            **_drift("dead_reckoned", self.dead_reckoned, self.true),
            **_drift("corrected", self.corrected, self.true),
            "plan": self.plan.model_dump(mode="json", by_alias=True),
        }


def pose_error(estimate: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return estimate less truth, the heading's difference wrapped; (..., 3)."""
    error = estimate - truth
    error[..., 2] = np.remainder(error[..., 2] + math.pi, math.tau) - math.pi
    return np.asarray(error)


@dataclass(frozen=True, eq=False)
class RobotEquipment:
    """Equipment of a robot: camera, bank, matcher, and a model of each class.

    One set serves any number of drives with the same classes and camera.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    matcher : Matcher
        Matcher of the frames at stops.
    renderers : dict of str to Renderer
        Renderer of each class.
    """

    sensor: Sensor
    matcher: Matcher
    renderers: dict[str, Renderer] = field(default_factory=dict)

    @classmethod
    def of(cls, plan: DrivePlan, workers: int | None = None) -> RobotEquipment:
        """Build the bank in memory, over the distances where the robot stops and a margin.

        Parameters
        ----------
        plan : DrivePlan
            Plan of the drive.
        workers : int, optional
            Threads; None: one for each processor.

        Raises
        ------
        UsageError
            The catalogue has no such class, or no such camera is shipped.
        """
        sensor, specs = plan.build_sensor(), specs_of(plan)
        low, high = plan.stop.distance_m
        low = max(low - _BANK_MARGIN_M, 0.5)
        steps = math.ceil((high + _BANK_MARGIN_M - low) / _BANK_STEP_M)
        bank = BankPlan(
            classes=tuple(specs),
            sensor=plan.camera.sensor,
            distance_m=tuple(low + k * _BANK_STEP_M for k in range(steps + 1)),
            delta_deg=tuple(k * _BANK_STEP_DEG for k in range(round(180 / _BANK_STEP_DEG))),
        )
        tilts = plan.camera.tilt_std_rad
        known: dict[str, Any] = {f"{name.removesuffix('_rad')}_std_rad": std for name, std in tilts.items()}
        built = build_bank(bank, None, workers=workers)
        matcher = Matcher(built, "refine", free=(*FREE, *tilts), background="auto", workers=workers, **known)
        renderers = {name: Renderer(build_mesh(spec), sensor, albedo=spec.albedo) for name, spec in specs.items()}
        return cls(sensor, matcher, renderers)


def specs_of(plan: DrivePlan) -> dict[str, LandmarkSpec]:
    """Return the landmarks on the map of a plan, by class.

    Raises
    ------
    UsageError
        The catalogue has no such class.
    """
    known = catalog()
    names = list(dict.fromkeys(landmark.class_name for landmark in plan.map.landmark))
    for name in names:
        if name not in known:
            raise UsageError(f"'map.landmark.class' must be one of {', '.join(known)}, got {name!r}")
    return {name: known[name] for name in names}


def run_drive(
    plan: DrivePlan,
    *,
    seed: int = 2005,
    equipment: RobotEquipment | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Drive:
    """Drive along a path, correcting the odometry before landmarks.

    At each step the wheels turn by what the speed asks for; slip, sideways errors and the gyro's bias and noise come
    from `seed`. The robot steers by its corrected pose. Where a landmark is in view and the Cramér–Rao bound at the
    believed view promises D·σ_δ below the plan's limit, the robot stops, points the camera at where it believes the
    landmark, takes its frames, rendered at the true pose before the room's wall, matches them with distance, side and
    bearing free, and corrects the pose by the filter. The wall that a frame shows is the plane across the line of sight
    at the distance of the room's wall behind the landmark (PHYSICS section 3). A landmark with another one in the
    camera's field is passed by. Where the plan says that the floor is uneven, pitch and roll of each stop are drawn,
    and matched too.

    Parameters
    ----------
    plan : DrivePlan
        Plan of the drive.
    seed : int
        Of everything random.
    equipment : RobotEquipment, optional
        From an earlier drive; built if not given.
    workers : int, optional
        Threads; None: one for each processor.
    progress : callable (done, total), optional
        Called with the way done and the length of the path, both in centimetres.

    Returns
    -------
    Drive

    Raises
    ------
    UsageError
        A class or the camera is unknown, or the robot lost its path.
    """
    rng = stream(seed, "drive", 0)
    return _Driver(plan, seed, equipment or RobotEquipment.of(plan, workers), rng).drive(progress)


class _Driver:
    """One drive as it goes on."""

    def __init__(self, plan: DrivePlan, seed: int, equipment: RobotEquipment, rng: np.random.Generator) -> None:
        self.plan, self.seed, self.equipment, self.rng = plan, seed, equipment, rng
        self.path = Path(plan.path.waypoints_m)
        start = np.array([*plan.path.waypoints_m[0], self.path.start_heading_rad])
        self.world = World(start, plan.path.start_covariance, plan.odometry, rng)
        self.filter = PoseFilter(start.tolist(), plan.path.start_covariance, plan.odometry, plan.stop.gate)
        self.dead = np.array([*start, 0.0, 0.0])
        self.time_s = self.way_m = 0.0
        self.not_before_m: dict[str, float] = {}
        self.really = [_where_it_is(landmark, rng) for landmark in plan.map.landmark]
        self.log: list[tuple[NDArray[np.float64], ...]] = []
        self.stops: list[Stop] = []

    def drive(self, progress: Progress | None) -> Drive:
        """Drive to the end of the path."""
        path, plan = self.path, self.plan
        next_look_m = 0.0
        self._note()
        most_way = 1.5  # A robot that has driven this many times the length of its path has lost it.
        while not path.is_done:
            if self.way_m >= next_look_m:
                next_look_m += plan.stop.every_m
                self._look()
                if progress is not None:
                    progress(round(100 * path.progress_m), round(100 * path.length_m))
            self._step()
            if self.way_m > most_way * path.length_m + 1:
                raise UsageError(
                    f"the robot has lost its path after {self.way_m:.1f} m: give 'path.lookahead_m' or"
                    " 'path.turn_limit_deg_s' room for its corners, or let it see a landmark earlier"
                )
        time_s, way_m, true, dead, corrected, covariance = (np.stack(column) for column in zip(*self.log, strict=True))
        return Drive(plan, self.seed, time_s, way_m, true, dead, corrected, covariance, tuple(self.stops))

    def _step(self) -> None:
        plan = self.plan.path
        limit = math.radians(plan.turn_limit_deg_s)
        rate = float(np.clip(self.path.turn_rate(self.filter.pose, plan.speed_m_s, plan.lookahead_m), -limit, limit))
        way = plan.speed_m_s * plan.step_s
        reading = self.world.step(way, rate * plan.step_s, plan.step_s)
        self.filter.predict(reading)
        self.dead = moved(self.dead, reading)
        self.path.advance(self.filter.pose[:2], plan.lookahead_m)
        self.time_s += plan.step_s
        self.way_m += way
        self._note()

    def _note(self) -> None:
        now = (
            self.time_s, self.way_m, self.world.state[:3], self.dead[:3], self.filter.pose, self.filter.pose_covariance
        )  # fmt: skip
        self.log.append(tuple(map(np.array, now)))

    def _look(self) -> None:
        """Stop for the first landmark that promises enough."""
        for k, landmark in enumerate(self.plan.map.landmark):
            if self.way_m >= self.not_before_m.get(landmark.name, 0.0):
                promised = self._promise(landmark)
                if promised <= self.plan.stop.across_std_m:
                    self._measure(k, promised)

    def _promise(self, landmark: MappedLandmark) -> float:
        """Return D·σ_δ of the bound at the believed view; infinite if the landmark is not in view."""
        plan, sensor = self.plan, self.equipment.sensor
        pan = self._pan(landmark)
        lens = self._lens(self.filter.pose, pan)
        distance, delta, _ = view_of(lens, landmark.xy_m, landmark.yaw_rad)
        low, high = plan.stop.distance_m
        if not low <= distance <= high or abs(pan) > math.radians(plan.camera.pan_limit_deg):
            return math.inf
        half_field = math.radians(sensor.half_angle_h_deg)
        wall_m = plan.map.wall_distance_m(lens[:2], lens[2])
        for other in plan.map.landmark:
            far_m, _, bearing_rad = view_of(lens, other.xy_m, 0.0)
            in_field = other is not landmark and abs(bearing_rad) < 2 * half_field
            if in_field and (wall_m is None or far_m < wall_m):
                return math.inf
        bound = cramer_rao(
            self.equipment.renderers[landmark.class_name],
            Views.broadcast(distance, delta),
            free=(*FREE, *plan.camera.tilt_std_rad),
            n_frames=plan.camera.n_frames,
            background=self._wall(lens[:2], landmark.xy_m),
        )
        std = float(bound.std("delta_rad")[0])
        return distance * std if math.isfinite(std) else math.inf

    def _measure(self, k: int, promised: float) -> None:
        """Take frames at the true pose while standing, match them, and correct the filter."""
        plan, landmark = self.plan, self.plan.map.landmark[k]
        camera, sensor = plan.camera, self.equipment.sensor
        xy, yaw = self.really[k]
        pan = self._pan(landmark)
        lens = self._lens(self.world.state[:3], pan + math.radians(camera.pan_std_deg) * self.rng.standard_normal())
        view = view_of(lens, xy, yaw)
        renderer = self.equipment.renderers[landmark.class_name]
        tilt = {name: std * self.rng.standard_normal() for name, std in camera.tilt_std_rad.items()}
        pitch_rad, roll_rad = (tilt.get(name, 0.0) for name in ("pitch_rad", "roll_rad"))
        image = renderer.render(*view, pitch_rad=pitch_rad, roll_rad=roll_rad, background=self._wall(lens[:2], xy))
        filtered = kalman_filter(capture(image, sensor, rng=self.rng, n_frames=camera.n_frames))
        standing_s = camera.n_frames / sensor.frame_rate_hz
        self.world.stand(standing_s)
        self.filter.stand(standing_s)
        self.time_s += standing_s
        match = self.equipment.matcher.match(filtered)[0]
        before, covariance_before = self.filter.pose.copy(), self.filter.pose_covariance.copy()
        placements = []
        if match.accepted:
            placements = plan.map.poses(
                match, pan, prior=before.tolist(), prior_covariance=covariance_before,
                pan_offset_xy_m=camera.pan_offset_m, lens_offset_xy_m=camera.lens_offset_m,
                pan_std_rad=math.radians(camera.pan_std_deg),
            )  # fmt: skip
        used, squared = self.filter.correct(placements)
        nearest = placements[0].pose if placements else None
        self.stops.append(
            Stop(
                time_s=self.time_s,
                way_m=self.way_m,
                landmark=landmark,
                predicted_across_std_m=promised,
                view=view,
                pan_rad=pan,
                match=match,
                measured=None if nearest is None else np.array([nearest.x_m, nearest.y_m, nearest.heading_rad]),
                measured_covariance=None if nearest is None else nearest.covariance,
                distance_squared=squared,
                used=used is not None,
                true=self.world.state[:3].copy(),
                before=before,
                after=self.filter.pose.copy(),
                covariance_before=covariance_before,
                covariance_after=self.filter.pose_covariance.copy(),
            )
        )
        self.not_before_m[landmark.name] = self.way_m + (plan.stop.retry_m if used is None else plan.stop.again_m)
        self._note()

    def _pan(self, landmark: MappedLandmark) -> float:
        """Return the pan angle that should point at a landmark."""
        camera = self.plan.camera
        return pan_towards(self.filter.pose, landmark.xy_m, camera.pan_offset_m, camera.lens_offset_m)

    def _lens(self, pose: NDArray[np.float64], pan_rad: float) -> NDArray[np.float64]:
        return lens_pose(pose, pan_rad, self.plan.camera.pan_offset_m, self.plan.camera.lens_offset_m)

    def _wall(self, lens_m: NDArray[np.float64], landmark_m: Sequence[float]) -> Background | None:
        """Return the room's wall behind a landmark."""
        heading = math.atan2(landmark_m[1] - lens_m[1], landmark_m[0] - lens_m[0])
        wall = self.plan.map.wall_distance_m(lens_m, heading)
        return None if wall is None else Background(wall_m=wall, wall_albedo=self.plan.camera.wall_albedo)


def _where_it_is(landmark: MappedLandmark, rng: np.random.Generator) -> tuple[tuple[float, float], float]:
    """Draw where a landmark really stands, given how well it was surveyed."""
    x, y, yaw = np.array([*landmark.xy_m, landmark.yaw_rad]) + np.sqrt(np.diag(landmark.covariance)) * (
        rng.standard_normal(3)
    )
    return (float(x), float(y)), float(yaw)


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


def _rms(errors: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
