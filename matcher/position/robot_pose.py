"""From a match to where the robot stands: position, heading and their covariance (PHYSICS section 8, paper eq. 10-14).

A landmark that looks the same from n sides leaves n poses. All of them are computed; what odometry believes puts them
in order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.view import VIEW_FIELDS

PRIOR_STD = (1.0, 1.0, 1.0)
"""Standard deviations of x, y (m) and heading (rad) of a prior that comes without a covariance."""


class ViewEstimate(Protocol):
    """Interface that a robot's position needs of a match; :class:`phasemark.matcher.Match` has it."""

    @property
    def class_name(self) -> str | None:
        """The landmark's class; None: no landmark."""

    @property
    def distance_m(self) -> float:
        """D, or NaN."""

    @property
    def delta_rad(self) -> float:
        """δ, or NaN."""

    @property
    def bearing_rad(self) -> float:
        """Azimuth b of the landmark in the camera frame."""

    @property
    def free(self) -> tuple[str, ...]:
        """Which parameters of the view were estimated."""

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Their covariance, in that order."""

    @property
    def symmetry(self) -> int:
        """How many turns about its axis leave the landmark as it is."""


@dataclass(frozen=True, eq=False)
class RobotPose:
    """One place where the robot may stand, in the global frame.

    Parameters
    ----------
    x_m, y_m : float
        The robot's centre.
    heading_rad : float
        α, from the global x axis, in (−π, π].
    lens_xy_m : (x, y)
        The lens, (X_r, Y_r) of equation (11).
    camera_heading_rad : float
        Heading of the optical axis, in (−π, π].
    gamma_rad, theta_rad : float
        Azimuth of the landmark and of the lens seen from the global origin, equations (13) and (14).
    covariance : (3, 3) float64, or None
        Of (x, y, heading); None if the match has none.
    mahalanobis : float
        Distance from the prior in standard deviations; NaN without a prior.
    """

    x_m: float
    y_m: float
    heading_rad: float
    lens_xy_m: tuple[float, float]
    camera_heading_rad: float
    gamma_rad: float
    theta_rad: float
    covariance: NDArray[np.float64] | None = None
    mahalanobis: float = math.nan

    def __repr__(self) -> str:
        """Describe the robot's pose in one line, with standard deviations if there are any."""
        std = ["", "", ""] if self._std is None else [f" ± {own:.2g}" for own in self._std]
        return (
            f"RobotPose(x {self.x_m:.4f}{std[0]} m, y {self.y_m:.4f}{std[1]} m,"
            f" heading {math.degrees(self.heading_rad):.2f}{std[2]}°)"
        )

    @property
    def _std(self) -> list[float] | None:
        """Standard deviations of x, y and heading: metres and degrees."""
        if self.covariance is None:
            return None
        x, y, heading = (math.sqrt(max(float(self.covariance[k, k]), 0.0)) for k in range(3))
        return [x, y, math.degrees(heading)]

    def as_dict(self) -> dict[str, Any]:
        """Return position and heading as plain numbers, for JSON: metres and degrees, in the covariance too."""
        covariance = self.covariance
        unit = np.array([1.0, 1.0, math.degrees(1.0)])
        std = self._std
        return {
            "x_m": self.x_m,
            "y_m": self.y_m,
            "heading_deg": math.degrees(self.heading_rad),
            "std": None if std is None else dict(zip(("x_m", "y_m", "heading_deg"), std, strict=True)),
            "covariance": None if covariance is None else (covariance * np.outer(unit, unit)).tolist(),
            "mahalanobis": self.mahalanobis if math.isfinite(self.mahalanobis) else None,
        }


