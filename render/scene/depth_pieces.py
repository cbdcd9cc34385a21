"""Pixels of a depth image, cut where borders of zones cross them: what each piece is a part of, and its area."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from phasemark.render.direct.footprints import footprints_of
from phasemark.render.sensor.sensor import Sensor

_SPLIT = 4
"""Parts along each side of a pixel that a bent or turned border crosses; in each the border is taken to be straight."""
_NOWHERE = -1e9
"""Image coordinate of a ray that the lens does not see."""


class Pieces(NamedTuple):
    """Parts of pixels of a depth image that no border of a zone crosses.

    Parameters
    ----------
    pixel : (m,) int64
        Pixel of the depth image, counted row by row.
    u, v : (m,) float64
        Centre in the image of the sensor.
    area : (m,) float64
        Area there; a zone's share of the image is 1.
    """

    pixel: NDArray[np.int64]
    u: NDArray[np.float64]
    v: NDArray[np.float64]
    area: NDArray[np.float64]

    def weights(self, sensor: Sensor, n_pixels: int) -> csr_array:
        """Return which share of each zone's active area each pixel fills, (zones, pixels)."""
        fill = np.array(sensor.fill_factor)
        col, row = np.floor(self.u), np.floor(self.v)
        seen = (col >= 0) & (col < sensor.cols) & (row >= 0) & (row < sensor.rows)
        seen &= (np.abs(self.u - col - 0.5) < 0.5 * fill[0]) & (np.abs(self.v - row - 0.5) < 0.5 * fill[1])
        zone = (row[seen] * sensor.cols + col[seen]).astype(np.int64)
        shape = (sensor.rows * sensor.cols, n_pixels)
        return csr_array((self.area[seen] / fill.prod(), (zone, self.pixel[seen])), shape=shape)


def cut_pixels(
    x: NDArray[np.float64], y: NDArray[np.float64], sensor: Sensor, depth2camera: NDArray[np.float64]
) -> Pieces:
    """Cut the pixels of a depth image along the borders of a sensor's zones.

    Parameters
    ----------
    x, y : (W + 1,), (H + 1,) float64
        Borders of columns and rows, as tangents to the right and downwards.
    sensor : Sensor
        The camera. An ideal lens that looks along the same axes gives exact shares.
    depth2camera : (3, 3) float64
        Rotation from the optical frame of the depth image to that of the sensor.

    Returns
    -------
    Pieces
    """
    cuts = _borders(sensor)
    if sensor.bends_rays or not np.array_equal(depth2camera, np.eye(3)):
        return _bent(x, y, cuts, sensor, depth2camera)
    u, v = sensor.image_points(-x, 0.0)[0], sensor.image_points(0.0, -y)[1]
    (col, at_u, width), (row, at_v, height) = (_cut(*each) for each in zip((u, v), cuts, strict=True))
    shape = (len(row), len(col))
    return Pieces(
        (row[:, None] * (len(x) - 1) + col).ravel(),
        np.broadcast_to(at_u, shape).ravel(),
        np.broadcast_to(at_v[:, None], shape).ravel(),
        np.outer(height, width).ravel(),
    )


def _borders(sensor: Sensor) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return u and v of all borders of zones: those of active areas, and sharp ones of a direct sensor's footprints."""
    cuts = []
    footprints = None if sensor.histogram is None else footprints_of(sensor)
    for axis, n in enumerate((sensor.cols, sensor.rows)):
        sides = 0.5 * np.array([[1 - sensor.fill_factor[axis]], [1 + sensor.fill_factor[axis]]])
        at = (np.arange(n) + sides).ravel()
        if footprints is not None and footprints.blur[axis] == 0:
            scale = n / (2 * sensor.tan_half_angles[axis])
            for side in (-1, 1):
                tangents = footprints.centre[:, axis] + side * footprints.half[:, axis]
                at = np.concatenate([at, sensor.centre_px[axis] - scale * tangents])
        cuts.append(np.unique(at.round(12)))
    return cuts[0], cuts[1]


