"""Model images at any bearing, summed from images of narrow strips of columns.

A camera that turns about the vertical sees the same rays in other pixels, so that the light of a pixel is that of a
window of the image straight ahead (PHYSICS sections 1 to 3). Images of strips, each a fourth of a column wide, are
interpolated linearly in (D, δ), and the strips in the window of each pixel are added up, those at its borders by their
share. Strips are rendered where a search first needs them, and kept.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.matcher.frequencies import OneFrequencyBank
from phasemark.matcher.likelihood.images import BEFORE_LENS_M, VIEW, ImageModel, ModelImages
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD
from phasemark.matcher.nearest.grid import closing_period
from phasemark.render import PhasorImages, Renderer, Sensor, Views

__all__ = ["StripModel"]

_STRIPS = 4, 8
"""Strips in a column, and in a wide one. With two, one view in a hundred costs 80 more than rendered."""
_STEP_M, _STEPS_RAD = 0.02, (math.radians(1.0), math.radians(2.0))
"""Widest steps between nodes, the second angle for wide pixels. At 2° edges of a part at 0.7 m move by half a pixel of
2°, and some views cost 200 more than rendered."""
_MOST_BYTES = 4 << 30
"""Memory that the strips of a bank may take; it is used for those alone that were rendered."""
_ROUNDING = 1e-9
"""Rows: what a pixel sees ends at the border of a row where the camera has its horizon."""
_BEARING = VIEW.index("bearing_rad")
_Kept = tuple[NDArray[np.int64], NDArray[np.float32]]
"""Places of strips, four for each view, among those that are kept, and these."""


class StripModel(ImageModel):
    """Model images at any bearing of a level landmark at the bank's height, with nothing behind it.

    Parameters
    ----------
    bank : Bank
        Of one modulation frequency, and of a camera without distortion.
    widest_columns : int
        Bearings up to this many columns are asked for.
    """

    def __init__(self, bank: Bank, widest_columns: int) -> None:
        sensor = bank.sensor
        self._strips = strips = _strip_sensor(sensor, widest_columns)
        self._period = closing_period(bank.delta_rad)
        self._distance = _axis(bank.distance_m, _STEP_M)
        self._delta = _axis(bank.delta_rad, _STEPS_RAD[_is_wide(sensor)], self._period)
        meshes = [bank.mesh(name) for name in bank.classes]
        self._renderers = [Renderer(mesh, strips, albedo=float(mesh.metadata["albedo"])) for mesh in meshes]
        middle = strips.lower_rows[0] if bank.lower is not None else 0
        n_class, n_d, n_a = len(bank.classes), len(self._distance), len(self._delta)
        self._upper = _Rendered((n_class, n_d, 1), middle * strips.cols)
        self._lower = _Rendered((n_class if bank.lower is None else 1, n_d, n_a), (strips.rows - middle) * strips.cols)
        self._lit = _lit_boxes(strips, self._distance, [own.topology.vertices for own in self._renderers])
        self._lock = threading.Lock()
        self._borders, self._cam2level = _borders(sensor), sensor.cam2level
        tan_h, tan_v = strips.tan_half_angles
        self._projection = np.array([*strips.centre_px, strips.cols / (2 * tan_h), strips.rows / (2 * tan_v)])

    @staticmethod
    def suits(bank: Bank, widest_columns: int) -> bool:
        """Return whether a bank can have strips: more than one view, no distortion, and room for them."""
        sensor = bank.sensor
        if isinstance(bank, OneFrequencyBank) or sensor.bends_rays or 1 in (len(bank.distance_m), len(bank.delta_rad)):
            return False
        n_d = (bank.distance_m[-1] - bank.distance_m[0]) / _STEP_M
        n_a = (bank.delta_rad[-1] - bank.delta_rad[0]) / _STEPS_RAD[_is_wide(sensor)]
        n_class = 1 if bank.lower is not None else len(bank.classes)
        pixels = sensor.rows * _strips_of_column(sensor) * (sensor.cols + 2 * _margin(widest_columns))
        return bool(16 * n_class * max(n_d, 2) * max(n_a, 2) * pixels <= _MOST_BYTES)

    def limits(self, delta_rad: NDArray[np.float64], which: NDArray[np.integer] | None = None) -> tuple[float, float]:
        """Return the bank's first and last distance."""
        return float(self._distance[0]), float(self._distance[-1])

    def images(self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]) -> ModelImages:
        """Interpolate strips and add them up; pitch and roll are not seen, and their slopes are 0."""
        m, pixels = len(view), len(self._borders)
        phasor, shade = np.empty((m, pixels), np.complex128), np.empty((m, 2, pixels))
        slope = np.empty((m, 3 if free else 0, pixels), np.complex128)
        step_d, step_a = _step(self._distance), _step(self._delta)
        x = np.clip((view[:, 0] - self._distance[0]) / step_d, 0, len(self._distance) - 1)
        y = (view[:, 1] - self._delta[0]) / step_a
        n_a = len(self._delta)
        y = y % n_a if self._period is not None else np.clip(y, 0, n_a - 1)
        i = np.minimum(x.astype(np.int64), len(self._distance) - 2)
        j = y.astype(np.int64) % n_a if self._period is not None else np.minimum(y.astype(np.int64), n_a - 2)
        corners = np.stack([i, j, i, (j + 1) % n_a, i + 1, j, i + 1, (j + 1) % n_a], axis=1).reshape(m, 4, 2)
        upper, lower = self._kept(class_index, corners)
        place, step = np.stack([x - i, y - j], axis=1), np.array([step_d, step_a])
        bearings, which = np.unique(view[:, _BEARING], return_inverse=True)
        order = np.lexsort((view[:, 1], view[:, 0], class_index))  # of one heading and distance one after the other
        windows = np.empty((len(bearings), pixels, 4))
        _windows(bearings, self._cam2level, self._borders, self._projection, windows)
        _images(
            upper, lower, order, place, step, windows, which, self._lit[i], self._projection, self._strips.cols,
            phasor, slope, shade,
        )  # fmt: skip
        own = [k for k, name in enumerate(free) if name in VIEW[:3]]
        slopes = np.zeros((m, len(free), pixels), np.complex128)
        slopes[:, own] = slope[:, [VIEW.index(free[k]) for k in own]]
        return ModelImages(phasor, slopes, shade[:, 0], shade[:, 1])

    def _kept(self, class_index: NDArray[np.int64], corners: NDArray[np.int64]) -> list[_Kept]:
        """Return where the upper and the lower strips at (m, 4, 2) nodes are kept, and render those that are missing.

        The upper rows see no lower part, and a round upper part looks alike from all sides. Where a bank begins inside
        the circle of a flat landmark, an edge may reach the lens between two of its angles: these nodes are farther.
        """
        middle, rows = self._upper.pixels // self._strips.cols, self._strips.rows
        found: list[_Kept] = []
        with self._lock:
            for kept, part in ((self._upper, (0, middle)), (self._lower, (middle, rows))):
                n_class, _, n_a = kept.slot.shape
                c, i, j = (np.minimum(class_index, n_class - 1)[:, None], corners[..., 0], corners[..., 1] % n_a)
                if kept.pixels:
                    for k in np.unique(c[(kept.slot[c, i, j] < 0).any(axis=1)]):
                        wanted = np.zeros(kept.slot.shape[1:], np.bool_)
                        own = c[:, 0] == k
                        wanted[i[own], j[own]] = True
                        at_d, at_a = np.nonzero(wanted & (kept.slot[k] < 0))
                        distance, delta, renderer = self._distance[at_d], self._delta[at_a], self._renderers[k]
                        outside = renderer.footprint.nearest_m(delta, BEFORE_LENS_M)
                        views = Views.broadcast(np.maximum(distance, outside), delta)
                        kept.add(k, at_d, at_a, renderer.render_views(views, rows=part))
                found.append((kept.slot[c, i, j], kept.values))
        return found


