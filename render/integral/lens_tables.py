"""Tables of a lens with distortion for the kernels: rays of every pixel, and the radius within which edges matter."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from phasemark.render.integral.arguments import IDEAL, Distortion
from phasemark.render.integral.quadrature_rules import gauss_legendre
from phasemark.render.sensor.lens_fields import Lens
from phasemark.render.sensor.lens_map import distort
from phasemark.render.sensor.sensor import Sensor

_SLACK = 0.05
"""Share of a pixel's rays by which its corners, edge middles and centre may miss the rays between them."""
_STEP = 1e-4
"""Width of a difference of the lens's derivatives (tangent)."""


def distortion_of(sensor: Sensor, rules: tuple[int, ...]) -> Distortion:
    """Return the distortion of a sensor as the kernels take it.

    Parameters
    ----------
    sensor : Sensor
    rules : tuple of int
        Gauss points a side at which backgrounds are integrated over a pixel, fewest first; empty: there is none.
    """
    if sensor.lens is None or not sensor.bends_rays:
        return IDEAL
    return _tables(sensor.lens, sensor.rows, sensor.cols, sensor.fill_factor if rules else (1.0, 1.0), rules)


@lru_cache(maxsize=16)
def _tables(lens: Lens, rows: int, cols: int, fill_factor: tuple[float, float], rules: tuple[int, ...]) -> Distortion:
    mapped = lens.before(rows, cols)
    u, v = np.arange(2 * cols + 1) / 2, np.arange(2 * rows + 1) / 2
    nodes = np.stack(mapped.rays(*np.meshgrid(u, v)), axis=-1)
    border = np.concatenate([nodes[0], nodes[-1], nodes[:, 0], nodes[:, -1]])
    low, high = border.min(axis=0), border.max(axis=0)
    pixel = np.abs(np.concatenate([np.diff(nodes, axis=0).reshape(-1, 2), np.diff(nodes, axis=1).reshape(-1, 2)]))
    margin_px = 4.0  # how far beyond the image edges are followed; limbs are felt up to a pixel and a half beyond it
    margin = 2 * margin_px * pixel.max(axis=0)
    low, high = low - margin, high + margin
    radius = max(mapped.largest_tangent, float(np.hypot(*border.T).max()))
    inside = np.empty((0, 2))
    for at in (gauss_legendre(rule)[0] - 0.5 for rule in rules):
        grid_u, grid_v = np.meshgrid(fill_factor[0] * at, fill_factor[1] * at)
        inside = np.concatenate([inside, np.column_stack([grid_u.ravel(), grid_v.ravel()])])
    points_u = np.arange(cols)[None, :, None] + 0.5 + inside[:, 0]
    points_v = np.arange(rows)[:, None, None] + 0.5 + inside[:, 1]
    return Distortion(
        model=mapped.model,
        coefficients=mapped.k,
        nodes=nodes,
        reach=_reach(nodes),
        rule=np.stack(mapped.rays(points_u, points_v), axis=-1),
        low_y=float(low[0]),
        high_y=float(high[0]),
        low_z=float(low[1]),
        high_z=float(high[1]),
        radius=radius,
        bend=_bend(mapped.model, mapped.k, low, high, radius, float(mapped.focal_px.max())),
    )


def _reach(nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return lowest and highest y, lowest and highest z of each pixel's rays and of each row's, (rows, cols + 1, 4)."""
    rows, cols = nodes.shape[0] // 2, nodes.shape[1] // 2
    parts = np.stack([nodes[i : i + 2 * rows : 2, j : j + 2 * cols : 2] for i in range(3) for j in range(3)])
    low, high = parts.min(axis=0), parts.max(axis=0)
    slack = _SLACK * (high - low)
    low, high = low - slack, high + slack
    low = np.concatenate([low, low.min(axis=1, keepdims=True)], axis=1)
    high = np.concatenate([high, high.max(axis=1, keepdims=True)], axis=1)
    return np.ascontiguousarray(np.stack([low[..., 0], high[..., 0], low[..., 1], high[..., 1]], axis=-1))


def _bend(
    model: int, k: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], radius: float, focal: float
) -> float:
    """Return a bound of the sagitta of a line of length 1: an eighth of the largest second derivative along any."""
    left, up = np.meshgrid(np.linspace(low[0], high[0], 65), np.linspace(low[1], high[1], 65))
    x, y = -left.ravel(), -up.ravel()
    within = np.hypot(x, y) <= radius
    x, y = x[within], y[within]
    largest = 0.0
    for turn in np.linspace(0.0, np.pi, 8, endpoint=False):
        dx, dy = np.cos(turn), np.sin(turn)
        moved = []
        with np.errstate(all="ignore"):
            for side in (-1, 1):
                _, _, xx, xy, yy = distort(model, k, x + side * _STEP * dx, y + side * _STEP * dy)
                moved.append((xx * dx + xy * dy, xy * dx + yy * dy))
            second = np.hypot(moved[1][0] - moved[0][0], moved[1][1] - moved[0][1]) / (2 * _STEP)
        largest = max(largest, float(np.nanmax(second, initial=0.0)))
    return 1.2 * focal * largest / 8