def _cut(
    borders: NDArray[np.float64], cuts: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return pixel, middle and length of the pieces of a row of pixels."""
    inside = cuts[(cuts > borders[0]) & (cuts < borders[-1])]
    at = np.union1d(borders, inside)
    middle = 0.5 * (at[1:] + at[:-1])
    return np.searchsorted(borders, middle) - 1, middle, np.diff(at)


def _bent(
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    cuts: tuple[NDArray[np.float64], NDArray[np.float64]],
    sensor: Sensor,
    depth2camera: NDArray[np.float64],
) -> Pieces:
    """Return pieces where borders of zones are no lines of the depth image: pixels that they cross are split."""
    farthest = np.inf  # tangent beyond which a lens may fold
    if sensor.lens is not None and sensor.bends_rays:
        farthest = sensor.lens.before(sensor.rows, sensor.cols).largest_tangent

    def corners(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        right, down, ahead = depth2camera @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
        safe = np.where(ahead > 0, ahead, 1.0)
        right, down = right / safe, down / safe
        seen = (ahead > 0) & (np.hypot(right, down) <= farthest)
        return tuple(np.where(seen, at, _NOWHERE).reshape(x.shape) for at in sensor.image_points(-right, -down))

    u, v = corners(*np.meshgrid(x, y))
    cell = np.searchsorted(cuts[0], u) * (len(cuts[1]) + 1) + np.searchsorted(cuts[1], v)
    four = _four(cell)
    whole = (four == four[0]).all(axis=0)
    pixel = np.arange(whole.size).reshape(whole.shape)
    row, col = np.nonzero(~whole)
    along = np.linspace(0.0, 1.0, _SPLIT + 1)
    fine_x = x[col, None] + along * np.diff(x)[col, None]
    fine_y = y[row, None] + along * np.diff(y)[row, None]
    shape = (len(row), _SPLIT + 1, _SPLIT + 1)
    split = corners(np.broadcast_to(fine_x[:, None, :], shape), np.broadcast_to(fine_y[:, :, None], shape))
    centre_u, centre_v, area = (values[whole] for values in _quadrangles(u, v))
    parts = [(pixel[whole], centre_u, centre_v, area)]
    area, number = _quadrangles(*split)[2].ravel(), np.repeat(pixel[~whole], _SPLIT**2)
    for at_u, share_u in _sides(split[0], cuts[0]):
        for at_v, share_v in _sides(split[1], cuts[1]):
            share = area * share_u * share_v
            kept = share > 0
            parts.append((number[kept], at_u[kept], at_v[kept], share[kept]))
    return Pieces(*(np.concatenate(each) for each in zip(*parts, strict=True)))


def _sides(
    corners: NDArray[np.float64], cuts: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the middle and the share of what lies between the cuts through each cell, in their order."""
    four = _four(corners)
    low, high = four.min(axis=0).ravel(), four.max(axis=0).ravel()
    first, behind = np.searchsorted(cuts, low), np.searchsorted(cuts, high)
    found, begin = [], low
    for k in range(int((behind - first).max(initial=0)) + 1):
        end = np.clip(np.append(cuts, np.inf)[np.minimum(first + k, len(cuts))], low, high)
        found.append((0.5 * (begin + end), (end - begin) / np.maximum(high - low, np.finfo(float).tiny)))
        begin = end
    return found


def _four(values: NDArray[Any]) -> NDArray[Any]:
    """Return the values at the four corners of every cell, counterclockwise, (4, ...)."""
    return np.stack([values[..., :-1, :-1], values[..., 1:, :-1], values[..., 1:, 1:], values[..., :-1, 1:]])


def _quadrangles(u: NDArray[np.float64], v: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the centre of every cell, u and v, and its area."""
    u4, v4 = _four(u), _four(v)
    area = 0.5 * np.abs((u4[2] - u4[0]) * (v4[3] - v4[1]) - (u4[3] - u4[1]) * (v4[2] - v4[0]))
    return u4.mean(axis=0), v4.mean(axis=0), area
