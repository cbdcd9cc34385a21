"""Views of a landmark: distance, side, bearing, height, pitch and roll (PHYSICS sections 1 and 9)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.inputs.numbers import real_array
from phasemark.render.rigid import product, rigid_transforms, tilt2level

if TYPE_CHECKING:
    from phasemark.render.sensor.sensor import Sensor


FARTHEST_M = 1e6
"""No distance and no height is larger: beyond it float32 images and squared ranges lose their meaning."""
VIEW_FIELDS = ("distance_m", "delta_rad", "bearing_rad", "height_m", "pitch_rad", "roll_rad")
"""What a view is made of."""
_SHOWN = (
    ("distance_m", "D", " m"), ("delta_rad", "δ", "°"), ("bearing_rad", "bearing", "°"), ("height_m", "height", " m"),
    ("pitch_rad", "pitch", "°"), ("roll_rad", "roll", "°"),
)  # fmt: skip


def delta_period_rad(symmetry: int) -> float:
    """Return the period after which δ repeats, 2π / symmetry, radians.

    Parameters
    ----------
    symmetry : int
        How many turns about its axis leave the landmark as it is.
    """
    return 2 * math.pi / symmetry


def wrap_delta_rad(delta_rad: ArrayLike, period_rad: ArrayLike) -> NDArray[np.float64]:
    """Return angles δ brought into [0, period).

    Parameters
    ----------
    delta_rad, period_rad : array_like
        They broadcast; the period is :func:`delta_period_rad`, or a full turn where the symmetry is not known.

    Examples
    --------
    >>> float(wrap_delta_rad(-0.5, 2.0))
    1.5
    """
    period = np.asarray(period_rad, dtype=np.float64)
    wrapped = np.asarray(delta_rad, dtype=np.float64) % period
    # the modulo of a tiny negative angle rounds up to the period itself
    return np.where(wrapped >= period, 0.0, wrapped)


def wrap_delta_difference_rad(difference_rad: ArrayLike, period_rad: ArrayLike) -> NDArray[np.float64]:
    """Return differences of two δ brought into ± half a period: the shorter way round.

    A difference that is already within half a period keeps every bit.

    Parameters
    ----------
    difference_rad, period_rad : array_like
        They broadcast.

    Examples
    --------
    >>> float(wrap_delta_difference_rad(1.5, 2.0))
    -0.5
    """
    difference, period = np.asarray(difference_rad, dtype=np.float64), np.asarray(period_rad, dtype=np.float64)
    return np.asarray(difference - period * np.round(difference / period))


@dataclass(frozen=True)
class Views:
    """A batch of views of the landmark; six arrays of one length.

    Parameters
    ----------
    distance_m : (n,) float64
        Horizontal distance D from the lens to the landmark's axis.
    delta_rad : (n,) float64
        Side δ from which the landmark is seen.
    bearing_rad : (n,) float64
        Azimuth b of the landmark's axis in the camera frame.
    height_m : (n,) float64
        Height h of the landmark's origin above the lens, along the vertical.
    pitch_rad, roll_rad : (n,) float64, optional
        Tilt of what the camera is mounted on: d_level = Ry(pitch) · Rx(roll) · d, a positive pitch looking down. The
        mount's own tilt (`pitch_deg` and `roll_deg` of the sensor) comes before it. None: level.

    Raises
    ------
    UsageError
        The fields are not of one length each.

    Notes
    -----
    A camera whose mount is not as drawn sees them turned and raised: :meth:`in_camera`.
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    height_m: NDArray[np.float64]
    pitch_rad: NDArray[np.float64] = None  # type: ignore[assignment]
    roll_rad: NDArray[np.float64] = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        for name in VIEW_FIELDS[4:]:
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.zeros(np.shape(self.distance_m)))
        shapes = {name: np.shape(getattr(self, name)) for name in VIEW_FIELDS}
        if len({*shapes.values()}) > 1 or len(shapes["distance_m"]) != 1:
            lengths = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
            raise UsageError(f"views need one array of n values each, got {lengths}: Views.broadcast takes numbers too")
        for name in VIEW_FIELDS:
            object.__setattr__(self, name, np.asarray(getattr(self, name), np.float64))

    def __repr__(self) -> str:
        """Describe in one line the number and the extent of the views, without parameters that are 0 in all of them."""
        spans = []
        for name, label, unit in _SHOWN:
            values = getattr(self, name)
            values = np.degrees(values) if unit == "°" else values
            if len(values) and (name in VIEW_FIELDS[:2] or values.any()):
                ends = dict.fromkeys(f"{end:.4g}" for end in (values.min(), values.max()))
                spans.append(f"{label} {' … '.join(ends)}{unit}")
        return f"Views({len(self.distance_m)}{': ' * bool(spans)}{', '.join(spans)})"

    @classmethod
    def broadcast(
        cls,
        distance_m: ArrayLike,
        delta_rad: ArrayLike = 0.0,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
        pitch_rad: ArrayLike = 0.0,
        roll_rad: ArrayLike = 0.0,
    ) -> Views:
        """Broadcast the arguments against each other and flatten them in C order.

        Raises
        ------
        UsageError
            A value is not finite, a distance is not positive or above 1e6 m, a pitch is beyond ± 90° or a roll beyond
            ± 180°, or the shapes do not broadcast.
        """
        names = VIEW_FIELDS
        values = []
        for name, given in zip(names, (distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad), strict=True):
            try:
                values.append(real_array(name, given))
            except UsageError:
                raise
            except (TypeError, ValueError, OverflowError):
                raise UsageError(f"'{name}' must be numbers, got {given!r}") from None
        _check_values(values)
        try:
            arrays = np.broadcast_arrays(*values)
        except ValueError:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in zip(names, values, strict=True))
            raise UsageError(f"the views' shapes do not broadcast: {shapes}") from None
        # copies: what broadcast_arrays returns warns when its flags are read, as numba does
        return cls(*(np.array(array, dtype=float, order="C").ravel() for array in arrays))

    def check_possible(self) -> None:
        """Refuse views that no camera has.

        Raises
        ------
        UsageError
            As for :meth:`broadcast`.
        """
        _check_values([getattr(self, name) for name in VIEW_FIELDS])

    def __len__(self) -> int:
        return len(self.distance_m)

    def __getitem__(self, index: slice | NDArray[np.integer]) -> Views:
        return Views(*(getattr(self, name)[index] for name in VIEW_FIELDS))

    @property
    def are_tilted(self) -> bool:
        """Whether any view has a pitch or a roll."""
        return bool(self.pitch_rad.any() or self.roll_rad.any())

    def tilt2level(self) -> NDArray[np.float64]:
        """Return the rotations Ry(pitch) · Rx(roll), (n, 3, 3)."""
        return tilt2level(self.pitch_rad, self.roll_rad)

    def in_camera(self, sensor: Sensor) -> Views:
        """Return the views as a camera itself has them: the offsets of its mounting added to bearing and height.

        They are offsets in the level frame, about and along the vertical, also where the view is tilted.

        Parameters
        ----------
        sensor : Sensor
            Camera with the offsets of its mounting.
        """
        if not (sensor.bearing_offset_deg or sensor.height_offset_m):
            return self
        return replace(
            self,
            bearing_rad=self.bearing_rad + np.deg2rad(sensor.bearing_offset_deg),
            height_m=self.height_m + sensor.height_offset_m,
        )

    def landmark2cam(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return rotations (n, 3, 3) and translations (n, 3) with p_cam = R · p' + t.

        With the tilt T = Ry(pitch) · Rx(roll), R = Tᵀ · Rz(b) · R(δ) and t = Tᵀ · (Rz(b) · (D, 0, 0) + (0, 0, h)). The
        camera's frame is that of its mount: what `pitch_deg` and `roll_deg` of a sensor turn comes after it.
        """
        angle = self.bearing_rad - self.delta_rad  # R(δ) is Rz(−δ), so the two rotations add
        rotation = np.zeros((len(self), 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
        rotation[:, 1, 0] = np.sin(angle)
        rotation[:, 0, 1] = -rotation[:, 1, 0]
        rotation[:, 2, 2] = 1.0
        x, y = self.distance_m * np.cos(self.bearing_rad), self.distance_m * np.sin(self.bearing_rad)
        translation = np.stack([x, y, self.height_m], axis=-1)
        if not self.are_tilted:
            return rotation, translation
        level2tilt = self.tilt2level().transpose(0, 2, 1)
        return product(level2tilt, rotation), product(level2tilt, translation[..., None])[..., 0]

    @classmethod
    def from_landmark2cam(cls, landmark2cam: ArrayLike) -> Views:
        """Return the views of rigid transforms: the inverse of :meth:`landmark2cam`.

        Parameters
        ----------
        landmark2cam : (n, 4, 4) array_like
            Landmark frame to camera frame (x along the axis, y left, z up).

        Returns
        -------
        Views
            δ in [0, 2π), bearing and roll in (−π, π], pitch between −π/2 and π/2.

        Raises
        ------
        UsageError
            A matrix is not a rotation with a translation. Or the lens is on the landmark's axis (D = 0), where bearing
            and δ cannot be distinguished, or the optical axis is vertical (pitch = ± 90°), where bearing and
            roll cannot.

        Examples
        --------
        >>> pose = np.eye(4)
        >>> pose[:3, 3] = 1.5, 0.0, 0.1
        >>> views = Views.from_landmark2cam(pose)
        >>> float(views.distance_m[0]), float(views.height_m[0])
        (1.5, 0.1)
        """
        pose = rigid_transforms(landmark2cam)
        up = pose[:, :3, 2]  # Tᵀ · (0, 0, 1) = (−sin pitch, cos pitch · sin roll, cos pitch · cos roll)
        level = np.hypot(up[:, 1], up[:, 2])
        # A landmark's axis nearer to the optical axis than this (sine of an angle) leaves roll and bearing open.
        plumb = 1e-9
        if (level < plumb).any():
            raise UsageError(
                f"'landmark2cam' must not look straight up or down, where bearing and roll are one:"
                f" matrix {int((level < plumb).argmax())} does"
            )
        pitch, roll = np.arctan2(-up[:, 0], level), np.arctan2(up[:, 1], up[:, 2])
        tilt = tilt2level(pitch, roll)
        x, y, height = np.einsum("nij,nj->in", tilt, pose[:, :3, 3])
        distance = np.hypot(x, y)
        if (distance == 0).any():
            raise UsageError(
                f"'landmark2cam' must not have the lens on the landmark's axis, where bearing and δ are one:"
                f" matrix {int((distance == 0).argmax())} has"
            )
        forward, left = np.einsum("nij,nj->in", tilt, pose[:, :3, 0])[:2]
        bearing = np.arctan2(y, x)
        delta = wrap_delta_rad(bearing - np.arctan2(left, forward), 2 * math.pi)
        return cls.broadcast(distance, delta, bearing, height, pitch, roll)

    def lens_in_landmark(self) -> NDArray[np.float64]:
        """Return the lens in the landmark frame, (−D cos δ, −D sin δ, −h), as (n, 3)."""
        x, y = -self.distance_m * np.cos(self.delta_rad), -self.distance_m * np.sin(self.delta_rad)
        return np.stack([x, y, -self.height_m], axis=-1)


@dataclass(frozen=True)
class Footprint:
    """Box and circle around landmarks, seen from above, and their points.

    Parameters
    ----------
    low_m, high_m : (2,) float64
        Corners of the box, x' and y'.
    radius_m : float
        Largest distance of a point from the axis.
    lowest_m : float
        z' of the lowest point.
    points : (v, 3) float64
    """

    low_m: NDArray[np.float64]
    high_m: NDArray[np.float64]
    radius_m: float
    lowest_m: float
    points: NDArray[np.float64]

    @classmethod
    def of_vertices(cls, vertices: NDArray[np.float64]) -> Footprint:
        """Take the points of landmarks, (v, 3), landmark frame."""
        points = np.asarray(vertices, np.float64)
        if not len(points):
            return cls(np.zeros(2), np.zeros(2), -math.inf, math.inf, points.reshape(0, 3))
        low, high = points.min(axis=0), points.max(axis=0)
        return cls(low[:2], high[:2], float(np.hypot(*points[:, :2].T).max()), float(low[2]), points)

    def nearest_m(self, delta_rad: NDArray[np.float64], gap_m: float) -> NDArray[np.float64]:
        """Return from which D on the lens is outside of the box or of the circle, with a gap.

        Parameters
        ----------
        delta_rad : (n,) float64
        gap_m : float
            Between the lens and the nearest side.

        Returns
        -------
        (n,) float64
            A flat landmark may be seen from within its circle, where its front is before the lens.
        """
        towards = -np.stack([np.cos(delta_rad), np.sin(delta_rad)], axis=-1)
        towards = np.where(towards == 0, 1e-300, towards)
        ends = np.stack([(self.low_m - gap_m) / towards, (self.high_m + gap_m) / towards])
        enters, leaves = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        leaves = np.where((enters < leaves) & (leaves > gap_m), leaves, gap_m)
        return np.asarray(np.minimum(leaves, self.radius_m + gap_m))

    def reach_m(self, delta_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far behind their axis landmarks reach at most, (n,)."""
        away = np.stack([np.cos(delta_rad), np.sin(delta_rad)], axis=-1)
        farthest = np.maximum(away * self.low_m, away * self.high_m).sum(axis=-1)
        return np.asarray(np.minimum(farthest, self.radius_m))


def _check_values(values: Sequence[NDArray[np.float64]]) -> None:
    """Refuse views that no camera has, given field by field."""
    for name, value in zip(VIEW_FIELDS, values, strict=True):
        bad = value[~np.isfinite(value)]
        if bad.size:
            raise UsageError(f"'{name}' must be finite, got {bad.flat[0]}")
    if values[0].size and values[0].min() <= 0:
        raise UsageError(f"'distance_m' must be positive, got {values[0].min()}")
    for name, value in (("distance_m", values[0]), ("height_m", values[3])):
        if value.size and np.abs(value).max() > FARTHEST_M:
            largest = value.flat[np.abs(value).argmax()]
            raise UsageError(f"'{name}' must be at most {FARTHEST_M:g} m, got {largest:g}")
    for name, value, most in (("pitch_rad", values[4], math.pi / 2), ("roll_rad", values[5], math.pi)):
        if value.size and np.abs(value).max() > most:
            largest = value.flat[np.abs(value).argmax()]
            raise UsageError(f"'{name}' must be within ± {most:.5g} (± {math.degrees(most):g}°), got {largest:g}")