def robot_poses(
    match: ViewEstimate,
    landmark_xy_m: Sequence[float],
    landmark_yaw_rad: float = 0.0,
    pan_rad: float = 0.0,
    *,
    pan_offset_xy_m: Sequence[float] = (0.0, 0.0),
    lens_offset_xy_m: Sequence[float] = (0.0, 0.0),
    symmetry: int | None = None,
    prior: Sequence[float] | None = None,
    prior_covariance: ArrayLike | None = None,
    landmark_covariance: ArrayLike | None = None,
    pan_std_rad: float = 0.0,
    mounting_covariance: ArrayLike | None = None,
) -> list[RobotPose]:
    """Return every pose of the robot that a match allows, best first (PHYSICS section 8).

    With the landmark at (X_o, Y_o) and its x' axis at heading ψ, the lens is at (X_o, Y_o) − D (cos(δ + ψ),
    sin(δ + ψ)), the optical axis at heading κ = ψ + δ − b and the robot at heading α = κ − β. The robot's centre is
    lens − Rz(α) o_pan − Rz(κ) o_lens. An n-fold landmark allows δ + k · 2π/n, k = 0 … n − 1.

    Covariances are propagated to first order, separately at each pose. Parameters of the view that the match did not
    estimate count as exact.

    Parameters
    ----------
    match : Match
        Of one frame.
    landmark_xy_m : (x, y)
        The landmark's axis in the global frame.
    landmark_yaw_rad : float
        ψ, heading of the landmark's x' axis.
    pan_rad : float
        β, pan angle of the camera on the robot.
    pan_offset_xy_m : (x, y)
        o_pan, the pan axis in the robot's frame (x forward, y left).
    lens_offset_xy_m : (x, y)
        o_lens, the lens in the frame that turns with the camera, from the pan axis.
    symmetry : int, optional
        n, in place of the match's.
    prior : (x, y, heading), optional
        Where odometry believes the robot is: metres, metres, radians. Poses come in the order of their Mahalanobis
        distance √(eᵀ (P_prior + P_pose)⁻¹ e) from it, the heading's difference wrapped. None: in the order of k.
    prior_covariance : (3, 3) array_like, optional
        Of the prior. None: standard deviations :data:`PRIOR_STD`.
    landmark_covariance : (3, 3) array_like, optional
        Of (X_o, Y_o, ψ) in the map. None: exact.
    pan_std_rad : float
        Standard deviation of β.
    mounting_covariance : (4, 4) array_like, optional
        Of (o_pan x, o_pan y, o_lens x, o_lens y). None: exact.

    Returns
    -------
    list of RobotPose
        n poses; none if the match says that there is no landmark, or too little was seen to place it.

    Raises
    ------
    UsageError
        A value that is not finite, a distance that is not positive, a covariance of the wrong shape or not positive
        semidefinite, a symmetry below 1, a prior's covariance without the prior.

    Examples
    --------
    >>> from phasemark.matcher import Match, robot_poses
    >>> match = Match("cone", True, distance_m=1.0, delta_rad=0.5, symmetry=2)
    >>> [(round(pose.x_m, 3), round(pose.y_m, 3)) for pose in robot_poses(match, (2.0, 1.0), prior=(3.0, 1.0, 3.0))]
    [(2.878, 1.479), (1.122, 0.521)]
    """
    landmark = _finite("landmark_xy_m", landmark_xy_m, 2)
    pan_offset = _finite("pan_offset_xy_m", pan_offset_xy_m, 2)
    lens_offset = _finite("lens_offset_xy_m", lens_offset_xy_m, 2)
    yaw, pan = _finite("landmark_yaw_rad", landmark_yaw_rad), _finite("pan_rad", pan_rad)
    n = match.symmetry if symmetry is None else symmetry
    if not isinstance(n, int | np.integer) or n < 1:
        raise UsageError(f"'symmetry' must be a whole number of at least 1, got {n!r}")
    believed, believed_covariance = _prior(prior, prior_covariance)
    others = _covariance_of_others(landmark_covariance, pan_std_rad, mounting_covariance)
    if match.class_name is None or not (math.isfinite(match.distance_m) and math.isfinite(match.delta_rad)):
        return []
    if match.distance_m <= 0:
        raise UsageError(f"'match.distance_m' must be positive, got {match.distance_m!r}")
    bearing = float(_finite("match.bearing_rad", match.bearing_rad))
    of_view = _covariance_of_view(match)

    poses = []
    for k in range(n):
        line_of_sight = match.delta_rad + 2 * math.pi * k / n + float(yaw)
        camera_heading = line_of_sight - bearing
        heading = camera_heading - float(pan)
        towards = _rotation(line_of_sight)[:, 0]
        lens = landmark - match.distance_m * towards
        to_pan, to_lens = _rotation(heading) @ pan_offset, _rotation(camera_heading) @ lens_offset
        pose = np.array([*(lens - to_pan - to_lens), _wrap(heading)])
        covariance = None
        if of_view is not None:
            jacobian = pose_jacobian(match.distance_m, towards, heading, camera_heading, to_pan, to_lens)
            both = np.zeros((len(jacobian.T), len(jacobian.T)))
            both[:3, :3], both[3:, 3:] = of_view, others
            covariance = jacobian @ both @ jacobian.T
        mahalanobis = math.nan
        if believed is not None:
            mahalanobis = _mahalanobis(pose - believed, believed_covariance, covariance)
        poses.append(
            RobotPose(
                x_m=float(pose[0]),
                y_m=float(pose[1]),
                heading_rad=float(pose[2]),
                lens_xy_m=(float(lens[0]), float(lens[1])),
                camera_heading_rad=_wrap(camera_heading),
                gamma_rad=math.atan2(landmark[1], landmark[0]),
                theta_rad=math.atan2(lens[1], lens[0]),
                covariance=covariance,
                mahalanobis=mahalanobis,
            )
        )
    return poses if believed is None else sorted(poses, key=lambda pose: pose.mahalanobis)


