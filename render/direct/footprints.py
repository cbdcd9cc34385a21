"""Footprints of the zones of a direct sensor: directions and their weights (PHYSICS section 11).

A zone is a rectangle of tangents with soft borders, times the light's distribution. It may be larger than its share
of the image and overlap its neighbours. Footprints are scaled so that each zone's weight adds up to one.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.integral.arguments import Camera
from phasemark.render.kernel import inner, kernel
from phasemark.render.sensor.histogram_fields import Histogram
from phasemark.render.sensor.sensor import Sensor, refuse_no_sensor

_REACH = 2.5
"""The border's profile ends this many `blur` outside a zone: 2e-4 of its height."""

_CELLS = {1: 16, 2: 12, 3: 8, 4: 6, 8: 4}
"""Cells of the grid per zone pitch, by the number of zones along a side; more zones than stated get fewer cells."""
_REFINED = 4
"""Where no number of cells puts a sharp border onto a cell border, there are this many times as many."""


_ALIGNED = 1e-9


class Footprints(NamedTuple):
    """The zones of a sensor in image order, as the kernels take them; lengths are tangents of the ray (1, y, z).

    Parameters
    ----------
    centre : (zones, 2) float64
        y (left) and z (up) of each zone's centre.
    half : (zones, 2) float64
        Half width and half height.
    blur : (2,) float64
        1/e half width of the borders along y and z; 0: sharp.
    light : (3,) float64
        y and z of the brightest light, and the reciprocal of its variance; 0: even light.
    """

    centre: NDArray[np.float64]
    half: NDArray[np.float64]
    blur: NDArray[np.float64]
    light: NDArray[np.float64]

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Lowest and highest y, lowest and highest z that any zone sees."""
        low = (self.centre - self.half - _REACH * self.blur).min(axis=0)
        high = (self.centre + self.half + _REACH * self.blur).max(axis=0)
        return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def histogram_of(sensor: Sensor) -> Histogram:
    """Return the histogram table of a sensor.

    Raises
    ------
    UsageError
        The sensor has none, or it is none.
    """
    refuse_no_sensor(sensor)
    if sensor.histogram is None:
        raise UsageError("the sensor has no [histogram] table: its histograms are not described")
    return sensor.histogram


@lru_cache(maxsize=16)
def footprints_of(sensor: Sensor) -> Footprints:
    """Return the footprints of a sensor's zones."""
    histogram = histogram_of(sensor)
    tan_h, tan_v = sensor.tan_half_angles
    u0, v0 = sensor.centre_px
    row, col = np.mgrid[: sensor.rows, : sensor.cols] + 0.5
    pitch = np.array([2 * tan_h / sensor.cols, 2 * tan_v / sensor.rows])
    centre = np.stack([pitch[0] * (u0 - col), pitch[1] * (v0 - row)], axis=-1).reshape(-1, 2)
    scale = np.array(histogram.zone_scale) * np.array(sensor.fill_factor)
    half = np.broadcast_to(0.5 * pitch * scale, centre.shape).copy()
    soft = histogram.zone_blur > 0
    least_blur = 0.35  # borders that do not lie on cell borders are softened by this share of a cell
    least = [
        0.0 if soft or _aligned(n, s) else least_blur * p / n
        for n, s, p in zip(cells_per_zone(sensor), scale, pitch, strict=True)
    ]
    light = 0.0 if histogram.light_width is None else 1 / histogram.light_width**2
    return Footprints(centre, half, np.maximum(histogram.zone_blur, least), np.array([*histogram.light_centre, light]))


def cells_per_zone(sensor: Sensor) -> tuple[int, int]:
    """Return how many grid cells lie along the width and the height of a zone's share."""
    histogram = histogram_of(sensor)

    fewest_cells = 3
    # A sharp border that lies on no cell border gets up to this many times as many cells, until it does.
    most_refined = 5

    def cells(zones: int, scale: float) -> int:
        least = max(next((n for most, n in _CELLS.items() if zones <= most), fewest_cells), cells_of_width(sensor))
        if histogram.zone_blur > 0:
            return least
        return next((n for n in range(least, most_refined * least + 1) if _aligned(n, scale)), _REFINED * least)

    scale = [s * f for s, f in zip(histogram.zone_scale, sensor.fill_factor, strict=True)]
    return cells(sensor.cols, scale[0]), cells(sensor.rows, scale[1])


def cells_of_width(sensor: Sensor) -> int:
    """Return how many cells a side of a zone it takes for the range of a plane that faces the sensor to vary little."""
    widest, farthest = 0.105, 0.04  # tangent of a cell, and how far the range varies along it at a metre, at the border
    zones = zip(sensor.tan_half_angles, (sensor.cols, sensor.rows), strict=True)
    return math.ceil(max(2 * tan / n * max(1 / widest, tan / math.hypot(1, tan) / farthest) for tan, n in zones))


def _aligned(cells: int, scale: float) -> bool:
    """Return True if the borders of a zone of this size lie on borders of cells."""
    border = 0.5 * cells * (1 - scale)
    return abs(border - round(border)) < _ALIGNED


