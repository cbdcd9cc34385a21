"""The generator of the 2005 paper: model images from a top view in two dimensions (PHYSICS section 5, paper eq. 6-9).

Each pixel column is a line through the lens, and its value is the distance to the nearest point where that line meets
the landmark's outline: the four sides of the box in the lower rows, a circle in the upper ones. What the exact
integral adds to this (area, edges, elevation, what ends within the image) is the difference between the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.sensor.frequencies import phasor_frequencies_hz
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.view import Views

Profile = Sequence[tuple[float, float]] | Callable[[NDArray[np.float64]], NDArray[np.float64]]

# Corners of a box of unit length and width, in order round it.
_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


@dataclass(frozen=True)
class PlanarLandmark:
    """A landmark as the top view knows it: a rectangle below, a circle for every height above.

    Parameters
    ----------
    box_length_m, box_width_m : float
        Sides of the box along x' and y', metres, positive. It has no height: every lower row sees it.
    profile_m : sequence of (r, z), or callable
        The upper part, a solid of revolution on the box. Either its outline, radius and height in metres, straight
        between the points; where it overhangs, the outermost radius counts, and heights outside it have no circle. Or
        a function that maps any heights z (ndarray, metres) to radii of the same shape, zero or NaN where there is no
        circle. Empty: no upper part.

    Raises
    ------
    UsageError
        A side that is not a positive number, an outline that is not pairs of numbers, or a negative radius.
    """

    box_length_m: float
    box_width_m: float
    profile_m: Profile = ()

    def __post_init__(self) -> None:
        for name in ("box_length_m", "box_width_m"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise UsageError(f"'{name}' must be a positive number of metres, got {value!r}")
        if not callable(self.profile_m):
            object.__setattr__(self, "profile_m", _outline(self.profile_m))

    def radius_m(self, z_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the radius of the upper part at heights above the box, 0 where there is none; same shape as `z_m`."""
        if callable(self.profile_m):
            radius = np.broadcast_to(np.asarray(self.profile_m(z_m), dtype=np.float64), z_m.shape)
            return np.where(np.isfinite(radius), radius, 0.0)
        widest = np.zeros(z_m.shape)
        for (r0, z0), (r1, z1) in zip(self.profile_m[:-1], self.profile_m[1:], strict=True):
            low, high = min(z0, z1), max(z0, z1)
            share = (z_m - z0) / (z1 - z0) if high > low else 0.0  # a ledge: its rim belongs to a neighbour
            widest = np.maximum(widest, np.where((z_m >= low) & (z_m <= high), r0 + share * (r1 - r0), 0.0))
        return widest


def _outline(profile: Sequence[tuple[float, float]]) -> tuple[tuple[float, float], ...]:
    if not len(profile):
        return ()
    try:
        points = np.asarray(profile, dtype=np.float64)
    except (TypeError, ValueError):  # ragged, or not numbers
        points = np.array(math.nan)
    if points.shape != (max(2, len(profile)), 2) or not np.isfinite(points).all() or (points[:, 0] < 0).any():
        shown = " ".join(repr(profile).split())
        raise UsageError(f"'profile_m' must be two points (r, z) or more, finite and with r ≥ 0, got {shown}")
    return tuple((float(r), float(z)) for r, z in points)


