"""Lower bounds of a frame's cost over the cells of a bank's grid.

A cell spans half a step of the grid to either side of its centre. What its views may show in a pixel lies in an
interval of ranges, which the bank's images in it span. A frame costs at least the whitened squared distance of its
returns from these intervals, so that a cell whose bound is above a limit holds no view that costs less.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.data.plans.arrays import group_rows
from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.nearest.templates import Observation, seen_by_images
from phasemark.matcher.pixel_agreement import DISAGREEMENT, FILLED_COVERAGE
from phasemark.render import PhasorImages
from phasemark.render.phasor_images import phasor_to_range_m, wrap_difference_m
from phasemark.render.threads import mapped

_FAR_M = 1e6
"""The middle of the interval of a pixel in which nothing may return: any return disagrees with it."""
_BLOCK = 32
"""Pixels after which a bound is compared with its limit."""
_ALONG, _AROUND = 4, 5
"""Cells of a block, along D and δ: what they may show together is compared first."""
_JUMP_M = 0.04
"""Ranges of a pixel that differ by more from node to node are those of two surfaces."""
WIDE_PIXEL_RAD = math.radians(2.0)
"""Pixels wider than this show so much that the bank's images do not tell what they show a part of a pixel aside."""
_WIDER = 1.25
"""Factor on the intervals: within a cell, ranges bend."""


_Frame = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
Turned = Callable[[int, float, NDArray[np.float64]], Sequence[PhasorImages]]
"""Returns images of views at some bearings: of a class, at a distance, from angles."""


class Cells(NamedTuple):
    """Range intervals of the views of cells; (cells, pixels) arrays.

    Parameters
    ----------
    middle_m, half_m
        Interval of ranges.
    must_return
        1 where every view of the cell returns, 0 elsewhere.
    """

    middle_m: NDArray[np.float32]
    half_m: NDArray[np.float32]
    must_return: NDArray[np.uint8]


class CellBounds:
    """The cells of a bank before one background, and what frames cost in them at least.

    Parameters
    ----------
    bank : Bank
    stride : (distance, delta)
        Every how many steps of the bank's grid a cell has its centre.
    behind : PhasorImages, optional
        What stands behind the landmark; None: nothing.
    aside, upward : bool
        Whether frames come shifted by whole columns, and rows, so that a cell spans half a one to either side.
    open_edges : bool
        Whether something unknown stands behind the landmark: a pixel that it does not fill may show any range.
    turned : callable, optional
        Returns views at other bearings within half a column, for the centres of cells. Without it a column may show at
        those no more than it and its neighbours do, which is too little where columns are wide.
    only : (class, distance) bool, optional
        Which rows of cells are asked for; the others cost infinitely much. None: all.
    ratios : sequence of float
        Factors on the landmark's brightness beside the background's, between which it may lie, about 1.
    workers : int
        Threads in which cells are made.

    Attributes
    ----------
    distance_m, delta_rad : float64
        Centres of the cells.
    closes : bool
        Whether the last angle is next to the first.
    shape : (int, int, int)
        Number of classes, distances and angles.
    """

    def __init__(
        self,
        bank: Bank,
        stride: tuple[int, int],
        behind: PhasorImages | None,
        *,
        aside: bool = False,
        upward: bool = False,
        open_edges: bool = False,
        turned: Turned | None = None,
        only: NDArray[np.bool_] | None = None,
        ratios: Sequence[float] = (),
        workers: int = 1,
    ) -> None:
        self._only = only
        self.closes = closing_period(bank.delta_rad) is not None
        along, around = len(bank.distance_m), len(bank.delta_rad)
        centres = _centres(along, stride[0], False), _centres(around, stride[1], self.closes)
        self.distance_m, self.delta_rad = bank.distance_m[centres[0]], bank.delta_rad[centres[1]]
        self._period_m = bank.sensor.unambiguous_range_m
        cols = bank.sensor.cols
        parts = {}
        for name in ("full", "lower", "upper"):
            group: BankGroup | None = getattr(bank, name)
            if group is None:
                continue
            rows = group_rows(name, bank.sensor)
            seen = _Seen(behind, rows, open_edges, aside, upward, ratios)
            found = _cells_of_group(bank, group, centres, stride, self.closes, seen, turned, only, workers)
            # pixels that differ most from cell to cell come first: a bound that grows early is given up early
            spread = [np.where(column < _FAR_M, column, 0).var() for column in found.middle_m.T]
            order = np.argsort(-np.array(spread), kind="stable")
            pixels = np.arange(rows[0] * cols, rows[1] * cols)[order]
            for values in found:
                values[:] = values[:, order]
            parts[name] = found, pixels
        self._pose = parts["full"] if "full" in parts else parts["lower"]
        self._upper = parts.get("upper")
        self.shape = len(bank.classes), len(self.distance_m), len(self.delta_rad)
        self._blocks = _blocks_of(self._pose[0], (-1, *self.shape[1:]), self._period_m)

    def prepared(self, seen: Observation) -> list[_Frame]:
        """Return one frame as the kernels take it, of each group of the bank that is compared."""
        groups = [self._pose] if self._upper is None else [self._pose, self._upper]
        return [_prepared(seen, pixels) for _, pixels in groups]

    def fill_costs(self, out: NDArray[np.float32], frame: Sequence[_Frame], before: float, limit: float) -> None:
        """Fill what one frame costs about the middle of each cell, (class, D, δ); infinite where the bound is above.

        The intervals count as uniform errors there, so that cells near the best view cost least.

        Parameters
        ----------
        out : float32
        frame : sequence of _Frame
            Of :meth:`prepared`.
        before : float
            What is known to be added to the cost.
        limit : float
            Cost up to which a cell may hold an explanation.
        """
        out.fill(np.inf)
        rest, period = np.zeros((2, *self.shape[:2]), np.float32), np.float32(self._period_m)
        if self._upper is not None:
            cells = self._upper[0]
            everywhere = np.zeros((len(cells.middle_m), 2), np.float32)
            _everywhere(cells, *frame[1], period, np.float32(limit), everywhere)
            rest[:] = everywhere.T.reshape(rest.shape)
        _scan(self._blocks, self._pose[0], *frame[0], period, rest, np.float32(before), np.float32(limit), out)
        if self._only is not None:
            out[~self._only] = np.inf