@lru_cache(maxsize=16)
def footprint_grid(sensor: Sensor, margin_cells: int = 0, cells: int | None = None) -> Camera:
    """Return a camera whose pixels tile what the zones see: the grid on which the scene is integrated.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    margin_cells : int
        Further cells on each side.
    cells : int, optional
        Cells along the side of a zone's share; None: as many as 1e-3 of a histogram's peak needs.
    """
    tan_h, tan_v = sensor.tan_half_angles
    n_u, n_v = cells_per_zone(sensor) if cells is None else (cells, cells)
    scale_u, scale_v = sensor.cols * n_u / (2 * tan_h), sensor.rows * n_v / (2 * tan_v)
    y_low, y_high, z_low, z_high = footprints_of(sensor).extent
    u0, v0 = sensor.centre_px[0] * n_u, sensor.centre_px[1] * n_v
    left = max(math.ceil(scale_u * y_high - u0 - _ALIGNED), 0) + margin_cells
    right = max(math.ceil(-scale_u * y_low + u0 - sensor.cols * n_u - _ALIGNED), 0) + margin_cells
    top = max(math.ceil(scale_v * z_high - v0 - _ALIGNED), 0) + margin_cells
    bottom = max(math.ceil(-scale_v * z_low + v0 - sensor.rows * n_v - _ALIGNED), 0) + margin_cells
    rows, cols = sensor.rows * n_v + top + bottom, sensor.cols * n_u + left + right
    return Camera(
        scale_u=scale_u,
        scale_v=scale_v,
        centre_u=u0 + left,
        centre_v=v0 + top,
        slope_u=1 / scale_u,
        slope_v=1 / scale_v,
        rows=rows,
        cols=cols,
        first_row=0,
        stop_row=rows,
        fill_u=1.0,
        fill_v=1.0,
        level=np.ascontiguousarray(sensor.cam2level),
    )


def zones_tile(sensor: Sensor) -> bool:
    """Return True if zones are sharp, evenly lit rectangles side by side: any grid of cells then holds them exactly."""
    histogram = histogram_of(sensor)
    scale = np.array(histogram.zone_scale) * np.array(sensor.fill_factor)
    return histogram.zone_blur == 0 and histogram.light_width is None and bool((scale == 1).all())


def footprint_areas(zones: Footprints) -> NDArray[np.float64]:
    """Return the weight of each zone's footprint over its tangents, by a fine midpoint rule; (zones,)."""
    areas = np.empty(len(zones.centre))
    _fill_areas(zones, areas)
    return areas


@inner
def border_profile(offset, half, blur):  # type: ignore[no-untyped-def]
    """Return a zone's profile at a distance from its centre: 1 inside, 0 outside, an error function between."""
    if blur <= 0.0:
        return 1.0 if abs(offset) <= half else 0.0
    return 0.5 * (math.erf((offset + half) / blur) - math.erf((offset - half) / blur))


@inner
def footprint_weight(zones, k, y, z):  # type: ignore[no-untyped-def]
    """Return how strongly zone k sees the direction (1, y, z), light included."""
    return border_weight(zones, k, y, z) * light_weight(zones, y, z)


@inner
def border_weight(zones, k, y, z):  # type: ignore[no-untyped-def]
    """Return the share of the direction (1, y, z) that zone k sees, whatever light falls there."""
    dy, dz = y - zones.centre[k, 0], z - zones.centre[k, 1]
    if abs(dy) > zones.half[k, 0] + _REACH * zones.blur[0] or abs(dz) > zones.half[k, 1] + _REACH * zones.blur[1]:
        return 0.0
    return border_profile(dy, zones.half[k, 0], zones.blur[0]) * border_profile(dz, zones.half[k, 1], zones.blur[1])


@inner
def light_weight(zones, y, z):  # type: ignore[no-untyped-def]
    """Return the lamp's light in the direction (1, y, z), 1 where it is brightest."""
    if zones.light[2] <= 0.0:
        return 1.0
    ly, lz = y - zones.light[0], z - zones.light[1]
    return math.exp(-0.5 * zones.light[2] * (ly * ly + lz * lz))


@inner
def zones_along(zones, axis, cols, place):  # type: ignore[no-untyped-def]
    """Return the first column (axis 0) or row (axis 1) of zones that may see a tangent, and the one behind the last."""
    step = 1 if axis == 0 else cols
    n = cols if axis == 0 else len(zones.centre) // cols
    first = zones.centre[0, axis]
    pitch = first - zones.centre[step, axis] if n > 1 else 1.0
    reach = zones.half[0, axis] + _REACH * zones.blur[axis] + _ALIGNED
    begin = math.ceil((first - place - reach) / pitch)
    return max(begin, 0), min(math.floor((first - place + reach) / pitch) + 1, n)


@kernel
def _fill_areas(zones, areas):  # type: ignore[no-untyped-def]
    """Fill the areas of all footprints: the profiles along y and z are independent, and so is the light."""
    area_points = 96
    for k in range(len(areas)):
        areas[k] = 1.0
        for axis in range(2):
            half, blur, centre = zones.half[k, axis], zones.blur[axis], zones.centre[k, axis] - zones.light[axis]
            reach = half + _REACH * blur
            total = 0.0
            for j in range(area_points):
                x = ((j + 0.5) / area_points * 2.0 - 1.0) * reach
                total += border_profile(x, half, blur) * math.exp(-0.5 * zones.light[2] * (x + centre) ** 2)
            areas[k] *= total * 2.0 * reach / area_points
