"""Errors of measured poses in the terms of ASTM E2919 (static pose in six degrees of freedom).

The standard compares the pose of an object that a system measures with a reference. *Position error* is the length of
the difference of the two positions. *Orientation error* is the angle of the one rotation that takes the measured
orientation into the true one. *Absolute* errors are those of single poses; *relative* errors are those of the motion
from one pose to the next, in which errors that all poses share cancel. Reported are mean, root mean square, percentiles
and the maximum.

Every number has a 95 % interval. Those of percentiles come from order statistics, and hold for any distribution.

A *score* judges the accepted poses of a recording. Bias is the median error, MAD the median distance from it. Intervals
of coverage are Wilson's, and count frames as if they were independent. A run of n successes shows a reliability R with
confidence C by n = ln(1 − C)/ln R, as ASTM F3499-21 counts them; so 0 false answers of n leave a share of at most
1 − R, about 3/n at 95 %.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data.files.json_text import finite_or_none
from phasemark.matcher.statistics import Interval, binomial_interval, mean_interval, rms_interval, within_ellipsoid
from phasemark.render import Views
from phasemark.render.rigid import rigid_transforms

PERCENTILES = (0.5, 0.683, 0.95, 0.997)
"""Shares of the errors for which a limit is reported."""
_TAIL = 0.025
CONFIDENCE = 0.95


@dataclass(frozen=True)
class ErrorSummary:
    """Statistics of the errors of some poses.

    Parameters
    ----------
    n : int
    mean, rms : Interval
    percentiles : dict of float to Interval
        Share → the error that this share of the poses does not exceed. Its interval ends at infinity where there are
        too few poses to bound it.
    maximum : float
    """

    n: int
    mean: Interval
    rms: Interval
    percentiles: dict[float, Interval]
    maximum: float

    @classmethod
    def of(cls, errors: ArrayLike) -> ErrorSummary:
        """Summarise errors, (n,), none of them negative."""
        values = np.sort(np.asarray(errors, np.float64))
        return cls(
            n=len(values),
            mean=mean_interval(values),
            rms=rms_interval(values),
            percentiles={share: percentile_interval(values, share) for share in PERCENTILES},
            maximum=float(values[-1]) if len(values) else math.nan,
        )

    def as_dict(self, scale: float) -> dict[str, Any]:
        """Return the numbers in another unit, for JSON: null where an interval has no end."""
        found = {
            "n": self.n,
            "mean": asdict(self.mean.scaled(scale)),
            "rms": asdict(self.rms.scaled(scale)),
            "percentiles": {f"{100 * share:g}": asdict(one.scaled(scale)) for share, one in self.percentiles.items()},
            "maximum": scale * self.maximum,
        }
        return finite_or_none(found)


@dataclass(frozen=True)
class PoseReport:
    """Errors of measured poses against true ones.

    Parameters
    ----------
    n_poses : int
        Poses with a truth.
    n_measured : int
        Poses that the system measured, of these; the others count nowhere else.
    position_m, orientation_rad : ErrorSummary
        Absolute errors.
    relative_position_m, relative_orientation_rad : ErrorSummary
        Errors of the motion from one measured pose to the next.
    position_bias_m : tuple of Interval
        Mean of the difference of the positions along x (ahead), y (left) and z (up) of the camera.
    """

    n_poses: int
    n_measured: int
    position_m: ErrorSummary
    orientation_rad: ErrorSummary
    relative_position_m: ErrorSummary
    relative_orientation_rad: ErrorSummary
    position_bias_m: tuple[Interval, Interval, Interval]

    def as_dict(self) -> dict[str, Any]:
        """Return the report in plain numbers, millimetres and degrees, for JSON."""
        return {
            "poses": self.n_poses,
            "measured": self.n_measured,
            **{
                f"{kind.replace(' ', '_')}_error_{unit.replace('°', 'deg')}": one.as_dict(scale)
                for kind, unit, scale, one in self._kinds()
            },
            "position_bias_mm": {
                axis: asdict(one.scaled(1e3))
                for axis, one in zip("xyz", self.position_bias_m, strict=True)
                if math.isfinite(one.low)
            },
        }

    def rows(self) -> list[dict[str, str]]:
        """Return the report as rows of a table, one for each kind of error."""
        return [
            {
                "error": f"{kind} ({unit})",
                "n": str(one.n),
                "mean": _shown(one.mean.scaled(scale)),
                "r.m.s.": _shown(one.rms.scaled(scale)),
                **{f"{100 * share:g} %": _shown(limit.scaled(scale)) for share, limit in one.percentiles.items()},
                "maximum": f"{scale * one.maximum:.3g}" if one.n else "",
            }
            for kind, unit, scale, one in self._kinds()
        ]

    def _kinds(self) -> Iterator[tuple[str, str, float, ErrorSummary]]:
        """Yield name, unit, the factor to it, and the errors of each kind."""
        yield "position", "mm", 1e3, self.position_m
        yield "orientation", "°", math.degrees(1), self.orientation_rad
        yield "relative position", "mm", 1e3, self.relative_position_m
        yield "relative orientation", "°", math.degrees(1), self.relative_orientation_rad


def pose_report(measured: ArrayLike | Views, true: ArrayLike | Views, *, symmetry: int = 1) -> PoseReport:
    """Compare measured poses of a landmark with true ones.

    Parameters
    ----------
    measured, true : (n, 4, 4) array_like, or Views
        Landmark frame to camera frame. A measured pose that is not there is NaN throughout.
    symmetry : int
        How many turns about its axis z' leave the landmark as it is: the one nearest to the truth counts.

    Returns
    -------
    PoseReport

    Raises
    ------
    UsageError
        The numbers of poses differ, a matrix is not rigid, or no pose was measured.

    Examples
    --------
    >>> true = Views.broadcast([1.0, 1.2, 1.5], 0.3)
    >>> report = pose_report(Views.broadcast([1.001, 1.201, 1.501], 0.3), true)
    >>> round(report.position_m.mean.value, 6), report.relative_position_m.maximum < 1e-12
    (0.001, True)
    """
    if symmetry < 1:
        raise UsageError(f"'symmetry' must be a whole number of turns, 1 or more, got {symmetry!r}")
    found, truth = _matrices(measured), rigid_transforms(_matrices(true))
    if len(found) != len(truth):
        raise UsageError(f"there must be as many measured poses as true ones, got {len(found)} and {len(truth)}")
    there = np.flatnonzero(~np.isnan(found).any(axis=(1, 2)))
    if not there.size:
        raise UsageError("no pose was measured: there is nothing to report")
    own, truth_there = _nearest_turn(rigid_transforms(found[there]), truth[there], symmetry), truth[there]
    shift, angle = _differences(own, truth_there)
    follows = np.flatnonzero(np.diff(there) == 1)
    moved, moved_truth = _motions(own, follows), _motions(truth_there, follows)
    relative_shift, relative_angle = _differences(moved, moved_truth)
    x, y, z = (mean_interval(axis) for axis in shift.T)
    return PoseReport(
        n_poses=len(truth),
        n_measured=len(there),
        position_m=ErrorSummary.of(np.linalg.norm(shift, axis=1)),
        orientation_rad=ErrorSummary.of(angle),
        relative_position_m=ErrorSummary.of(np.linalg.norm(relative_shift, axis=1)),
        relative_orientation_rad=ErrorSummary.of(relative_angle),
        position_bias_m=(x, y, z),
    )


def percentile_interval(values: ArrayLike, share: float) -> Interval:
    """Return the value that a share of a population does not exceed, with its 95 % interval from order statistics.

    Of n values in order, the number below the percentile is binomial; so the k-th and l-th values enclose it with a
    probability that does not depend on the distribution.

    Parameters
    ----------
    values : (n,) array_like
    share : float
        In (0, 1).

    Returns
    -------
    Interval
        It ends at infinity (or 0) where n is too small; NaN for no values.

    Examples
    --------
    >>> print(percentile_interval(range(1, 101), 0.5))
    50.500 [40.000, 61.000]
    """
    ordered = np.sort(np.asarray(values, np.float64))
    n = len(ordered)
    if not n:
        return Interval(math.nan, 0.0, math.inf)
    below = special.bdtr(np.arange(n + 1), n, share)  # probability of at most k values below the percentile
    low, high = int(np.searchsorted(below, _TAIL)), int(np.searchsorted(below, 1 - _TAIL)) + 1
    return Interval(
        float(np.quantile(ordered, share)),
        float(ordered[low - 1]) if low >= 1 else 0.0,
        float(ordered[high - 1]) if high <= n else math.inf,
    )


def views_as_poses(views: Views) -> NDArray[np.float64]:
    """Return views as transforms from the landmark's to the camera's frame, (n, 4, 4)."""
    rotation, translation = views.landmark2cam()
    out = np.zeros((len(views), 4, 4))
    out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = rotation, translation, 1.0
    return out


def _matrices(poses: ArrayLike | Views) -> NDArray[np.float64]:
    if isinstance(poses, Views):
        return views_as_poses(poses)
    array = np.asarray(poses, np.float64)
    if array.ndim != 3 or array.shape[1:] != (4, 4):
        raise UsageError(f"poses must have shape (n, 4, 4), got {array.shape}")
    return array


def _motions(poses: NDArray[np.float64], which: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the transforms from some poses to those that follow them, (k, 4, 4)."""
    return np.asarray(np.linalg.solve(poses[which], poses[which + 1]), np.float64)