def _prepared(seen: Observation, pixels: NDArray[np.int64]) -> _Frame:
    """Return ranges, weights, and what pixels without a return cost where one must be, (pixels,)."""
    weight = np.where(seen.returned[0, pixels], np.maximum(seen.weight[0, pixels], 1e-3), 0.0)
    absent = np.where(seen.not_returned[0, pixels], DISAGREEMENT, 0.0)
    return seen.range_m[0, pixels].astype(np.float32), weight.astype(np.float32), absent.astype(np.float32)


def _centres(n: int, stride: int, closes: bool) -> NDArray[np.int64]:
    """Return the nodes of a grid axis that cells are centred on; no node is left out at the end of an open one."""
    centres = np.arange(0, n, stride)
    return centres if closes or centres[-1] + stride // 2 >= n - 1 else np.append(centres, n - 1)


class _Seen(NamedTuple):
    """Background of the images of a bank, the rows they hold, and the shifts they are seen under."""

    behind: PhasorImages | None
    rows: tuple[int, int]
    open_edges: bool
    aside: bool
    upward: bool
    ratios: Sequence[float]


class _Intervals(NamedTuple):
    """Range intervals of images or cells; arrays of one shape, whose last axis has the pixels."""

    middle_m: NDArray[np.float64]
    half_m: NDArray[np.float64]
    may_return: NDArray[np.bool_]
    must_return: NDArray[np.bool_]

    def each(self, change: Callable[[NDArray[Any]], NDArray[Any]]) -> _Intervals:
        """Return the result of a change of every array."""
        return _Intervals(*(change(values) for values in self))


