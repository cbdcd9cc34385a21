"""Poses over time: one filter for each pose that the matches so far allow, until motion decides between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Match
from phasemark.matcher.sequence.odometry import Reading
from phasemark.matcher.sequence.pose_filter import POSE, Motion, PoseFilter, Sighting
from phasemark.matcher.sequence.standing import Standing, is_open

_USABLE = ("", "undetermined", "ambiguous")
"""Reasons of matches that measure a pose: what else is refused shows no landmark, or not where it is."""
_OUTLIER, _ELSEWHERE = 1e-2, 1e-4
"""Probability that a usable match shows none of the poses that are followed, and that the robot was put elsewhere."""
_LOG_ANYWHERE = {0: 0.0, 1: 0.0, 2: -math.log(math.tau)}
"""Logarithm of the density of a pose of which nothing is known: over a metre and a turn."""
_CERTAIN = 1e-3
"""Probability that other poses may keep beside one that is published."""
_DROPPED, _MOST, _SAME = 1e-5, 12, 4.0
"""Probability below which a pose is not followed, how many are, and the squared distance at which two are one."""
_NOTHING_KNOWN = 10.0
"""Standard deviation of each number of a pose before its first match, metres and radians."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Pose at the time of a frame.

    Parameters
    ----------
    accepted : bool
        Whether it may be relied on: one pose alone is probable, is known within the tolerance, and was seen lately.
    reason : {"", "searching", "lost", "ambiguous", "undetermined"}
        Why it is not accepted. "searching": nothing was seen yet. "lost": the landmark was not seen for too long, or
        where it was not expected.
    pose : (3,) float64, or None
        x, y and heading of the most probable pose, metres and radians.
    covariance : (3, 3) float64, or None
        Of that pose, the bias of the recording included.
    probability : float
        Of that pose.
    used : bool
        Whether the match of the frame was used for it.
    distance_squared : float
        Squared Mahalanobis distance of that match; NaN without one.
    poses : tuple of (probability, (3,) float64)
        All that are followed, the most probable first.
    """

    accepted: bool
    reason: str
    pose: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    probability: float = 0.0
    used: bool = False
    distance_squared: float = math.nan
    poses: tuple[tuple[float, NDArray[np.float64]], ...] = ()


@dataclass(eq=False)
class _Track:
    """One pose that is followed."""

    filter: PoseFilter
    log_weight: float
    unseen_s: float = 0.0
    used: bool = False
    distance_squared: float = math.nan


class PoseEstimator:
    """Follows a pose by the matches of a landmark and by odometry, causally.

    Each usable match updates every pose that it may show, a Kalman filter each, weighted by its probability density;
    that the match shows none of them is a possibility too, and that the robot was put elsewhere. A match beyond the
    gate of all poses is refused as an outlier; once another agrees with it, both count.

    Parameters
    ----------
    standing : Standing
        Place of the landmark, and of the camera on the robot.
    motion : Motion
        How the robot moves: :class:`~phasemark.matcher.sequence.OdometryPlan` with odometry,
        :class:`~phasemark.matcher.sequence.FreeMotion` without.
    gate : float
        A match as improbable as 1 − gate is refused.
    tolerance_m, tolerance_rad : float
        Three standard deviations of an accepted pose: towards the landmark, and as an angle about it and of heading.
    lost_after_s : float
        Without a match for longer, the pose is lost.
    delay_std_s : float
        Standard deviation of the delay of the recording's stamps against the odometry's, which is estimated.
    jitter_s : float
        Standard deviation of the frames' stamps: what it makes of the motion is added to the noise of a match.
    smooths : bool
        Whether every step is kept, so that poses can be smoothed at the end: memory grows with the time.

    Raises
    ------
    UsageError
        The gate is no probability, a tolerance is not positive, or a time is negative.

    Examples
    --------
    >>> import numpy as np
    >>> from phasemark.matcher import Match
    >>> from phasemark.matcher.sequence import FreeMotion, PoseEstimator, Reading, Standing
    >>> estimator = PoseEstimator(Standing(), FreeMotion())
    >>> free = ("distance_m", "delta_rad", "bearing_rad")
    >>> seen = Match("cone", True, 1.0, 0.0, free=free, covariance=np.diag([1e-6, 1e-5, 1e-5]))
    >>> estimator.see(seen).accepted
    True
    >>> estimator.move(Reading(0.0, 0.0, 2.0))
    >>> estimator.see(None).reason
    'lost'
    """

    def __init__(
        self,
        standing: Standing,
        motion: Motion,
        *,
        gate: float = 0.9999,
        tolerance_m: float = TOLERANCE_M,
        tolerance_rad: float = TOLERANCE_RAD,
        lost_after_s: float = 0.5,
        delay_std_s: float = 0.0,
        jitter_s: float = 0.0,
        smooths: bool = False,
    ) -> None:
        if not 0 < gate < 1:
            raise UsageError(f"'gate' must be in (0, 1), got {gate!r}")
        for name, value in {"tolerance_m": tolerance_m, "tolerance_rad": tolerance_rad}.items():
            if not value > 0:
                raise UsageError(f"'{name}' must be positive, got {value!r}")
        times = {"lost_after_s": lost_after_s, "delay_std_s": delay_std_s, "jitter_s": jitter_s}
        for name, value in times.items():
            if not value >= 0:
                raise UsageError(f"'{name}' must not be negative, got {value!r}")
        self.standing = standing
        self._motion, self._gate, self._lost_after_s = motion, gate, lost_after_s
        self._tolerance, self._jitter_s, self._delay_std_s = (tolerance_m, tolerance_rad), jitter_s, delay_std_s
        self._tracks: list[_Track] = []
        self._smooths, self._last = smooths, Reading(0.0, 0.0, 1.0)

    @property
    def filter(self) -> PoseFilter | None:
        """The filter of the most probable pose; with `smooths` its method `smoothed` returns all poses up to now."""
        return self._tracks[0].filter if self._tracks else None

    def expected_views(self) -> list[tuple[float, float, float]]:
        """Return the views (D, δ, b) of the landmark from the poses that are followed, the most probable first."""
        return [self.standing.view(track.filter.pose) for track in self._tracks]

    def forget(self) -> None:
        """Start again: nothing is known of the pose."""
        self._tracks = []

    def move(self, reading: Reading) -> None:
        """Take one step of the odometry, or let time pass."""
        self._last = reading if reading.time_s > 0 else self._last
        for track in self._tracks:
            track.filter.predict(reading)
            track.unseen_s += reading.time_s

    def see(self, match: Match | None) -> Estimate:
        """Take the match of a frame, or None where there is none, and return the pose at its time."""
        usable = match is not None and match.class_name is not None and match.covariance is not None
        if match is not None and usable and match.reason in _USABLE and not is_open(match):
            self._tracks = self._children(match)
            self._settle()
        else:
            for track in self._tracks:
                track.used, track.distance_squared = False, math.nan
        for track in self._tracks if self._smooths else ():
            track.filter.mark()
        return self._estimate()

    def _children(self, match: Match) -> list[_Track]:
        """Return each pose with each measured one that it may be, and as it was; and where else the robot may be."""
        anywhere = sum(_LOG_ANYWHERE[row] for row in self.standing.rows)
        found: list[_Track] = []
        fits = False
        for track in self._tracks:
            if self.standing.view(track.filter.pose)[0] <= 0:  # it has drifted to behind the landmark
                continue
            for sighting in self._timed(match, track.filter):
                squared, log_density = track.filter.distance(sighting)
                if track.filter.passes(sighting, squared):
                    fits, moved = True, track.filter.copy()
                    moved.take(sighting)
                    weight = track.log_weight + math.log1p(-_OUTLIER) + sighting.log_weight + log_density
                    found.append(_Track(moved, weight, 0.0, True, squared))
            if track.unseen_s <= self._lost_after_s:
                missed = track.log_weight + math.log(_OUTLIER) + anywhere
                found.append(_Track(track.filter, missed, track.unseen_s))
        if not fits and match.reason != "undetermined":
            share = math.log(_ELSEWHERE if found else 1.0)
            for sighting in self._timed(match, None):
                found.append(_Track(self._born(sighting), share + anywhere + sighting.log_weight, 0.0, True, 0.0))
        return found

    def _timed(self, match: Match, expected: PoseFilter | None) -> list[Sighting]:
        """Return the poses that a match allows, with what errors of its stamp make of the motion.

        Errors that frames share are linear about the pose by this frame and all before it: about that of each frame
        alone, noise would make them seem to differ, and the filter would learn from that what they are.
        """
        timed = []
        for given in self.standing.sightings(match, None if expected is None else expected.pose):
            one = given
            moving = expected
            if moving is None:
                moving = PoseFilter(one.pose, one.covariance, self._motion, self._gate)
                moving.predict(self._last)
            delay_variance = self._delay_std_s**2
            if expected is not None and delay_variance:  # the last number of its state is the delay
                delay_variance *= expected.covariance[-1, -1]
            late, unknown = self._jitter_s * moving.rate, self._jitter_s**2 + delay_variance
            noise = one.covariance + np.outer(late, late) + unknown * moving.rate_covariance
            delay = self._delay_std_s * moving.rate
            one = replace(one, covariance=noise, loading=np.column_stack([one.loading, delay]))
            if expected is not None:
                corrected = expected.copy()
                corrected.take(one)
                shared = self.standing.loading(match, corrected.pose)
                one = replace(one, loading=np.column_stack([shared, delay]))
            timed.append(one)
        return timed

    def _born(self, sighting: Sighting) -> PoseFilter:
        """Return a filter that knows a measured pose alone."""
        unknown = np.eye(POSE) * _NOTHING_KNOWN**2
        n_shared = sighting.loading.shape[1] if sighting.loading.any() or self._delay_std_s else 0
        new = PoseFilter(sighting.pose, unknown, self._motion, self._gate, n_shared=n_shared)
        new.take(sighting)
        return new

    def _settle(self) -> None:
        """Normalise the probabilities, unite poses that have become one, and drop improbable ones."""
        tracks = sorted(self._tracks, key=lambda track: -track.log_weight)
        most = tracks[0].log_weight if tracks else 0.0
        kept: list[_Track] = []
        for track in tracks:
            track.log_weight -= most
            if track.log_weight < math.log(_DROPPED) or len(kept) == _MOST:
                break
            same = next((other for other in kept if self._are_one(other.filter, track.filter)), None)
            if same is None:
                kept.append(track)
            else:
                same.log_weight = float(np.logaddexp(same.log_weight, track.log_weight))
        total = np.logaddexp.reduce([track.log_weight for track in kept]) if kept else 0.0
        for track in kept:
            track.log_weight -= float(total)
        self._tracks = sorted(kept, key=lambda track: -track.log_weight)

    def _are_one(self, one: PoseFilter, other: PoseFilter) -> bool:
        """Return whether two filters follow one pose."""
        rows = list(self.standing.rows)
        apart = one.pose - other.pose
        apart[2] = math.remainder(apart[2], math.tau)
        total = (one.pose_covariance + other.pose_covariance)[np.ix_(rows, rows)]
        return bool(apart[rows] @ np.linalg.solve(total, apart[rows]) < _SAME)

    def _estimate(self) -> Estimate:
        """Return the most probable pose, and whether it may be relied on."""
        if not self._tracks:
            return Estimate(False, "searching")
        best = self._tracks[0]
        probability = math.exp(best.log_weight)
        reason = ""
        if best.unseen_s > self._lost_after_s:
            reason = "lost"
        elif probability < 1 - _CERTAIN:
            reason = "ambiguous"
        elif not self._is_determined(best.filter):
            reason = "undetermined"
        return Estimate(
            accepted=not reason,
            reason=reason,
            pose=best.filter.pose.copy(),
            covariance=best.filter.pose_covariance.copy(),
            probability=probability,
            used=best.used,
            distance_squared=best.distance_squared,
            poses=tuple((math.exp(track.log_weight), track.filter.pose.copy()) for track in self._tracks),
        )

    def _is_determined(self, own: PoseFilter) -> bool:
        """Return whether three standard deviations are within the tolerance."""
        distance_m, _, _ = self.standing.view(own.pose)
        tolerance_m, tolerance_rad = self._tolerance
        covariance = own.pose_covariance
        to = np.array(self.standing.landmark_xy_m) - own.pose[:2]
        along = np.array([1.0, 0.0]) if self.standing.flat else to / max(float(np.linalg.norm(to)), 1e-9)
        across = np.array([-along[1], along[0]])
        variances = [(along @ covariance[:2, :2] @ along, tolerance_m), (covariance[2, 2], tolerance_rad)]
        if not self.standing.flat:
            variances.append((across @ covariance[:2, :2] @ across, max(tolerance_m, distance_m * tolerance_rad)))
        return all(3 * math.sqrt(max(float(variance), 0.0)) <= most for variance, most in variances)