def _nearest_turn(found: NDArray[np.float64], truth: NDArray[np.float64], symmetry: int) -> NDArray[np.float64]:
    """Return poses with the landmark turned about its axis to where it is nearest to the truth."""
    angle = 2 * np.pi * np.arange(symmetry) / symmetry
    turns = np.zeros((symmetry, 4, 4))
    turns[:, 0, 0] = turns[:, 1, 1] = np.cos(angle)
    turns[:, 1, 0], turns[:, 0, 1] = np.sin(angle), -np.sin(angle)
    turns[:, 2, 2] = turns[:, 3, 3] = 1.0
    turned = np.einsum("nij,sjk->nsik", found, turns)
    errors = np.stack([_differences(turned[:, s], truth)[1] for s in range(symmetry)], axis=1)
    return np.asarray(turned[np.arange(len(found)), errors.argmin(axis=1)])


def _differences(
    found: NDArray[np.float64], truth: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return differences of position, (n, 3), and the angles between orientations, (n,)."""
    between = np.einsum("nij,nkj->nik", found[:, :3, :3], truth[:, :3, :3])
    twist = 0.5 * np.stack([between[:, i, j] - between[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))], axis=1)
    cosine = 0.5 * (np.einsum("nii->n", between) - 1)
    return found[:, :3, 3] - truth[:, :3, 3], np.arctan2(np.linalg.norm(twist, axis=1), cosine)


def _shown(one: Interval) -> str:
    """Return a number with its interval for a table; an end that is not known is left out."""
    if not math.isfinite(one.value):
        return ""
    low, high = (f"{end:.3g}" if math.isfinite(end) else "…" for end in (one.low, one.high))
    return f"{one.value:.3g} [{low}, {high}]"


def shown_reliability(successes: int, confidence: float = CONFIDENCE) -> float:
    """Return the reliability R that a run of successes shows with some confidence, (1 − C)^(1/n); 0 of none.

    Parameters
    ----------
    successes : int
        n, without a failure.
    confidence : float
        C, in (0, 1).

    Examples
    --------
    >>> round(shown_reliability(59), 3)
    0.95
    """
    return float((1 - confidence) ** (1 / successes)) if successes else 0.0


def longest_run(good: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    ends = np.flatnonzero(~np.concatenate([[False], good, [False]]))
    return int(np.diff(ends).max()) - 1


@dataclass(frozen=True)
class PoseScore:
    """Agreement of accepted poses with a reference, in the units of the errors.

    Parameters
    ----------
    expected, answered : int
        Frames that should have an answer, and those of them that have one.
    bias, mad, rms : tuple of float
        Median error of each number; median and root mean square of the distances from it.
    std : tuple of float
        Median of the stated standard deviations.
    inside : Interval
        Share of the true poses within the stated 95 % ellipsoids.
    accepted, gross : int
        Frames with an answer, also those that should have none, and those of them that are off by more than a limit.
    run : int
        Longest run of accepted answers that are not.
    """

    expected: int
    answered: int
    bias: tuple[float, ...]
    mad: tuple[float, ...]
    rms: tuple[float, ...]
    std: tuple[float, ...]
    inside: Interval
    accepted: int
    gross: int
    run: int

    @classmethod
    def of(
        cls,
        error: NDArray[np.float64],
        covariance: NDArray[np.float64],
        accepted: NDArray[np.bool_],
        expected: NDArray[np.bool_],
        gross: Sequence[float],
    ) -> PoseScore:
        """Score poses in the order of time.

        Parameters
        ----------
        error : (n, p) float64
            Estimate less reference; rows with NaN do not count.
        covariance : (n, p, p) float64
            As stated.
        accepted, expected : (n,) bool
            Whether a frame has an answer, and whether it should.
        gross : (p,) sequence of float
            Errors beyond which an answer is false.

        Raises
        ------
        UsageError
            No frame that should have an answer has one.
        """
        known = np.isfinite(error).all(axis=1)
        used, answered = accepted & expected & known, accepted & known
        if not used.any():
            raise UsageError("no accepted frame has a true pose to compare with")
        off, matrix = error[used], covariance[used]
        bias = np.median(off, axis=0)
        false = np.asarray((np.abs(error[answered]) > gross).any(axis=1))
        return cls(
            expected=int(expected.sum()),
            answered=int(used.sum()),
            bias=tuple(bias.tolist()),
            mad=tuple(np.median(np.abs(off - bias), axis=0).tolist()),
            rms=tuple(np.sqrt(((off - bias) ** 2).mean(axis=0)).tolist()),
            std=tuple(np.median(np.sqrt(np.einsum("nii->ni", matrix)), axis=0).tolist()),
            inside=binomial_interval(int(within_ellipsoid(off, matrix).sum()), len(off), law="student"),
            accepted=len(false),
            gross=int(false.sum()),
            run=longest_run(~false),
        )

    @property
    def reliability(self) -> float:
        """Reliability that the longest run shows with 95 % confidence."""
        return shown_reliability(self.run)

    @property
    def gross_at_most(self) -> float:
        """Upper limit of the share of false answers at 95 % (Clopper and Pearson 1934): of none about 3/n."""
        right = self.accepted - self.gross
        return float(special.betaincinv(self.gross + 1, right, CONFIDENCE)) if right else 1.0

    def as_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, for JSON."""
        return {**asdict(self), "reliability": self.reliability, "gross_at_most": self.gross_at_most}