def _cells_of_group(
    bank: Bank,
    group: BankGroup,
    centres: tuple[NDArray[np.int64], NDArray[np.int64]],
    stride: tuple[int, int],
    closes: bool,
    seen: _Seen,
    turned: Turned | None,
    only: NDArray[np.bool_] | None,
    workers: int,
) -> Cells:
    """Return the cells of a group of a bank, (class, D, δ, pixels) with all but the pixels flattened."""
    has_class, has_delta = len(group.n_views) == 3 or seen.rows[0] == 0, group.n_views[-1] == len(bank.delta_rad)
    has_delta = has_delta and group is not bank.upper
    reach, n_d = (stride[0] + 1) // 2, len(bank.distance_m)
    cols, period_m = bank.sensor.cols, bank.sensor.unambiguous_range_m
    n_class, n_a = len(bank.classes) if has_class else 1, len(centres[1]) if has_delta else 1
    shape = n_class * len(centres[0]) * n_a, (seen.rows[1] - seen.rows[0]) * cols
    found = Cells(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape, np.uint8))
    asked = np.ones((n_class, len(centres[0])), np.bool_)
    if only is not None:
        asked &= only if has_class else only.any(axis=0)

    def fill(k: int) -> None:
        c, at = divmod(k, len(centres[0]))
        i = int(centres[0][at])
        rows = slice(max(i - reach, 0), min(i + reach + 1, n_d))
        part = group.part(*((slice(c, c + 1),) if has_class else ()), rows)
        there = _intervals(part.phasor, np.asarray(part.coverage), bank, rows.stop - rows.start, seen)
        cells = _hull(there, np.array([i - rows.start]), stride[0], 0, period_m)
        if has_delta:
            cells = _hull(cells, centres[1], stride[1], 1, period_m, closes)
        if turned is not None:
            delta_rad = bank.delta_rad[centres[1] if has_delta else centres[1][:1]]
            images = turned(c, float(bank.distance_m[i]), delta_rad)
            lit = slice(*seen.rows)
            aside = [_intervals(one.phasor[:, lit], one.coverage[:, lit], bank, 1, seen) for one in images]
            cells = _span([cells, *aside], period_m)
        cells = cells.each(lambda values: values[0])
        if seen.aside and turned is None:
            cells = _shifted(cells, cols, 1, period_m)
        if seen.upward:
            cells = _shifted(cells, cols, 0, period_m)
        place, packed = slice(k * n_a, (k + 1) * n_a), _packed(cells)
        found.middle_m[place], found.half_m[place], found.must_return[place] = packed

    mapped(fill, np.flatnonzero(asked).tolist(), workers)
    return found


def _intervals(
    phasor: NDArray[np.complexfloating], coverage: NDArray[np.floating], bank: Bank, n_d: int, seen: _Seen
) -> _Intervals:
    """Return what images of a bank show, (D, δ, pixels)."""
    shape = coverage.shape[-2:]
    phasor, coverage = phasor.reshape(-1, *shape), coverage.reshape(-1, *shape)
    ranges, may, must = seen_by_images(phasor, coverage, bank.sensor, seen.behind, seen.rows)
    half = np.zeros(ranges.shape)
    edge = coverage.reshape(ranges.shape) < FILLED_COVERAGE
    if bank.sensor.pixel_rad > WIDE_PIXEL_RAD:
        # half width of the interval of a wide pixel that an edge crosses, in widths of a pixel at its range: where the
        # edge comes in farther, the pixel sees another part of a surface
        farther_in = 0.2
        half[edge] = farther_in * bank.sensor.pixel_rad * np.abs(ranges[edge])
    if seen.open_edges:
        half[edge], may = _FAR_M, may | edge
    if seen.ratios and seen.behind is not None:
        mixed = edge & may
        share = 1 - coverage.reshape(ranges.shape)[mixed]
        behind = share * np.broadcast_to(seen.behind.phasor[0, slice(*seen.rows)].ravel(), ranges.shape)[mixed]
        own = phasor.reshape(ranges.shape)[mixed]
        off = [
            wrap_difference_m(phasor_to_range_m(ratio * own + behind, bank.sensor) - ranges[mixed], bank.sensor)
            for ratio in seen.ratios
        ]
        low, high = np.minimum(0.0, np.min(off, axis=0)), np.maximum(0.0, np.max(off, axis=0))
        ranges[mixed] += (low + high) / 2
        half[mixed] += (high - low) / 2
    return _Intervals(ranges, half, may, must).each(lambda values: values.reshape(n_d, -1, ranges.shape[1]))


