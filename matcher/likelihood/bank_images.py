"""Model images anywhere between the views of a bank, interpolated from it.

4 × 4 neighbours in (D, δ), cubic in both. The grid of 1 cm × 1° moves an edge by a tenth of a pixel, so all but the
pixels an edge is just entering are smooth on it; those, where a neighbour sees next to nothing, are interpolated
linearly, which cannot overshoot. On ranges without a background the error is a few thousandths of the Cramér–Rao bound
of 50 frames in the median. Where something stands behind the landmark, or on phasors, the brightness of the pixels at
the edges counts too: its slope jumps where an edge crosses a pixel's border, inside a cell of the grid, and no
interpolation follows. There, and wherever bearing or height are free, views are rendered
(:mod:`phasemark.matcher.likelihood.rendered_images`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.matcher.likelihood.images import VIEW, ImageModel, ModelImages
from phasemark.matcher.nearest.grid import closing_period, cubic_weights
from phasemark.render import PhasorImages

_STRAIGHT = 2e-3
"""Second difference of a pixel's brightness, over the brightest, that a smooth change may have, the inverse square of
the distance taken out; an edge that comes in changes it by some hundredths."""


class BankModel(ImageModel):
    """Model images interpolated from a bank, bearing and height 0.

    Parameters
    ----------
    bank : Bank
        Its grid must be regular, with at least four distances and four angles.
    """

    def __init__(self, bank: Bank) -> None:
        self._sensor = bank.sensor
        self._smooth_only = False
        self._behind = behind_arrays(None)
        self._frame: NDArray[np.int64] | None = None
        self._distance, self._delta = bank.distance_m, bank.delta_rad
        self._period = closing_period(bank.delta_rad)
        if bank.full is not None:
            whole = _read(bank.full)
            self._stacks = Stack.of(whole[:, :, :1, :, :0].copy()), Stack.of(whole)
        else:
            assert bank.lower is not None
            assert bank.upper is not None
            self._stacks = Stack.of(_read(bank.upper)[:, :, None]), Stack.of(_read(bank.lower)[None])

    def before(self, behind: PhasorImages | None) -> BankModel:
        """Return the same model before another background: an image of it is composed with the landmark's.

        There is one image for all frames, or one for each.
        """
        other = copy.copy(self)
        other._behind, other._frame = behind_arrays(behind), None
        return other

    def of_frames(self, frame: NDArray[np.int64]) -> BankModel:
        """Return the model whose views are those of some frames."""
        if len(self._behind[0]) == 1:
            return self
        other = copy.copy(self)
        other._frame = frame
        return other

    def smooth(self, behind: PhasorImages | None) -> BankModel:
        """Return the same model before a background, which distrusts pixels whose brightness has a kink nearby.

        These are the pixels that an edge enters or leaves, or a crease between faces, within two steps of the grid.
        """
        other = self.before(behind)
        other._smooth_only = True
        return other

    @staticmethod
    def grid_is_fine_enough(bank: Bank, step_m: float, step_rad: float) -> bool:
        """Return True if a bank's grid is regular and no wider than some steps."""
        return all(
            len(grid) >= 4
            and grid[-1] - grid[0] <= (len(grid) - 1) * step * (1 + 1e-6)
            and np.allclose(np.diff(grid), (grid[-1] - grid[0]) / (len(grid) - 1), rtol=1e-6)
            for grid, step in ((bank.distance_m, step_m), (bank.delta_rad, step_rad))
        )

    def images(self, class_index: NDArray[np.int64], view: NDArray[np.float64], free: Sequence[str]) -> ModelImages:
        """Interpolate; distance and δ can be free."""
        m, pixels = len(view), self._sensor.rows * self._sensor.cols
        phasor, shade = np.zeros((m, pixels), np.complex128), np.zeros((m, 2, pixels))
        slope = np.zeros((m, 2 if free else 0, pixels), np.complex128)
        frame = np.zeros(m, np.int64) if self._frame is None else self._frame
        interpolate(class_index, view, *self._grid(), self._stacks, *self._behind, frame, phasor, slope, shade)
        order = [VIEW.index(name) for name in free]
        picked = slope if order == list(range(slope.shape[1])) else slope[:, order]
        return ModelImages(phasor, picked, shade[:, 0], shade[:, 1])

    def trusted(self, class_index: NDArray[np.int64], view: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which pixels are smooth enough."""
        if not self._smooth_only:
            return super().trusted(class_index, view)
        low, high, bend = np.empty((3, len(view), self._sensor.rows * self._sensor.cols))
        _extremes(class_index, view, *self._grid(), self._stacks, low, high)
        _bends(class_index, view, *self._grid(), self._stacks, bend)
        faint = 1e-5  # coverages this close to 0 or 1 count as 0 or 1
        inside = (high < faint) | (low > 1 - faint) | ((low > faint) & (high < 1 - faint))
        return inside & (bend < _STRAIGHT)

    def limits(self, delta_rad: NDArray[np.float64], which: NDArray[np.integer] | None = None) -> tuple[float, float]:
        """Return the bank's first and last distance."""
        return float(self._distance[0]), float(self._distance[-1])

    def _grid(self) -> tuple[float, float, float, float, bool]:
        step_d = float(self._distance[-1] - self._distance[0]) / (len(self._distance) - 1)
        step_a = float(self._delta[-1] - self._delta[0]) / (len(self._delta) - 1)
        return float(self._distance[0]), step_d, float(self._delta[0]), step_a, self._period is not None


class Stack(NamedTuple):
    """Images of the upper or the lower rows of a bank; pixels that see no landmark come last.

    Parameters
    ----------
    values : (class, D, δ, 4, pixels) float32
        Real and imaginary part, intensity and coverage; of one class if all have it, of one δ where all look alike.
    pixel : (pixels,) int64
        Which pixel of the images stands at each place.
    n_lit : (D,) int64
        Places from this one on are dark at this distance and beyond.
    """

    values: NDArray[np.float32]
    pixel: NDArray[np.int64]
    n_lit: NDArray[np.int64]

    @classmethod
    def of(cls, values: NDArray[np.float32]) -> Stack:
        """Order the pixels of some images, in place, by the farthest distance at which they see the landmark."""
        n_d = values.shape[1]
        last = np.full(values.shape[-1], -1)
        for i in range(n_d):
            last[values[:, i].any(axis=tuple(range(values.ndim - 2)))] = i
        pixel = np.argsort(-last, kind="stable")
        for i in range(n_d):
            values[:, i] = values[:, i][..., pixel]
        return cls(values, pixel, (last >= np.arange(n_d)[:, None]).sum(axis=1))


def _read(group: BankGroup) -> NDArray[np.float32]:
    """Return real and imaginary part, intensity and coverage of a group's images, ([class,] D[, δ], 4, pixels).

    The images are read some at a time: together with a second copy of a large bank they would not fit into memory.
    """
    stack = np.empty((0, 0), np.float32)
    for which, some in group.parts():
        planes = (some.phasor.real, some.phasor.imag, some.intensity, some.coverage)
        shape = planes[0].shape[-2:]
        if not stack.size:
            stack = np.empty((*group.n_views, len(planes), *shape), np.float32)
        for k, plane in enumerate(planes):
            stack[which][..., k, :, :] = plane
    return stack.reshape(*stack.shape[:-2], -1)


def behind_arrays(behind: PhasorImages | None) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return phasor and intensity of backgrounds, (k, pixels); without one, no pixels."""
    if behind is None:
        return np.empty((1, 0), np.complex128), np.empty((1, 0))
    return behind.phasor.reshape(len(behind.phasor), -1), behind.intensity.reshape(len(behind.intensity), -1)


@njit(cache=True, nogil=True, inline="always")
def _cell(x, n, closes):  # type: ignore[no-untyped-def]
    """Return the first of the four neighbours of x (in steps), and x's place beyond the second of them."""
    first = int(np.floor(x)) - 1
    if not closes:
        first = min(max(first, 0), n - 4)
    return first, x - first - 1.0


@njit(cache=True, nogil=True, inline="always")
def _steps_around(angle, first, step, n, closes):  # type: ignore[no-untyped-def]
    """Return an angle in steps of a grid of n angles, within its period where it closes."""
    x = (angle - first) / step
    return x - n * np.floor(x / n) if closes else x


_vectorised = njit(cache=True, nogil=True, error_model="numpy", fastmath=True)


@_vectorised
def _along_delta(n, b0, b1, b2, b3, w, dw, out, with_slopes):  # type: ignore[no-untyped-def]
    """Interpolate the first n pixels of four neighbours in δ, (4, pixels) each, into `out` (8, pixels).

    Its rows are value and slope of the real part, of the imaginary part and of the coverage, and the least and greatest
    squared amplitude.
    """
    w0, w1, w2, w3 = np.float32(w[0]), np.float32(w[1]), np.float32(w[2]), np.float32(w[3])
    d0, d1, d2, d3 = np.float32(dw[0]), np.float32(dw[1]), np.float32(dw[2]), np.float32(dw[3])
    for part in range(3):
        plane = 3 if part == 2 else part
        for q in range(n):
            out[2 * part, q] = w0 * b0[plane, q] + w1 * b1[plane, q] + w2 * b2[plane, q] + w3 * b3[plane, q]
        if with_slopes:
            for q in range(n):
                out[2 * part + 1, q] = d0 * b0[plane, q] + d1 * b1[plane, q] + d2 * b2[plane, q] + d3 * b3[plane, q]
    for q in range(n):
        s0, s1 = b0[0, q] * b0[0, q] + b0[1, q] * b0[1, q], b1[0, q] * b1[0, q] + b1[1, q] * b1[1, q]
        s2, s3 = b2[0, q] * b2[0, q] + b2[1, q] * b2[1, q], b3[0, q] * b3[0, q] + b3[1, q] * b3[1, q]
        out[6, q] = min(min(s0, s1), min(s2, s3))
        out[7, q] = max(max(s0, s1), max(s2, s3))


@_vectorised
def _along_distance(n, lines, w, dw, cubic, with_slopes):  # type: ignore[no-untyped-def]
    """Interpolate n pixels of four lines of :func:`_along_delta` in D, into `cubic` (11, pixels).

    Its rows are value, slope by D and slope by δ of the real part, of the imaginary part and of the coverage, and the
    least and greatest squared amplitude.
    """
    w0, w1, w2, w3 = np.float32(w[0]), np.float32(w[1]), np.float32(w[2]), np.float32(w[3])
    d0, d1, d2, d3 = np.float32(dw[0]), np.float32(dw[1]), np.float32(dw[2]), np.float32(dw[3])
    for part in range(3):
        value, slope = 2 * part, 2 * part + 1
        for q in range(n):
            x0, x1, x2, x3 = lines[0, value, q], lines[1, value, q], lines[2, value, q], lines[3, value, q]
            cubic[3 * part, q] = w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3
            if with_slopes:
                cubic[3 * part + 1, q] = d0 * x0 + d1 * x1 + d2 * x2 + d3 * x3
        if with_slopes:
            for q in range(n):
                x0, x1, x2, x3 = lines[0, slope, q], lines[1, slope, q], lines[2, slope, q], lines[3, slope, q]
                cubic[3 * part + 2, q] = w0 * x0 + w1 * x1 + w2 * x2 + w3 * x3
    for q in range(n):
        cubic[9, q] = min(min(lines[0, 6, q], lines[1, 6, q]), min(lines[2, 6, q], lines[3, 6, q]))
        cubic[10, q] = max(max(lines[0, 7, q], lines[1, 7, q]), max(lines[2, 7, q], lines[3, 7, q]))


@_vectorised
def _between(n, b00, b01, b10, b11, d, a, step_d, step_a, straight, with_slopes):  # type: ignore[no-untyped-def]
    """Interpolate n pixels linearly between two distances and two angles, into `straight` (10, pixels).

    Its first nine rows are those of :func:`_along_distance`, the last one is the intensity; `d` and `a` are the places
    between the neighbours.
    """
    w00, w01 = np.float32((1 - d) * (1 - a)), np.float32((1 - d) * a)
    w10, w11 = np.float32(d * (1 - a)), np.float32(d * a)
    d0, d1 = np.float32((1 - a) / step_d), np.float32(a / step_d)
    a0, a1 = np.float32((1 - d) / step_a), np.float32(d / step_a)
    for part in range(3):
        plane = 3 if part == 2 else part
        for q in range(n):
            x00, x01, x10, x11 = b00[plane, q], b01[plane, q], b10[plane, q], b11[plane, q]
            straight[3 * part, q] = w00 * x00 + w01 * x01 + w10 * x10 + w11 * x11
            if with_slopes:
                straight[3 * part + 1, q] = d0 * (x10 - x00) + d1 * (x11 - x01)
                straight[3 * part + 2, q] = a0 * (x01 - x00) + a1 * (x11 - x10)
    for q in range(n):
        straight[9, q] = w00 * b00[2, q] + w01 * b01[2, q] + w10 * b10[2, q] + w11 * b11[2, q]


@njit(cache=True, nogil=True)
def _conclude(m, n, pixel, first, cubic, straight, behind, behind_intensity, phasor, slope, shade):  # type: ignore[no-untyped-def]
    """Choose for each of n pixels between cubic and straight, put the background behind it, and store it."""
    with_slopes = slope.shape[1] > 0
    dim = 0.05  # where a neighbour is dimmer than this share of the brightest one, interpolate linearly
    for q in range(n):
        at = first + pixel[q]
        chosen = cubic if cubic[9, q] > dim * dim * cubic[10, q] else straight
        phasor[m, at] = complex(chosen[0, q], chosen[3, q])
        shade[m, 0, at], shade[m, 1, at] = straight[9, q], straight[6, q]
        if len(behind):
            phasor[m, at] += (1 - chosen[6, q]) * behind[at]
            shade[m, 0, at] += (1 - straight[6, q]) * behind_intensity[at]
        if with_slopes:
            for k in range(2):
                slope[m, k, at] = complex(chosen[1 + k, q], chosen[4 + k, q])
                if len(behind):
                    slope[m, k, at] -= chosen[7 + k, q] * behind[at]
    if len(behind):
        for q in range(n, len(pixel)):
            phasor[m, first + pixel[q]] = behind[first + pixel[q]]
            shade[m, 0, first + pixel[q]] = behind_intensity[first + pixel[q]]


@njit(cache=True, nogil=True, inline="always")
def _straight_cell(t):  # type: ignore[no-untyped-def]
    """Return which of the neighbours at −1, 0, 1, 2 (counted from 0) is the last before t, and how far t is beyond."""
    k = min(max(int(np.floor(t)), -1), 1)
    return k + 1, t - k


@njit(cache=True, nogil=True)
def interpolate(  # type: ignore[no-untyped-def]
    class_index, view, first_d, step_d, first_a, step_a, closes, stacks, behind, behind_intensity, frame,
    phasor, slope, shade,
):  # fmt: skip
    """Fill phasor, its slopes by D and δ, and intensity with coverage, of m views; what comes in is 0.

    `frame` (m,) says which of the backgrounds (k, pixels) each view has.
    """
    n_d, n_a = stacks[1].values.shape[1:3]
    most = max(len(stacks[0].pixel), len(stacks[1].pixel))
    wd, dwd, wa, dwa = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    once, never = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(4)
    lines, cubic = np.empty((4, 8, most), np.float32), np.empty((11, most), np.float32)
    straight = np.empty((10, most), np.float32)
    with_slopes = slope.shape[1] > 0
    for m in range(len(class_index)):
        i0, td = _cell((view[m, 0] - first_d) / step_d, n_d, False)
        j0, ta = _cell(_steps_around(view[m, 1], first_a, step_a, n_a, closes), n_a, closes)
        cubic_weights(td, wd, dwd)
        cubic_weights(ta, wa, dwa)
        dwd /= step_d
        dwa /= step_a
        k, d = _straight_cell(td)
        kj, a = _straight_cell(ta)
        first = 0
        for stack in stacks:
            n, values = stack.n_lit[i0], stack.values[min(class_index[m], len(stack.values) - 1)]
            own = values.shape[1]
            w, dw, place = (wa, dwa, a) if own > 1 else (once, never, 0.0)
            for b in range(4):
                line = values[i0 + b]
                _along_delta(
                    n, line[j0 % own], line[(j0 + 1) % own], line[(j0 + 2) % own], line[(j0 + 3) % own], w, dw,
                    lines[b], with_slopes,
                )  # fmt: skip
            _along_distance(n, lines, wd, dwd, cubic, with_slopes)
            near, far, j, after = values[i0 + k], values[i0 + k + 1], (j0 + kj) % own, (j0 + kj + 1) % own
            _between(n, near[j], near[after], far[j], far[after], d, place, step_d, step_a, straight, with_slopes)
            _conclude(
                m, n, stack.pixel, first, cubic, straight, behind[frame[m]], behind_intensity[frame[m]],
                phasor, slope, shade,
            )  # fmt: skip
            first += len(stack.pixel)


@njit(cache=True, nogil=True)
def _extremes(class_index, view, first_d, step_d, first_a, step_a, closes, stacks, low, high):  # type: ignore[no-untyped-def]
    """Fill the least and greatest coverage among the neighbours of m views."""
    n_d, n_a = stacks[1].values.shape[1:3]
    least, most = np.empty(low.shape[1]), np.empty(low.shape[1])
    for m in range(len(class_index)):
        i0, _ = _cell((view[m, 0] - first_d) / step_d, n_d, False)
        j0, _ = _cell(_steps_around(view[m, 1], first_a, step_a, n_a, closes), n_a, closes)
        low[m], high[m] = 0.0, 0.0
        first = 0
        for stack in stacks:
            values = stack.values[min(class_index[m], len(stack.values) - 1)]
            least[:], most[:] = np.inf, 0.0
            for a in range(4):
                for b in range(min(4, values.shape[1])):
                    cover = values[i0 + a, (j0 + b) % values.shape[1], 3]
                    for q in range(stack.n_lit[i0]):
                        least[q], most[q] = min(least[q], cover[q]), max(most[q], cover[q])
            for q in range(stack.n_lit[i0]):
                low[m, first + stack.pixel[q]], high[m, first + stack.pixel[q]] = least[q], most[q]
            first += len(stack.pixel)


@njit(cache=True, nogil=True)
def _bends(class_index, view, first_d, step_d, first_a, step_a, closes, stacks, bend):  # type: ignore[no-untyped-def]
    """Fill the largest second difference of the intensity among the neighbours of m views, over the brightest pixel.

    Along D the intensity times D² is differenced, D in steps, over the D² of the middle.
    """
    n_d, n_a = stacks[1].values.shape[1:3]
    nearer, farther = np.empty(3), np.empty(3)
    for m in range(len(class_index)):
        i0, _ = _cell((view[m, 0] - first_d) / step_d, n_d, False)
        j0, _ = _cell(_steps_around(view[m, 1], first_a, step_a, n_a, closes), n_a, closes)
        for a in range(1, 3):
            middle_d = first_d / step_d + i0 + a
            nearer[a], farther[a] = (1 - 1 / middle_d) ** 2, (1 + 1 / middle_d) ** 2
        brightest = 1e-30
        bend[m] = 0.0
        first = 0
        for stack in stacks:
            values = stack.values[min(class_index[m], len(stack.values) - 1)]
            own = values.shape[1]
            for q in range(stack.n_lit[i0]):
                most = 0.0
                for a in range(4) if own > 1 else range(1, 3):
                    for b in range(min(4, own)):
                        j = (j0 + b) % own
                        middle = values[i0 + a, j, 2, q]
                        brightest = max(brightest, middle)
                        if 0 < a < 3:
                            ends = nearer[a] * values[i0 + a - 1, j, 2, q] + farther[a] * values[i0 + a + 1, j, 2, q]
                            most = max(most, abs(ends - 2 * middle))
                        if 0 < b < 3:
                            ends = values[i0 + a, (j - 1) % own, 2, q] + values[i0 + a, (j + 1) % own, 2, q]
                            most = max(most, abs(ends - 2 * middle))
                bend[m, first + stack.pixel[q]] = most
            first += len(stack.pixel)
        bend[m] /= brightest