def planar_images(
    landmark: PlanarLandmark,
    sensor: Sensor,
    views: Views,
    *,
    albedo: float = 0.8,
    harmonics: Sequence[int] = (),
    rows: tuple[int, int] | None = None,
) -> PhasorImages:
    """Generate model images as the paper does, from the landmark's top view (PHYSICS section 5, paper eq. 6-9).

    The column with centre u is the line y = a_c x with a_c = tan α_h (1 − 2u/cols). In the lower half of the rows it
    is intersected with the four sides between the box's corners, moved by equation (9); every lower row has the same
    values, also one that in truth looks below the box. In the upper half a circle about the landmark's axis takes the
    sides' place. Its radius is that of the upper part at the height where the row's centre line passes the axis,
    z = D cos b · tan α_v (1 − 2v/rows); a row that passes above the top sees nothing.

    A pixel is one point at distance r: S_1 = ρ cos θ / r² · exp(iφ(r)) with coverage 1, or nothing with coverage 0.
    Everything is horizontal: r ignores the row's elevation, and is shorter than the range along the ray by the factor
    √(1 + t_v² / (1 + a_c²)), with t_v the tangent above; 1.7 % in the top row of 16 for 11°.

    Parameters
    ----------
    landmark : PlanarLandmark
        The landmark, as the paper draws it from above.
    sensor : Sensor
        With an even number of rows and a centred principal point, not tilted.
    views : Views
        n views at interface height; any bearing.
    albedo : float
        In (0, 1].
    harmonics : sequence of int
        Harmonic orders k > 1 wanted beside the signal.
    rows : (first, stop), optional
        Generate only these image rows.

    Returns
    -------
    PhasorImages
        n views; with `rows`, only those rows.

    Raises
    ------
    UsageError
        The camera is tilted, off-centre or not at interface height, or the lens is inside the landmark.

    Examples
    --------
    >>> from phasemark.render import Views, preset
    >>> from phasemark.render.planar import PlanarLandmark, planar_images
    >>> post = PlanarLandmark(0.24, 0.16, profile_m=[(0.035, 0.0), (0.035, 0.15)])
    >>> image = planar_images(post, preset("pmd-16x16"), Views.broadcast(1.0))
    >>> image.range_m[0, [7, 8], 7].round(3).tolist()
    [0.967, 0.88]
    """
    if not 0 < albedo <= 1:
        raise UsageError(f"'albedo' must be in (0, 1], got {albedo!r}")
    if any(order < 2 or order != int(order) for order in harmonics):
        raise UsageError(f"'harmonics' must be whole orders of 2 or more, got {tuple(harmonics)!r}")
    first, stop = rows if rows is not None else (0, sensor.rows)
    if not 0 <= first < stop <= sensor.rows:
        raise UsageError(f"'rows' must lie in 0 … {sensor.rows}, got {(first, stop)!r}")
    asked, views = views, views.in_camera(sensor)
    _refuse_out_of_plane(sensor, views)

    middle = sensor.lower_rows[0]
    upper_rows = np.arange(first, min(stop, middle))
    n_lower = stop - max(first, middle)
    tan_h, tan_v = sensor.tan_half_angles
    slope = tan_h * (1 - (2 * np.arange(sensor.cols) + 1) / sensor.cols)  # a_c
    lines = np.stack([np.ones_like(slope), slope], axis=-1) / np.hypot(1.0, slope)[:, None]

    shape = (len(views), stop - first, sensor.cols)
    distance, cos_incidence = np.full(shape, np.inf), np.zeros(shape)
    if upper_rows.size:
        passes_axis_m = (views.distance_m * np.cos(views.bearing_rad))[:, None] * (
            tan_v * (1 - (2 * upper_rows + 1) / sensor.rows)
        )
        radius = landmark.radius_m(passes_axis_m)
        _refuse_inside(views.distance_m <= radius.max(axis=1, initial=0.0), views)
        upper = np.s_[:, : upper_rows.size]
        distance[upper], cos_incidence[upper] = _meet_circles(radius, lines, views)
    if n_lower > 0:
        sides_m = np.array([landmark.box_length_m, landmark.box_width_m])
        off_axis = np.abs(views.lens_in_landmark()[:, :2])
        _refuse_inside((off_axis[:, 0] <= sides_m[0] / 2) & (off_axis[:, 1] <= sides_m[1] / 2), views)
        met, facing = _meet_box(sides_m, lines, views)
        lower = np.s_[:, upper_rows.size :]
        distance[lower], cos_incidence[lower] = met[:, None], facing[:, None]

    seen = np.isfinite(distance)
    intensity = np.where(seen, albedo * cos_incidence / distance**2, 0.0)
    if sensor.vignetting:
        intensity *= sensor.pixel_directions()[first:stop, :, 0] ** 4
    if sensor.lamp_shapes_light:
        intensity *= sensor.lamp_intensity(sensor.axis_cosine()[first:stop])
    phase = np.where(seen, distance, 0.0) / sensor.metres_per_radian
    first_hz, all_hz = sensor.frequencies_hz[0], phasor_frequencies_hz(sensor.frequencies_hz, harmonics)
    return PhasorImages(
        phasor=intensity * np.exp(1j * phase),
        intensity=intensity,
        coverage=seen.astype(np.float64),
        sensor=sensor,
        views=asked,
        harmonics={int(order): intensity * np.exp(1j * order * phase) for order in harmonics},
        by_hz={hz: intensity * np.exp(1j * hz / first_hz * phase) for hz in all_hz[1 + len(harmonics) :]},
    )