def _hull(
    cells: _Intervals, centres: NDArray[np.int64], stride: int, axis: int, period_m: float, closes: bool = False
) -> _Intervals:
    """Return the intervals that span half a stride to either side of some nodes of one axis."""
    n = cells.middle_m.shape[axis]

    def at(offset: int) -> _Intervals:
        index = (centres + offset) % n if closes else np.clip(centres + offset, 0, n - 1)
        return cells.each(lambda values: np.take(values, index, axis=axis))

    half = stride // 2
    parts = [at(0)] + [at(k) for k in range(-half, half + 1) if k]
    if stride % 2:  # half a step beyond the last node
        parts += [_between(at(-half), at(-half - 1), period_m), _between(at(half), at(half + 1), period_m)]
    return _span(parts, period_m)


def _between(near: _Intervals, far: _Intervals, period_m: float) -> _Intervals:
    """Return what is seen half way between two nodes."""
    both = near.may_return & far.may_return
    off = np.where(both, (far.middle_m - near.middle_m + period_m / 2) % period_m - period_m / 2, 0.0)
    # where an edge of the landmark passes between the nodes, it mixes what either shows in any share
    width = (near.half_m + far.half_m + np.where(np.abs(off) > _JUMP_M, np.abs(off), 0.0)) / 2
    return _Intervals(
        np.where(near.may_return, near.middle_m + off / 2, far.middle_m),
        np.where(both, width, np.where(near.may_return, near.half_m, far.half_m)),
        near.may_return | far.may_return,
        near.must_return & far.must_return,
    )


def _span(parts: Sequence[_Intervals], period_m: float) -> _Intervals:
    """Return the intervals that span those of several images; they lie about the first that returns."""
    centre, known = parts[0].middle_m, parts[0].may_return
    for part in parts[1:]:
        centre, known = np.where(known | ~part.may_return, centre, part.middle_m), known | part.may_return
    low, high = np.full(centre.shape, np.inf), np.full(centre.shape, -np.inf)
    for part in parts:
        off = (part.middle_m - centre + period_m / 2) % period_m - period_m / 2
        low = np.where(part.may_return, np.minimum(low, off - part.half_m), low)
        high = np.where(part.may_return, np.maximum(high, off + part.half_m), high)
    low, high = np.where(known, low, 0.0), np.where(known, high, 0.0)
    must = np.logical_and.reduce([part.must_return for part in parts])
    return _Intervals(centre + (low + high) / 2, (high - low) / 2, known, must)


def _shifted(cells: _Intervals, cols: int, axis: int, period_m: float) -> _Intervals:
    """Return what cells show up to half a row (axis 0) or column (1) to either side."""
    n, pixels = cells.middle_m.shape
    images = cells.each(lambda values: values.reshape(n, -1, cols))
    wide = _hull(images, np.arange(images.middle_m.shape[axis + 1]), 1, axis + 1, period_m)
    np.moveaxis(wide.must_return, axis + 1, 0)[[0, -1]] = False  # what comes in from beyond the image is not known
    return wide.each(lambda values: values.reshape(n, pixels))


def _blocks_of(cells: Cells, shape: tuple[int, int, int], period_m: float) -> Cells:
    """Return what blocks of cells may show, (class, D, δ) of the blocks with all but the pixels flattened."""
    n_d, n_a = shape[1:]
    middle, half, must = (values.reshape(*shape, values.shape[-1]) for values in cells)
    found = []
    for own in range(len(middle)):
        for i in range(0, n_d, _ALONG):
            for j in range(0, n_a, _AROUND):
                part = (own, slice(i, i + _ALONG), slice(j, j + _AROUND))
                some = middle[part] < _FAR_M
                lit = some.any(axis=(0, 1))
                about = np.where(lit, np.where(some, middle[part], 0).max(axis=(0, 1)), _FAR_M)
                off = np.where(some, (middle[part] - about + period_m / 2) % period_m - period_m / 2, 0)
                low = np.where(some, off - half[part], np.inf).min(axis=(0, 1))
                high = np.where(some, off + half[part], -np.inf).max(axis=(0, 1))
                low, high = np.where(lit, low, 0), np.where(lit, high, 0)
                found.append((about + (low + high) / 2, (high - low) / 2, must[part].min(axis=(0, 1))))
    middles, halves, musts = zip(*found, strict=True)
    return Cells(np.array(middles, np.float32), np.array(halves, np.float32), np.array(musts, np.uint8))


