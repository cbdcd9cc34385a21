"""A table of a bank's histograms on a grid of distance and δ, and signals in between by cubic interpolation.

It serves the search and the slopes on the way; the answer itself is taken from scenes rendered where it lies. A zone's
light from a plane is taken as that of the plane with nothing before it, times the share that the landmark leaves
visible. That is exact where a zone sees the plane within a bin or two, and good enough for a search elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.histograms.scene_models import planes_of
from phasemark.matcher.nearest.grid import cubic_weights
from phasemark.render import Background, Sensor, Views
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.view_signals import ViewSignals
from phasemark.render.kernel import kernel
from phasemark.render.view import delta_period_rad

STATISTICS = 3
"""Numbers that the search keeps of a zone's histogram: its sum, first and second moment about the window's middle."""
_STEP_RAD = math.radians(4.0)
_DARK = 1e-5  # of the brightest zone's light: less does not light a zone
_SAME_RAD = 1e-6


class Table(NamedTuple):
    """Histograms of all classes, as kernels take them.

    Parameters
    ----------
    signal : (classes, distances, angles, zones, window) float32
        Expected signal counts of one frame in the bins of the window.
    moments : (classes, distances, angles, zones, STATISTICS) float32
    lit : (distances, zones) bool
        Which zones a landmark can light from a distance.
    first_bin : (distances,) int64
        Where the window of a distance begins.
    basis : (window, STATISTICS) float64
        What the moments weight the bins with.
    grid : (4,) float64
        First distance and its step, first δ and its step.
    cyclic : bool
        Whether the last δ is followed by the first one.
    visible : (classes, distances, angles, planes, zones) float32
        Share of each plane's light that the landmark leaves.
    """

    signal: NDArray[np.float32]
    moments: NDArray[np.float32]
    lit: NDArray[np.bool_]
    first_bin: NDArray[np.int64]
    basis: NDArray[np.float64]
    grid: NDArray[np.float64]
    cyclic: bool
    visible: NDArray[np.float32]

    @property
    def n_bytes(self) -> int:
        """Size in memory."""
        return self.signal.nbytes + self.moments.nbytes + self.visible.nbytes


class TableGrid(NamedTuple):
    """Nodes and bins of a table of histograms, known before anything is rendered.

    Parameters
    ----------
    distance_m, delta_rad : (n,) float64
    cyclic : bool
    first_bin : (n,) int64
    window : int
    """

    distance_m: NDArray[np.float64]
    delta_rad: NDArray[np.float64]
    cyclic: bool
    first_bin: NDArray[np.int64]
    window: int

    def n_bytes(self, sensor: Sensor, n_classes: int, n_planes: int) -> int:
        """Return how large the table gets in memory."""
        views = n_classes * len(self.distance_m) * len(self.delta_rad)
        return 4 * views * sensor.rows * sensor.cols * (self.window + STATISTICS + n_planes)


def response_width_m(sensor: Sensor) -> float:
    """Return the standard deviation of the instrument response with that of a bin, metres."""
    histogram = histogram_of(sensor)
    bin_variance = histogram.bin_width_m**2 / 12
    if histogram.irf_std_m is not None:
        return math.sqrt(histogram.irf_std_m**2 + bin_variance)
    x = (histogram.irf_step_m or 0.0) * np.arange(len(histogram.irf[0]))
    spread = [np.average((x - np.average(x, weights=row)) ** 2, weights=row) for row in map(np.array, histogram.irf)]
    return math.sqrt(min(spread) + bin_variance)


def plan_table(
    signals: Sequence[ViewSignals], distance_m: NDArray[np.float64], delta_rad: NDArray[np.float64], symmetry: int
) -> TableGrid:
    """Return the grid of a table.

    Parameters
    ----------
    signals : sequence of ViewSignals
        Of each class, by one sensor.
    distance_m, delta_rad : (n,) float64
        Grid of the bank: it says between what landmarks are looked for.
    symmetry : int
        How many turns about its axis leave every class as it is.
    """
    sensor = signals[0].sensor
    corners = np.concatenate([one.vertices for one in signals])
    radius = float(np.hypot(corners[:, 0], corners[:, 1]).max())
    step_of_response = 0.75
    step = step_of_response * response_width_m(sensor)
    nearest_to_surface_m = 0.02
    low = max(float(distance_m[0]) - step, radius + nearest_to_surface_m)
    fewest_nodes = 4  # of a cubic
    n = max(math.ceil((float(distance_m[-1]) + step - low) / step) + 1, fewest_nodes)
    distances = np.asarray(low + step * np.arange(n), dtype=np.float64)
    first, window = _window(sensor, distances, radius, float(np.abs(corners[:, 2]).max()))
    period = delta_period_rad(symmetry)
    span = float(np.ptp(delta_rad))
    if span + (float(np.diff(delta_rad).max()) if len(delta_rad) > 1 else 0.0) > period - _SAME_RAD:
        n = max(math.ceil(period / _STEP_RAD), 2 * fewest_nodes)
        angles = np.asarray(period / n * np.arange(n), dtype=np.float64)
        return TableGrid(distances, angles, True, first, window)
    n = max(math.ceil(span / _STEP_RAD) + 3, fewest_nodes)
    angles = np.asarray(float(delta_rad[0]) + _STEP_RAD * (np.arange(n) - 1), dtype=np.float64)
    return TableGrid(distances, angles, False, first, window)


def build_table(
    signals: Sequence[ViewSignals], grid: TableGrid, background: Background | None, bearing_rad: float, workers: int
) -> Table:
    """Render a table.

    Parameters
    ----------
    signals : sequence of ViewSignals
        Of each class, by one sensor.
    grid : TableGrid
    background : Background, optional
        What stands behind the landmark.
    bearing_rad : float
        Of all views.
    workers : int
        Threads; the result does not depend on their number.
    """
    sensor, window, planes = signals[0].sensor, grid.window, list(planes_of(background))
    n_zones, bins = sensor.rows * sensor.cols, histogram_of(sensor).bins
    shape = (len(signals), len(grid.distance_m), len(grid.delta_rad))
    signal = np.zeros((*shape, n_zones, window), np.float32)
    visible = np.zeros((*shape, len(planes), n_zones), np.float32)
    coarse_m = 1.0  # shares of planes need no ranges: cells of a floor are not cut
    if background is not None:
        whole = plane_light(ViewSignals(None, sensor), background, bearing_rad, coarse_m).sum(axis=-1)
        lit = whole > _DARK * whole.max()  # elsewhere a share is of the edge of a response, and matters to nothing
    for c, one in enumerate(signals):
        for i, (distance_m, first) in enumerate(zip(grid.distance_m, grid.first_bin.tolist(), strict=True)):
            views = Views.broadcast(distance_m, grid.delta_rad, bearing_rad)
            if background is None:
                counts = one.counts(views, workers)
            else:
                found = one.surfaces(views, background, workers, finest_m=coarse_m)
                counts, light = found[:, 0], found[:, planes].sum(axis=-1)
                visible[c, i] = np.divide(light, whole, out=np.ones_like(light), where=lit)
            low, high = max(first, 0), min(first + window, bins)
            signal[c, i, :, :, low - first : high - first] = counts[:, :, low:high]
    u = (np.arange(window) + 0.5 - window / 2) / (window / 2)
    basis = np.stack([np.ones(window), u, u**2], axis=1)
    moments = np.ascontiguousarray(signal @ basis.astype(np.float32))
    light = moments[..., 0].max(axis=(0, 2))
    steps = (float(grid.distance_m[1] - grid.distance_m[0]), float(grid.delta_rad[1] - grid.delta_rad[0]))
    origin = np.array([grid.distance_m[0], steps[0], grid.delta_rad[0], steps[1]])
    return Table(signal, moments, light > _DARK * light.max(), grid.first_bin, basis, origin, grid.cyclic, visible)


def plane_light(
    nothing: ViewSignals, background: Background, bearing_rad: float, finest_m: float | None = None
) -> NDArray[np.float64]:
    """Return the counts of each plane with nothing before it, (planes, zones, bins)."""
    found = nothing.surfaces(Views.broadcast(1.0, 0.0, bearing_rad), background, finest_m=finest_m)
    return np.ascontiguousarray(found[0, list(planes_of(background))])


def _window(
    sensor: Sensor, distances: NDArray[np.float64], radius_m: float, height_m: float
) -> tuple[NDArray[np.int64], int]:
    """Return the first bin that a landmark can light from each distance, and in how many bins its light lies."""
    histogram = histogram_of(sensor)
    low, high = histogram.irf_reach_m
    offset = np.asarray(sensor.zone_offsets + sensor.range_offset_m)
    scale = np.array(histogram.zone_bin_scale or ((1.0,),))
    aside = math.hypot(radius_m, height_m)
    near = distances - radius_m + low + float(offset.min()) - histogram.start_m
    # light of the far side comes at most from here: beyond the axis, and as far aside as the landmark reaches
    far = np.hypot(distances + radius_m, aside) + high + float(offset.max()) - histogram.start_m
    least, most = histogram.bin_width_m * float(scale.min()), histogram.bin_width_m * float(scale.max())
    first = np.floor(np.where(near > 0, near / most, near / least)).astype(np.int64)
    last = np.ceil(far / least).astype(np.int64)
    return first, int((last - first).max())


@kernel
def signal_between(table, c, distance, delta, nodes, out):  # type: ignore[no-untyped-def]
    """Fill signal and slopes by distance and δ at a view, (3, zones, bins); returns first and last bin that is lit.

    Parameters
    ----------
    table : Table
    c : int
        Class.
    distance, delta : float
    nodes : (4, 4) float64
        Scratch.
    out : (3, zones, bins) float64
        Filled between the bins returned, in zones that are lit; 0 elsewhere between them.
    """
    _, n_distance, n_delta, n_zones, width = table.signal.shape
    n_bins = out.shape[2]
    x = (distance - table.grid[0]) / table.grid[1]
    i = min(max(math.floor(x), 1), n_distance - 3)
    cubic_weights(x - i, nodes[0], nodes[1])
    y = (delta - table.grid[2]) / table.grid[3]
    j = math.floor(y)
    if not table.cyclic:
        j = min(max(j, 1), n_delta - 3)
    cubic_weights(y - j, nodes[2], nodes[3])
    start = max(table.first_bin[i - 1], 0)
    stop = min(table.first_bin[i + 2] + width, n_bins)
    for z in range(n_zones):
        out[:, z, start:stop] = 0.0
        lit = False
        for a in range(4):
            lit = lit or table.lit[i - 1 + a, z]
        if not lit:
            continue
        for a in range(4):
            first = table.first_bin[i - 1 + a]
            low, high = max(first, 0), min(first + width, n_bins)
            for b in range(4):
                k = j - 1 + b
                row = table.signal[c, i - 1 + a, k % n_delta if table.cyclic else k, z]
                w = nodes[0, a] * nodes[2, b]
                by_distance = nodes[1, a] * nodes[2, b] / table.grid[1]
                by_delta = nodes[0, a] * nodes[3, b] / table.grid[3]
                for m in range(low, high):
                    s = row[m - first]
                    out[0, z, m] += w * s
                    out[1, z, m] += by_distance * s
                    out[2, z, m] += by_delta * s
        for m in range(start, stop):
            out[0, z, m] = max(out[0, z, m], 0.0)
    return start, stop