class _Rendered:
    """Real and imaginary part, intensity and coverage of strips at the nodes that were rendered, (n, pixels, 4)."""

    def __init__(self, nodes: tuple[int, int, int], pixels: int) -> None:
        self.pixels = pixels
        self.slot = np.full(nodes, -1, np.int64)
        self.values = np.empty((0, pixels, 4), np.float32)
        self._used = 0

    def add(self, k: int, at_d: NDArray[np.int64], at_a: NDArray[np.int64], image: PhasorImages) -> None:
        """Keep images of a class; who reads the values of before goes on reading them."""
        end = self._used + len(at_d)
        if end > len(self.values):
            grown = np.empty((max(end, len(self.values) * 3 // 2), self.pixels, 4), np.float32)
            grown[: self._used] = self.values[: self._used]
            self.values = grown
        planes = image.phasor.real, image.phasor.imag, image.intensity, image.coverage
        self.values[self._used : end] = np.stack(planes, axis=-1).reshape(len(at_d), -1, 4)
        self.slot[k, at_d, at_a] = np.arange(self._used, end)
        self._used = end


def _is_wide(sensor: Sensor) -> bool:
    return sensor.pixel_rad > WIDE_PIXEL_RAD


def _strips_of_column(sensor: Sensor) -> int:
    return _STRIPS[_is_wide(sensor)]


def _margin(widest_columns: int) -> int:
    """Return how many columns beyond the image a camera sees that turns by some: at its sides columns are narrower."""
    return widest_columns + widest_columns // 3 + 1


def _strip_sensor(sensor: Sensor, widest_columns: int) -> Sensor:
    """Return the camera whose pixels are the strips of another, wider by some columns on either side."""
    (tan_h, tan_v), (u0, v0), margin = sensor.tan_half_angles, sensor.centre_px, _margin(widest_columns)
    wide = sensor.cols + 2 * margin
    n = _strips_of_column(sensor)
    return sensor.with_(
        lens=None,
        cols=n * wide,
        half_angle_h_deg=math.degrees(math.atan(tan_h * wide / sensor.cols)),
        half_angle_v_deg=math.degrees(math.atan(tan_v)),
        principal_point_px=(n * (u0 + margin), v0),
        whole_image_px=None,
        fill_factor=(1.0, 1.0),
        dead_pixels=(),
        hot_pixels=(),
        zone_offset_m=(),
        histogram=None,
        lamp_half_angle_deg=None,  # it need not light what is beyond the image
    )


def _axis(grid: NDArray[np.float64], step: float, period: float | None = None) -> NDArray[np.float64]:
    """Return the nodes of an axis of strips over the range of a bank's: regular, at most a step apart."""
    if period is not None:
        n = max(math.ceil(period / step - 1e-6), 2)
        return np.asarray(grid[0] + np.arange(n) * period / n)
    n = max(math.ceil((grid[-1] - grid[0]) / step - 1e-6) + 1, 2)
    return np.linspace(grid[0], grid[-1], n)


def _step(axis: NDArray[np.float64]) -> float:
    return float(axis[-1] - axis[0]) / (len(axis) - 1)


def _lit_boxes(
    strips: Sensor, distance_m: NDArray[np.float64], vertices: Sequence[NDArray[np.float64]]
) -> NDArray[np.int64]:
    """Return which strips may see landmarks straight ahead, (distances, 4): rows and columns, the last excluded.

    The landmarks lie in an upright cylinder about their axis.
    """
    radius = max(float(np.hypot(own[:, 0], own[:, 1]).max()) for own in vertices)
    low, high = min(float(own[:, 2].min()) for own in vertices), max(float(own[:, 2].max()) for own in vertices)
    boxes = np.empty((len(distance_m), 4), np.int64)
    for k, distance in enumerate(distance_m):
        around = np.linspace(0, 2 * np.pi, 64)
        wide = radius / math.cos(np.pi / 63)  # the polygon goes around the circle
        x, y = distance + wide * np.cos(around), wide * np.sin(around)
        points = np.array([(px, py, z) for px, py in zip(x, y, strict=True) for z in (low, high)]) @ strips.cam2level
        boxes[k] = 0, strips.rows, 0, strips.cols
        if (points[:, 0] > 0.1 * distance).all():
            u, v = strips.image_points(points[:, 1] / points[:, 0], points[:, 2] / points[:, 0])
            for part, values, n in ((slice(0, 2), v, strips.rows), (slice(2, 4), u, strips.cols)):
                boxes[k, part] = np.clip((math.floor(values.min()), math.ceil(values.max())), 0, n)
    return boxes


def _borders(sensor: Sensor) -> NDArray[np.float64]:
    """Return the level directions of the middles of the left, right, upper and lower border of the active areas."""
    v, u = (grid.ravel() + 0.5 for grid in np.mgrid[: sensor.rows, : sensor.cols])
    half_u, half_v = sensor.fill_factor[0] / 2, sensor.fill_factor[1] / 2
    points = ((u - half_u, v), (u + half_u, v), (u, v - half_v), (u, v + half_v))
    return np.ascontiguousarray(np.stack([sensor.ray_directions(*point) for point in points], axis=1))


_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})


@_compiled
def _turned_camera(bearing, cam2level, out):  # type: ignore[no-untyped-def]
    """Fill the rotation from the level frame of a camera at some bearing to the tilted camera straight ahead."""
    cos, sin = math.cos(bearing), math.sin(bearing)
    for a in range(3):
        out[a, 0] = cam2level[0, a] * cos - cam2level[1, a] * sin
        out[a, 1] = cam2level[0, a] * sin + cam2level[1, a] * cos
        out[a, 2] = cam2level[2, a]


@_compiled
def _windows(bearings, cam2level, borders, projection, out):  # type: ignore[no-untyped-def]
    """Fill first and last column and row, as image coordinates of the strips, of what pixels see at some bearings."""
    turn = np.empty((3, 3))
    for b in range(len(bearings)):
        _turned_camera(bearings[b], cam2level, turn)
        for p in range(len(borders)):
            for k in range(4):
                d0, d1, d2 = borders[p, k, 0], borders[p, k, 1], borders[p, k, 2]
                x = turn[0, 0] * d0 + turn[0, 1] * d1 + turn[0, 2] * d2
                i = 1 if k < 2 else 2
                aside = (turn[i, 0] * d0 + turn[i, 1] * d1 + turn[i, 2] * d2) / x
                out[b, p, k] = projection[i - 1] - aside * projection[i + 1]


@_compiled
def _mix(values, corners, d, a, box, first_row, cols, out):  # type: ignore[no-untyped-def]
    """Interpolate strips between two distances and two angles, in the lit rows of a group, into (strips, 4)."""
    near0, near1 = values[corners[0]], values[corners[1]]
    far0, far1 = values[corners[2]], values[corners[3]]
    w00, w01 = np.float32((1 - d) * (1 - a)), np.float32((1 - d) * a)
    w10, w11 = np.float32(d * (1 - a)), np.float32(d * a)
    for r in range(max(box[0] - first_row, 0), min(box[1] - first_row, len(near0) // cols)):
        to = (first_row + r) * cols
        for q in range(box[2], box[3]):
            at = r * cols + q
            for part in range(4):
                out[to + q, part] = (
                    w00 * near0[at, part] + w01 * near1[at, part] + w10 * far0[at, part] + w11 * far1[at, part]
                )


@_compiled
def _mix_slopes(values, corners, d, a, step, box, first_row, cols, out):  # type: ignore[no-untyped-def]
    """Fill the slopes of both parts of the phasor by D and by δ in the same way, into (strips, 4)."""
    near0, near1 = values[corners[0]], values[corners[1]]
    far0, far1 = values[corners[2]], values[corners[3]]
    d0, d1 = np.float32((1 - a) / step[0]), np.float32(a / step[0])
    a0, a1 = np.float32((1 - d) / step[1]), np.float32(d / step[1])
    for r in range(max(box[0] - first_row, 0), min(box[1] - first_row, len(near0) // cols)):
        to = (first_row + r) * cols
        for q in range(box[2], box[3]):
            at = r * cols + q
            for part in range(2):
                x00, x01, x10, x11 = near0[at, part], near1[at, part], far0[at, part], far1[at, part]
                out[to + q, part] = d0 * (x10 - x00) + d1 * (x11 - x01)
                out[to + q, 2 + part] = a0 * (x01 - x00) + a1 * (x11 - x10)


@_compiled
def _summed(strips, window, box, cols, out):  # type: ignore[no-untyped-def]
    """Fill the sums over what a pixel sees of the four numbers of strips."""
    u0, u1, v0, v1 = window[0], window[1], window[2], window[3]
    sum0, sum1, sum2, sum3 = 0.0, 0.0, 0.0, 0.0
    first, last = max(math.floor(u0), box[2]), min(math.ceil(u1), box[3])
    for r in range(max(math.floor(v0 + _ROUNDING), box[0]), min(math.ceil(v1 - _ROUNDING), box[1])):
        high = min(v1, r + 1.0) - max(v0, float(r))
        for q in range(first, last):
            share, at = high * (min(u1, q + 1.0) - max(u0, float(q))), r * cols + q
            sum0 += share * strips[at, 0]
            sum1 += share * strips[at, 1]
            sum2 += share * strips[at, 2]
            sum3 += share * strips[at, 3]
    out[0], out[1], out[2], out[3] = sum0, sum1, sum2, sum3


@_compiled
def _at(strips, first, box, u):  # type: ignore[no-untyped-def]
    """Return the light of a row of strips about a column, the mean over the width of a strip."""
    c = math.floor(u - 0.5)
    share = u - 0.5 - c
    light = 0j
    if box[2] <= c < box[3]:
        light += (1.0 - share) * complex(strips[first + c, 0], strips[first + c, 1])
    if box[2] <= c + 1 < box[3]:
        light += share * complex(strips[first + c + 1, 0], strips[first + c + 1, 1])
    return light


@_compiled
def _images(  # type: ignore[no-untyped-def]
    upper, lower, order, place, step, windows, which, lit, projection, cols, phasor, slope, shade
):
    """Fill phasor, slopes by D, δ and bearing, and intensity with coverage of m images, each between four nodes.

    The bearing moves the borders of what a pixel sees: its slope is the light that comes in there less the
    light that leaves.
    """
    n_slopes, pixels = slope.shape[1:]
    (upper_at, above), (lower_at, below) = upper, lower
    middle = above.shape[1] // cols
    sums, slopes = np.empty(4), np.empty(4)
    strips = np.empty((above.shape[1] + below.shape[1], 4), np.float32)
    steep = np.empty((len(strips) if n_slopes else 0, 4), np.float32)
    last = -1
    for k in order:
        box, d, a = lit[k], place[k, 0], place[k, 1]
        same = last >= 0 and place[last, 0] == d and place[last, 1] == a
        for i in range(4):
            same = same and lower_at[last, i] == lower_at[k, i] and upper_at[last, i] == upper_at[k, i]
        if not same:
            _mix(below, lower_at[k], d, a, box, middle, cols, strips)
            if middle:
                _mix(above, upper_at[k], d, a, box, 0, cols, strips)
            if n_slopes:
                _mix_slopes(below, lower_at[k], d, a, step, box, middle, cols, steep)
                if middle:
                    _mix_slopes(above, upper_at[k], d, a, step, box, 0, cols, steep)
        last = k
        for p in range(pixels):
            window = windows[which[k], p]
            u0, u1, v0, v1 = window[0], window[1], window[2], window[3]
            _summed(strips, window, box, cols, sums)
            area = 1.0 / ((u1 - u0) * (v1 - v0))
            light = complex(sums[0], sums[1])
            phasor[k, p], shade[k, 0, p], shade[k, 1, p] = light * area, sums[2] * area, sums[3] * area
            if n_slopes:
                _summed(steep, window, box, cols, slopes)
                # columns move as (1 + tan²) per radian
                move0 = projection[2] * (1.0 + ((projection[0] - u0) / projection[2]) ** 2)
                move1 = projection[2] * (1.0 + ((projection[0] - u1) / projection[2]) ** 2)
                by_bearing = 0j
                for r in range(max(math.floor(v0 + _ROUNDING), box[0]), min(math.ceil(v1 - _ROUNDING), box[1])):
                    high = min(v1, r + 1.0) - max(v0, float(r))
                    come, leave = _at(strips, r * cols, box, u1), _at(strips, r * cols, box, u0)
                    by_bearing += high * (move1 * come - move0 * leave)
                slope[k, 0, p] = complex(slopes[0], slopes[1]) * area
                slope[k, 1, p] = complex(slopes[2], slopes[3]) * area
                slope[k, 2, p] = (by_bearing - light * (move1 - move0) / (u1 - u0)) * area
