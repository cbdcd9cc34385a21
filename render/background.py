"""Background behind the landmark: nothing, a wall, a floor, or both (PHYSICS section 3)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.kernel import inner
from phasemark.render.view import FARTHEST_M, Footprint, Views

UNSTATED_ALBEDO_STD = 1.0
"""How well the logarithm of a landmark's albedo is known beside that of wall and floor where nobody states either."""
BOUNCES = 4
"""Column of the number of bounces among the parameters of a background."""
Bounces = int | Literal["all"]
"""How often light may bounce beyond the first surface."""


def check_number_of_bounces(bounces: Bounces) -> None:
    """Refuse a number of bounces that is none.

    Raises
    ------
    UsageError
    """
    number = isinstance(bounces, int) and not isinstance(bounces, bool) and bounces >= 0
    if not (number or bounces == "all"):
        raise UsageError(f"'bounces' must be 0, 1, 2, … or 'all', got {bounces!r}")


@dataclass(frozen=True)
class Background:
    """A wall, a floor, or both; the nearest is seen.

    Parameters
    ----------
    wall_m : float, optional
        Distance of the vertical plane xc·cos b + yc·sin b = wall_m, perpendicular to the horizontal line from the
        lens to the landmark's axis.
    floor_m : float, optional
        How far the plane zc = −floor_m lies below the lens.
    wall_albedo, floor_albedo : float
        Albedo of the Lambertian surfaces, in [0, 1].
    bounces : int or "all"
        How often light may bounce between landmark, wall and floor on its way, beyond the first surface it meets
        (PHYSICS section 12). The sensor must say how wide its lamp shines.
    floor_albedo_std : float
        How well the floor's albedo is known: where light bounces, matching estimates it with this prior, and has what
        is left in the covariance. Of 0.05 to 0.6: 0.33 ± 0.16.
    albedo_ratio_std : float
        Standard deviation of the logarithm of the landmark's albedo over that of wall and floor: a pixel that sees both
        has the range of their mixture. Matching ranges estimates the ratio with this prior, unless a sensor reports one
        surface or the floor's albedo is estimated; on phasors the landmark's albedo is free, and wall and floor are as
        bright as stated. 0: as it is stated.

    Raises
    ------
    UsageError
        A value is out of range.
    """

    wall_m: float | None = None
    floor_m: float | None = None
    wall_albedo: float = 0.5
    floor_albedo: float = 0.5
    bounces: Bounces = 0
    floor_albedo_std: float = 0.0
    albedo_ratio_std: float = 0.0

    def __post_init__(self) -> None:
        for name in ("wall_m", "floor_m"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(f"'{name}' must be a positive number of metres, got {value!r}")
            if value is not None and not 1 / FARTHEST_M <= value <= FARTHEST_M:
                raise UsageError(f"'{name}' must be within {1 / FARTHEST_M:g} … {FARTHEST_M:g} m, got {value!r}")
        for name in ("wall_albedo", "floor_albedo"):
            value = getattr(self, name)
            if not 0 <= value <= 1:
                raise UsageError(f"'{name}' must be in [0, 1], got {value!r}")
        check_number_of_bounces(self.bounces)
        for name in ("floor_albedo_std", "albedo_ratio_std"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise UsageError(f"'{name}' must be 0 or more, got {value!r}")

    @property
    def estimates_floor_albedo(self) -> bool:
        """Whether matching estimates the floor's albedo."""
        return bool(self.bounces and self.floor_m and self.floor_albedo_std)

    def moved_walls(self, step_m: float) -> list[Background]:
        """Return it with its wall a step farther away, and a step nearer; there has to be a wall."""
        assert self.wall_m is not None
        return [replace(self, wall_m=self.wall_m + step) for step in (step_m, -step_m)]

    def parameters(self) -> NDArray[np.float64]:
        """Return (wall_m, floor_m, wall_albedo, floor_albedo, bounces); 0: a plane that is not there, inf: all."""
        bounces = math.inf if self.bounces == "all" else self.bounces
        return np.array([self.wall_m or 0.0, self.floor_m or 0.0, self.wall_albedo, self.floor_albedo, bounces])

    def check_behind(self, landmark: Footprint, views: Views) -> None:
        """Refuse a wall before, or a floor above, any point of the landmark.

        Parameters
        ----------
        landmark : Footprint
        views : Views
            Views of the landmark.

        Raises
        ------
        UsageError
            Naming the view and what would be right.
        """
        check_behind(parameters_of_views(self, len(views)), landmark, views)

    def giving_way(self, landmark: Footprint, views: Views) -> Background:
        """Return it with wall and floor moved back to where they touch the landmark, if they would cut it.

        For views that are only tried: a landmark may stand on the floor, and a search must be free to lower it.

        Parameters
        ----------
        landmark : Footprint
        views : Views
            Views of the landmark.

        Returns
        -------
        Background
        """
        farthest, deepest = _extremes(self.wall_m or 0.0, landmark, views)
        return replace(
            self,
            wall_m=None if self.wall_m is None else max(self.wall_m, float(farthest.max(initial=0.0))),
            floor_m=None if self.floor_m is None else max(self.floor_m, float(deepest.max(initial=0.0))),
        )


Backgrounds: TypeAlias = Background | Sequence[Background | None] | None
"""What stands behind the landmark: the same in all views, or in each view; None: nothing."""


def parameters_of_views(background: Backgrounds, n: int) -> NDArray[np.float64]:
    """Return the parameters of the background of each of n views, rows as :meth:`Background.parameters` returns them.

    Parameters
    ----------
    background : Background or sequence of Background, optional
    n : int
        Number of views.

    Returns
    -------
    (n, 5) float64

    Raises
    ------
    UsageError
        There are more or fewer backgrounds than views, or one is something else.
    """
    if background is None or isinstance(background, Background):
        return np.tile((background or Background()).parameters(), (n, 1))
    if not isinstance(background, Sequence) or any(not isinstance(own, Background | None) for own in background):
        raise UsageError(
            f"'background' must be a Background, as Background(wall_m=4.0), or one for each view, got {background!r}"
        )
    if len(background) != n:
        raise UsageError(f"'background' must be one for all {n} views or one for each, got {len(background)}")
    return np.array([(own or Background()).parameters() for own in background]).reshape(n, 5)


def check_behind(parameters: NDArray[np.float64], landmark: Footprint, views: Views) -> None:
    """Refuse what :meth:`Background.check_behind` refuses; each view has its own row of `parameters`, (n, 5)."""
    wall_m, floor_m = parameters[:, 0], parameters[:, 1]
    farthest, deepest = _extremes(wall_m, landmark, views)
    rounding_m = 1e-6  # files of meshes have single precision
    above = (floor_m > 0) & (deepest > floor_m + rounding_m)
    if above.any():
        i = int(np.argmax(above))
        raise UsageError(
            f"the floor {floor_m[i]:g} m below the lens is above the landmark's lowest point in view"
            f" {i}: 'floor_m' must be at least {deepest[i]:.4g}"
        )
    before = farthest > wall_m + 1e-9
    if before.any():
        i = int(np.argmax(before))
        raise UsageError(
            f"the wall at {wall_m[i]:g} m is before the landmark's farthest point in view {i}:"
            f" 'wall_m' must be at least {farthest[i]:.4g}"
        )


def _extremes(
    wall_m: float | NDArray[np.float64], landmark: Footprint, views: Views
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how far from the lens each view's landmark reaches, if it may reach the wall, and how far below it.

    `wall_m`, one or (n,), is 0 where there is no wall.
    """
    farthest, (x, y, _) = np.full(len(views), -np.inf), landmark.points.T
    # distance along the horizontal line of sight: D + x' cos δ + y' sin δ
    for i in np.flatnonzero((np.asarray(wall_m) > 0) & (views.distance_m + landmark.radius_m > wall_m)):
        cos, sin = math.cos(views.delta_rad[i]), math.sin(views.delta_rad[i])
        farthest[i] = views.distance_m[i] + (x * cos + y * sin).max()
    return farthest, -landmark.lowest_m - views.height_m


@inner
def nearer_plane(parameters, cos_b, sin_b, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return which plane a ray meets first: 1 the wall, 2 the floor, 0 neither; see :func:`background_hit`."""
    forward, plane, t = dx * cos_b + dy * sin_b, 0, 0.0
    if parameters[0] > 0.0 and forward > 0.0:
        plane, t = 1, parameters[0] / forward
    if parameters[1] > 0.0 and dz < 0.0 and (plane == 0 or -parameters[1] / dz < t):
        plane = 2
    return plane


@inner
def hit_of_plane(parameters, plane, cos_b, sin_b, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the result of :func:`background_hit` for one plane, whether it is the nearer one or not."""
    forward = dx * cos_b + dy * sin_b
    if plane == 1 and forward > 0.0:
        return parameters[0] / forward, parameters[2], forward
    if plane == 2 and dz < 0.0:
        return -parameters[1] / dz, parameters[3], -dz
    return 0.0, 0.0, 0.0


@inner
def background_hit(parameters, cos_b, sin_b, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return the multiple of a ray at which it meets the nearer plane, its albedo, and cos θ times the ray's length.

    The ray starts at the lens in direction (dx, dy, dz) of the level camera frame, of any length; the multiple is 0
    where nothing is met.
    """
    plane = nearer_plane(parameters, cos_b, sin_b, dx, dy, dz)
    return hit_of_plane(parameters, plane, cos_b, sin_b, dx, dy, dz)


@inner
def background_line(parameters, cos_b, sin_b, level):  # type: ignore[no-untyped-def]
    """Return the line where wall and floor meet, or the floor's horizon, as (tx, ty, tz): tx + ty · y + tz · z = 0.

    The rays (1, y, z) are those of the tilted camera; parameters as for :func:`background_edge`, with a floor.
    """
    # points of the line satisfy normal · ray = 0 in the level frame
    nx, ny, nz = parameters[1] * cos_b, parameters[1] * sin_b, parameters[0]
    if parameters[0] == 0.0:
        nx, ny, nz = 0.0, 0.0, 1.0
    # the normal in the tilted frame
    tx = nx * level[0, 0] + ny * level[1, 0] + nz * level[2, 0]
    ty = nx * level[0, 1] + ny * level[1, 1] + nz * level[2, 1]
    tz = nx * level[0, 2] + ny * level[1, 2] + nz * level[2, 2]
    return tx, ty, tz


@inner
def background_edge(parameters, cos_b, sin_b, level, camera, out):  # type: ignore[no-untyped-def]
    """Project the line where wall and floor meet, or the floor's horizon, across the image.

    Parameters
    ----------
    parameters : (4,)
        As :meth:`Background.parameters` returns them.
    cos_b, sin_b : float
        Of the bearing.
    level : (3, 3)
        Tilted to level camera frame.
    camera : Camera
        :class:`~phasemark.render.integral.arguments.Camera`.
    out : (4,), overwritten
        u, v of both ends.

    Returns
    -------
    bool
        Whether the line lies in the image.
    """
    if parameters[1] == 0.0:
        return False
    tx, ty, tz = background_line(parameters, cos_b, sin_b, level)
    # in image coordinates: k0 + ku · u + kv · v = 0
    ku, kv = -ty / camera.scale_u, -tz / camera.scale_v
    k0 = tx + ty * camera.centre_u / camera.scale_u + tz * camera.centre_v / camera.scale_v
    if abs(kv) >= abs(ku):
        if kv == 0.0:
            return False
        out[0], out[2] = -1.0, camera.cols + 1.0
        out[1], out[3] = -(k0 + ku * out[0]) / kv, -(k0 + ku * out[2]) / kv
    else:
        out[1], out[3] = -1.0, camera.rows + 1.0
        out[0], out[2] = -(k0 + kv * out[1]) / ku, -(k0 + kv * out[3]) / ku
    return True