def _refuse_out_of_plane(sensor: Sensor, views: Views) -> None:
    """Refuse what a top view cannot show: it needs the interface on the line between two halves of the image."""
    needs = "the planar model needs"
    if sensor.rows % 2:
        raise UsageError(f"{needs} an even number of rows, got {sensor.rows}")
    if sensor.lens is not None:
        raise UsageError(f"{needs} an ideal lens, got a sensor with 'lens'")
    if sensor.centre_px != (sensor.cols / 2, sensor.rows / 2):
        raise UsageError(f"{needs} a centred principal point, got {sensor.centre_px}")
    for name in ("pitch_deg", "roll_deg"):
        if getattr(sensor, name):
            raise UsageError(f"{needs} '{name}' = 0, got {getattr(sensor, name)}")
    for name in ("height_m", "pitch_rad", "roll_rad"):
        values = getattr(views, name)
        off = np.flatnonzero(values)
        if off.size:
            raise UsageError(f"{needs} '{name}' = 0, got {values[off[0]]} in view {off[0]}")


def _refuse_inside(inside: NDArray[np.bool_], views: Views) -> None:
    if inside.any():
        view = int(np.argmax(inside))
        raise UsageError(
            f"in view {view} the lens is inside the landmark: 'distance_m' must be larger, got {views.distance_m[view]}"
        )


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a × b of vectors in the plane, (..., 2) → (...)."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _meet_box(
    sides_m: NDArray[np.float64], lines: NDArray[np.float64], views: Views
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distance and cosine of incidence where each line first meets the box, (n, cols) each; inf: nowhere.

    The point of the side PQ on the line t·d is at t = P × Q / (P × d − Q × d), which knows no vertical lines; the line
    meets the side if the corners are on opposite sides of it. Which side a corner is on is decided once for both sides
    that share it, so no line slips through a corner. A side that lies in the line has both corners on it and no t; the
    sides next to it have those corners.
    """
    rotation, translation = views.landmark2cam()
    corners = (_CORNERS * sides_m) @ rotation[:, :2, :2].swapaxes(1, 2) + translation[:, None, :2]  # (n, 4, 2)
    offset = _cross(corners[:, :, None], lines)  # (n, 4, cols)
    # A line that passes a corner by less than this share of the corner's distance goes through it: far below anything
    # that shows in an image, far above rounding.
    touches = 1e-12
    offset[np.abs(offset) <= touches * np.linalg.norm(corners, axis=-1)[..., None]] = 0.0
    next_corners, next_offset = np.roll(corners, -1, axis=1), np.roll(offset, -1, axis=1)
    across = offset - next_offset  # the side's length times the sine of its angle with the line
    crossed = (offset * next_offset <= 0) & (across != 0)
    divisor = np.where(crossed, across, 1.0)
    distance = np.where(crossed, _cross(corners, next_corners)[..., None] / divisor, np.inf)
    distance[distance <= 0] = np.inf  # behind the lens
    cos_incidence = np.abs(across) / np.linalg.norm(next_corners - corners, axis=-1)[..., None]
    nearest = np.argmin(distance, axis=1)[:, None]
    met, facing = (np.take_along_axis(values, nearest, axis=1)[:, 0] for values in (distance, cos_incidence))
    return met, facing


def _meet_circles(
    radius_m: NDArray[np.float64], lines: NDArray[np.float64], views: Views
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distance and cosine of incidence where each line meets each view's circles, (n, rows, cols) each."""
    _, translation = views.landmark2cam()
    axis = translation[:, None, None, :2]
    along, aside = np.sum(axis * lines, axis=-1), _cross(axis, lines)  # (n, 1, cols)
    radius = radius_m[..., None]
    met = (np.abs(aside) < radius) & (along > 0)
    half_chord = np.sqrt(np.where(met, radius**2 - aside**2, 0.0))
    return np.where(met, along - half_chord, np.inf), half_chord / np.where(met, radius, 1.0)