def pose_jacobian(
    distance_m: float,
    towards: NDArray[np.float64],
    heading_rad: float,
    camera_heading_rad: float,
    to_pan: NDArray[np.float64],
    to_lens: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return ∂(x, y, α) / ∂(D, δ, b, X_o, Y_o, ψ, β, o_pan, o_lens), (3, 11).

    `to_pan` and `to_lens` are the offsets in the global frame; a vector that turns changes by itself turned by 90°.
    """
    across, pan_turns, lens_turns = (np.array([-v[1], v[0]]) for v in (towards, to_pan, to_lens))
    heading_moves = -pan_turns  # of the centre, by a change of α alone
    camera_moves = -lens_turns  # and of κ alone
    orbit = -distance_m * across + heading_moves + camera_moves  # δ and ψ turn everything about the landmark
    jacobian = np.zeros((3, 11))
    jacobian[:2, 0] = -towards
    jacobian[:, 1] = [*orbit, 1.0]
    jacobian[:, 2] = [*(-heading_moves - camera_moves), -1.0]
    jacobian[:2, 3:5] = np.eye(2)
    jacobian[:, 5] = jacobian[:, 1]
    jacobian[:, 6] = [*-heading_moves, -1.0]
    jacobian[:2, 7:9] = -_rotation(heading_rad)
    jacobian[:2, 9:11] = -_rotation(camera_heading_rad)
    return jacobian


def _covariance_of_view(match: ViewEstimate) -> NDArray[np.float64] | None:
    """Return the covariance of (D, δ, b), zero where the match took a value as given; None if it has none."""
    if match.covariance is None:
        return None
    unknown = [name for name in match.free if name not in VIEW_FIELDS]
    if unknown or len(set(match.free)) != len(match.free):
        raise UsageError(f"'match.free' must name each of {', '.join(VIEW_FIELDS)} at most once, got {match.free!r}")
    given = _covariance("match.covariance", match.covariance, len(match.free))
    place = [VIEW_FIELDS.index(name) for name in match.free]
    of_view = np.zeros((len(VIEW_FIELDS), len(VIEW_FIELDS)))
    of_view[np.ix_(place, place)] = given
    return of_view[:3, :3]  # height and tilt move nothing in the plane


def _covariance_of_others(
    landmark: ArrayLike | None, pan_std_rad: float, mounting: ArrayLike | None
) -> NDArray[np.float64]:
    """Return the covariance of (X_o, Y_o, ψ, β, o_pan, o_lens), (8, 8)."""
    others = np.zeros((8, 8))
    if landmark is not None:
        others[:3, :3] = _covariance("landmark_covariance", landmark, 3)
    if not (math.isfinite(pan_std_rad) and pan_std_rad >= 0):
        raise UsageError(f"'pan_std_rad' must be finite and at least 0, got {pan_std_rad!r}")
    others[3, 3] = pan_std_rad**2
    if mounting is not None:
        others[4:, 4:] = _covariance("mounting_covariance", mounting, 4)
    return others


def _prior(
    prior: Sequence[float] | None, covariance: ArrayLike | None
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    if prior is None and covariance is not None:
        raise UsageError("'prior_covariance' needs 'prior', the pose (x, y, heading) that it belongs to")
    believed = None if prior is None else _finite("prior", prior, 3)
    if covariance is None:
        return believed, np.diag(np.square(PRIOR_STD))
    return believed, _covariance("prior_covariance", covariance, 3)


def _mahalanobis(
    difference: NDArray[np.float64], prior: NDArray[np.float64], pose: NDArray[np.float64] | None
) -> float:
    difference = np.array([*difference[:2], _wrap(difference[2])])
    total = prior if pose is None else prior + pose
    try:
        if pose is None or np.linalg.matrix_rank(prior) < len(prior):
            squared = float(difference @ np.linalg.solve(total, difference))
        else:  # beside the widths of a refused match, any number of metres, those of a prior are rounded away in a sum
            whitened = np.linalg.inv(np.linalg.cholesky(prior))
            widths, axes = np.linalg.eigh(whitened @ pose @ whitened.T)
            along = axes.T @ whitened @ difference
            squared = float((along**2 / (1 + np.maximum(widths, 0.0))).sum())
    except np.linalg.LinAlgError:
        message = "'prior_covariance' leaves a direction without any width: give each one a variance"
        raise UsageError(message) from None
    return math.sqrt(max(0.0, squared))


def _rotation(angle_rad: float) -> NDArray[np.float64]:
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _wrap(angle_rad: float) -> float:
    """Bring an angle into (−π, π]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


def _finite(name: str, value: ArrayLike, *shape: int) -> NDArray[np.float64]:
    """Return numbers as an array, refused unless they are finite and of that shape."""
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(math.nan)
    if array.shape != shape or not np.isfinite(array).all():
        wanted = f"{'×'.join(map(str, shape))} finite numbers" if shape else "a finite number"
        raise UsageError(f"'{name}' must be {wanted}, got {' '.join(repr(value).split())}")
    return array


def _covariance(name: str, value: ArrayLike, size: int) -> NDArray[np.float64]:
    """Return a covariance, refused unless it is symmetric and positive semidefinite, rounding aside."""
    matrix = _finite(name, value, size, size)
    std = np.sqrt(np.abs(np.diag(matrix)))
    scaled = matrix / np.outer(np.where(std > 0, std, 1.0), np.where(std > 0, std, 1.0))  # units differ
    symmetric = np.allclose(scaled, scaled.T, rtol=0, atol=1e-9)
    if not symmetric or (np.diag(matrix) < 0).any() or np.linalg.eigvalsh(scaled).min() < -1e-9:
        raise UsageError(f"'{name}' must be symmetric and positive semidefinite, got {matrix.tolist()}")
    return matrix
