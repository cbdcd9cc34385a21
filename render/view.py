"""Where the landmark is seen from: equation (9) of the paper with bearing and height (PHYSICS section 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError

if TYPE_CHECKING:
    from phasemark.render.sensor.sensor import Sensor


FARTHEST_M = 1e6
"""No distance and no height is larger: beyond it float32 images and squared ranges lose their meaning."""


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
    """A batch of views of the landmark; four arrays of one length.

    Parameters
    ----------
    distance_m : (n,) float64
        Horizontal distance D from the lens to the landmark's axis.
    delta_rad : (n,) float64
        Side δ from which the landmark is seen.
    bearing_rad : (n,) float64
        Azimuth b of the landmark's axis in the camera frame.
    height_m : (n,) float64
        Height h of the landmark's origin above the optical axis.

    Notes
    -----
    A camera whose mount is not as drawn sees them turned and raised: :meth:`in_camera`.
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    bearing_rad: NDArray[np.float64]
    height_m: NDArray[np.float64]

    @classmethod
    def broadcast(
        cls,
        distance_m: ArrayLike,
        delta_rad: ArrayLike = 0.0,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
    ) -> Views:
        """Broadcast the arguments against each other and flatten them in C order.

        Raises
        ------
        UsageError
            A value is not finite, a distance is not positive or above 1e6 m, or the shapes do not broadcast.
        """
        names = ("distance_m", "delta_rad", "bearing_rad", "height_m")
        values = []
        for name, given in zip(names, (distance_m, delta_rad, bearing_rad, height_m), strict=True):
            try:
                values.append(np.asarray(given, dtype=float))
            except (TypeError, ValueError, OverflowError):
                raise UsageError(f"'{name}' must be numbers, got {given!r}") from None
        for name, value in zip(names, values, strict=True):
            bad = value[~np.isfinite(value)]
            if bad.size:
                raise UsageError(f"'{name}' must be finite, got {bad.flat[0]}")
        if values[0].size and values[0].min() <= 0:
            raise UsageError(f"'distance_m' must be positive, got {values[0].min()}")
        for name, value in (("distance_m", values[0]), ("height_m", values[3])):
            if value.size and np.abs(value).max() > FARTHEST_M:
                largest = value.flat[np.abs(value).argmax()]
                raise UsageError(f"'{name}' must be at most {FARTHEST_M:g} m, got {largest:g}")
        try:
            arrays = np.broadcast_arrays(*values)
        except ValueError:
            shapes = ", ".join(f"{name} {value.shape}" for name, value in zip(names, values, strict=True))
            raise UsageError(f"the views' shapes do not broadcast: {shapes}") from None
        # copies: what broadcast_arrays returns warns when its flags are read, as numba does
        return cls(*(np.array(array, dtype=float, order="C").ravel() for array in arrays))

    def __len__(self) -> int:
        return len(self.distance_m)

    def __getitem__(self, index: slice | NDArray[np.integer]) -> Views:
        return Views(self.distance_m[index], self.delta_rad[index], self.bearing_rad[index], self.height_m[index])

    def in_camera(self, sensor: Sensor) -> Views:
        """Return the views as a camera itself has them: the offsets of its mounting added to bearing and height.

        Parameters
        ----------
        sensor : Sensor
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

        R = Rz(b) · R(δ) and t = Rz(b) · (D, 0, 0) + (0, 0, h).
        """
        angle = self.bearing_rad - self.delta_rad  # R(δ) is Rz(−δ), so the two rotations add
        rotation = np.zeros((len(self), 3, 3))
        rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(angle)
        rotation[:, 1, 0] = np.sin(angle)
        rotation[:, 0, 1] = -rotation[:, 1, 0]
        rotation[:, 2, 2] = 1.0
        translation = np.stack(
            [
                self.distance_m * np.cos(self.bearing_rad),
                self.distance_m * np.sin(self.bearing_rad),
                self.height_m,
            ],
            axis=-1,
        )
        return rotation, translation

    def lens_in_landmark(self) -> NDArray[np.float64]:
        """Return the lens in the landmark frame, (−D cos δ, −D sin δ, −h), as (n, 3)."""
        return np.stack(
            [
                -self.distance_m * np.cos(self.delta_rad),
                -self.distance_m * np.sin(self.delta_rad),
                -self.height_m,
            ],
            axis=-1,
        )