def _packed(cells: _Intervals) -> Cells:
    """Return cells as the kernels take them."""
    return Cells(
        np.where(cells.may_return, cells.middle_m, _FAR_M).astype(np.float32),
        np.where(cells.may_return, _WIDER * cells.half_m, 0.0).astype(np.float32),
        cells.must_return.astype(np.uint8),
    )


_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})


@_compiled
def _bound(cells, k, y, weight, absent, period, start, limit):  # type: ignore[no-untyped-def]
    """Return the least cost of a frame in one cell, given up above a limit."""
    middle, half, must = cells
    total, n = start, len(y)
    for first in range(0, n - n % _BLOCK, _BLOCK):
        part = np.float32(0.0)
        for q in range(first, first + _BLOCK):
            off = abs(y[q] - middle[k, q])
            off = max(min(off, abs(period - off)) - half[k, q], np.float32(0.0))
            part += min(weight[q] * off * off, np.float32(DISAGREEMENT)) + absent[q] * must[k, q]
        total += part
        if total > limit:
            return total
    for q in range(n - n % _BLOCK, n):
        off = abs(y[q] - middle[k, q])
        off = max(min(off, abs(period - off)) - half[k, q], np.float32(0.0))
        total += min(weight[q] * off * off, np.float32(DISAGREEMENT)) + absent[q] * must[k, q]
    return total


@_compiled
def _soft(cells, k, y, weight, absent, period):  # type: ignore[no-untyped-def]
    """Return the cost of a frame about the middle of one cell, whose interval counts as a uniform error."""
    middle, half, must = cells
    total = np.float32(0.0)
    for q in range(len(y)):
        if weight[q] > 0:
            off = abs(y[q] - middle[k, q])
            off = min(off, abs(period - off))
            total += min(
                off * off / (np.float32(1.0) / weight[q] + half[k, q] * half[k, q] / np.float32(3.0)),
                np.float32(DISAGREEMENT),
            )
        else:
            total += absent[q] * must[k, q]
    return total


@_compiled
def _everywhere(cells, y, weight, absent, period, limit, out):  # type: ignore[no-untyped-def]
    """Fill the least cost of a frame, and that about the middle, in every cell; (cells, 2)."""
    for k in range(len(out)):
        out[k, 0] = _bound(cells, k, y, weight, absent, period, np.float32(0.0), limit)
        if out[k, 0] <= limit:
            out[k, 1] = _soft(cells, k, y, weight, absent, period)


@_compiled
def _scan(blocks, cells, y, weight, absent, period, rest, before, limit, out):  # type: ignore[no-untyped-def]
    """Fill the costs of a frame about the middle of those cells whose bounds are within the limit."""
    n_class, n_d, n_a = out.shape
    own, block = len(cells.middle_m) // (n_d * n_a), -1
    for c in range(own):
        for first in range(0, n_d, _ALONG):
            last = min(first + _ALONG, n_d)
            least = rest[0, :, first:last].min() if own < n_class else rest[0, c, first:last].min()
            for begin in range(0, n_a, _AROUND):
                block += 1
                if _bound(blocks, block, y, weight, absent, period, before + least, limit) > limit:
                    continue
                for i in range(first, last):
                    lowest = rest[0, :, i].min() if own < n_class else rest[0, c, i]
                    for j in range(begin, min(begin + _AROUND, n_a)):
                        k = (c * n_d + i) * n_a + j
                        bound = _bound(cells, k, y, weight, absent, period, before + lowest, limit)
                        if bound > limit:
                            continue
                        soft = before + _soft(cells, k, y, weight, absent, period)
                        if own == n_class:
                            out[c, i, j] = soft + rest[1, c, i]
                            continue
                        for d in range(n_class):
                            if bound - lowest + rest[0, d, i] <= limit:
                                out[d, i, j] = soft + rest[1, d, i]
