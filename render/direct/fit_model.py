"""The model that is fitted to a direct sensor's histograms of known scenes, and its parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.direct.bin_counts import piled_up
from phasemark.render.direct.footprints import Footprints, footprint_grid, histogram_of
from phasemark.render.direct.recordings import ObjectRecording, PlaneRecording, turn_about, world2cam
from phasemark.render.direct.transients import RangeAxis, zone_transients
from phasemark.render.integral.scene_samples import SceneSamples, plane_samples
from phasemark.render.kernel import kernel
from phasemark.render.sensor.sensor import Sensor

FLOOR = 0.05
"""Share of a count by which the model may be off: what keeps bright bins from deciding alone."""
PEAK_FLOOR = 0.01
"""Share of a histogram's highest count that the model may be off anywhere."""

_CELLS, _MARGIN_CELLS = 5, 4  # of the grid: per zone, and beyond the field of view that the fit starts with
AMBIENT_BINS = slice(2, 9)
_GEOMETRY = (
    "pitch_h", "pitch_v", "centre_left", "centre_up", "roll", "width", "height", "blur", "light", "light_left",
    "light_up",
)  # fmt: skip
_LEAST_LEFT = 0.05  # of the first photons, when pile-up is undone


Parameters = dict[str, float]
"""Values of what is fitted, by name."""


def start_parameters(
    sensor: Sensor, objects: Sequence[ObjectRecording], converters: Sequence[int]
) -> tuple[Parameters, dict[str, float]]:
    """Return where a fit starts, the sensor as it is described, and the scale of each parameter.

    Parameters
    ----------
    sensor : Sensor
    objects : sequence of ObjectRecording
    converters : sequence of int
        Time converter of each zone, image order.
    """
    h = histogram_of(sensor)
    tan_h, tan_v = sensor.tan_half_angles
    width = 0.4 if h.light_width is None else h.light_width
    u0, v0 = sensor.centre_px
    pitch_h, pitch_v = 2 * tan_h / sensor.cols, 2 * tan_v / sensor.rows
    table: list[tuple[str, float, float]] = [
        ("pitch_h", pitch_h, 0.02),
        ("pitch_v", pitch_v, 0.02),
        ("centre_left", pitch_h * (u0 - sensor.cols / 2), 0.02),
        ("centre_up", pitch_v * (v0 - sensor.rows / 2), 0.02),
        ("roll", math.radians(sensor.roll_deg), 0.02),
        ("width", pitch_h * h.zone_scale[0], 0.03),
        ("height", pitch_v * h.zone_scale[1], 0.03),
        ("blur", max(h.zone_blur, 0.02), 0.02),
        ("stray", h.stray, 0.05),
        ("light", 1 / width**2, 4.0),
        ("light_left", h.light_centre[0], 0.1),
        ("light_up", h.light_centre[1], 0.1),
        ("inverse_cycles", 1e6 / h.cycles, 0.1),
        ("tilt_left", 0.0, 0.03),
        ("tilt_up", 0.0, 0.03),
        ("forward", 0.0, 0.003),
        ("reference_gain", h.reference_gain, 1.0),
    ]
    table += [(f"converter_{k}", 1.0, 0.01) for k in sorted(set(converters))]
    table += [(f"delay_{k}", 0.0, 0.1) for k in range(sensor.rows * sensor.cols)]
    for one in objects:
        table += [(f"{one.name}_{axis}", 0.0, 0.003) for axis in "xyz"]
        table += [(f"{one.name}_yaw", 0.0, 0.03), (f"{one.name}_support", 1.0, 0.3)]
    return {name: value for name, value, _ in table}, {name: scale for name, _, scale in table}


def cycles_of(p: Parameters) -> float:
    """Return the cycles of a frame, whose reciprocal is fitted."""
    return 1e6 / max(p["inverse_cycles"], 1e-9)


class Responses(NamedTuple):
    """Cumulative instrument response of each zone over the delay in bins, how nodes lie, and what the window adds.

    Parameters
    ----------
    cumulative : (zones, nodes) float64
    first, step : float
        Delay of node 0 and distance of nodes, bins; delays count from the lower edge of bin 0.
    crosstalk : (zones, bins) float64
        Expected counts of light from the sensor's own window, the same in every histogram of a zone.
    """

    cumulative: NDArray[np.float64]
    first: float
    step: float
    crosstalk: NDArray[np.float64]

    @property
    def delays(self) -> NDArray[np.float64]:
        """Delays of the nodes, bins."""
        return np.asarray(self.first + self.step * np.arange(self.cumulative.shape[1]), dtype=np.float64)

    def counts_beside_crosstalk(self, measured: NDArray[np.float64], cycles: float) -> NDArray[np.float64]:
        """Return counts (n, zones, bins) without pile-up and crosstalk."""
        return np.asarray(undo_pile_up(measured, cycles) - self.crosstalk)


class Prediction(NamedTuple):
    """Expected and measured counts of a recording, (n, zones, bins), and how much of a zone's light is the object's."""

    expected: NDArray[np.float64]
    measured: NDArray[np.float64]
    object_share: NDArray[np.float64]


class FitModel:
    """Predicts histograms of recordings from parameters and responses.

    The brightness of every histogram and its ambient level are taken from the histogram itself: reflectance is not
    known, and only the shape tells the geometry.

    Parameters
    ----------
    sensor : Sensor
        Where the fit starts; it fixes the number of zones and bins, and the grid of directions.
    converters : sequence of int
        Time converter of each zone, image order.
    gain : (zones,) float64, optional
        Relative brightness of the zones before an even plane; stray light is shared out by it.
    """

    def __init__(self, sensor: Sensor, converters: Sequence[int], gain: NDArray[np.float64] | None = None) -> None:
        self.sensor, self.converters = sensor, tuple(converters)
        self.histogram = histogram_of(sensor)
        self.grid = footprint_grid(sensor.with_(roll_deg=0.0), _MARGIN_CELLS, _CELLS)
        self.gain = np.ones(sensor.rows * sensor.cols) if gain is None else gain / gain.mean()
        axis_m = 0.9
        self.axis = RangeAxis(-0.002, 0.001, int(min(axis_m, self.histogram.length_m) * 1000))
        self._kept_light, self._kept_samples = lru_cache(4)(self._light), lru_cache(12)(self._samples)

    def bin_scales(self, p: Parameters) -> NDArray[np.float64]:
        """Return the bin width of each zone over that of the sensor, (zones,)."""
        return np.array([p[f"converter_{k}"] for k in self.converters])

    def bin_widths_m(self, p: Parameters) -> NDArray[np.float64]:
        """Return the bin width of each zone, (zones,)."""
        return self.histogram.bin_width_m * self.bin_scales(p)

    def footprints(self, p: Parameters) -> Footprints:
        """Return the footprints that parameters describe, in the sensor's own axes."""
        rows, cols = self.sensor.rows, self.sensor.cols
        row, col = np.mgrid[:rows, :cols] + 0.5
        centre = np.stack(
            [p["pitch_h"] * (cols / 2 - col) + p["centre_left"], p["pitch_v"] * (rows / 2 - row) + p["centre_up"]], -1
        ).reshape(-1, 2)
        half = np.broadcast_to([abs(p["width"]) / 2, abs(p["height"]) / 2], centre.shape).copy()
        blur = max(abs(p["blur"]), 1e-3)
        light = np.array([p["light_left"], p["light_up"], max(p["light"], 0.0)])
        return Footprints(centre, half, np.array([blur, blur]), light)

    def transients(self, p: Parameters, recording: PlaneRecording | ObjectRecording) -> NDArray[np.float64]:
        """Return the transients of a recording's scene in each zone, support and object separate, with stray light."""
        scene = ["tilt_left", "tilt_up"]
        if isinstance(recording, ObjectRecording):
            scene = ["forward", *(f"{recording.name}_{axis}" for axis in ("x", "y", "z", "yaw"))]
        seen = self._kept_light(recording, tuple(p[n] for n in _GEOMETRY), tuple(p[n] for n in scene)).copy()
        if isinstance(recording, ObjectRecording):
            seen[:, 0] *= p[f"{recording.name}_support"]
        own = seen * self.gain[:, None]
        return np.asarray(own + p["stray"] * own.mean(axis=2, keepdims=True))

    def predict(self, p: Parameters, responses: Responses, recording: PlaneRecording | ObjectRecording) -> Prediction:
        """Return expected and measured counts of a recording."""
        seen = self.transients(p, recording)
        light = seen.sum(axis=1)
        measured = recording.frames.zone_counts
        drift = p["reference_gain"] * recording.frames.reference_shift_bins
        delays = np.array([p[f"delay_{zone}"] for zone in range(light.shape[1])]) + drift[:, None]
        shape = np.zeros_like(measured)
        _spread(
            light, self.axis.first_m, self.axis.step_m, self.bin_widths_m(p), delays, responses.cumulative,
            responses.first, responses.step, shape,
        )  # fmt: skip
        cycles = cycles_of(p)
        counts = responses.counts_beside_crosstalk(measured, cycles)
        ambient = counts[..., AMBIENT_BINS].mean(axis=-1, keepdims=True)
        window = about_peak(measured, 8, 25)
        bright = np.where(window, counts - ambient, 0).sum(axis=-1) / np.maximum(
            np.where(window, shape, 0).sum(axis=-1), 1e-300
        )
        level = np.maximum(bright, 0)[..., None] * shape + ambient + responses.crosstalk
        expected = piled_up(np.maximum(level, 1e-3), cycles)
        total = light.sum(axis=2)
        share_of_object = seen[:, 1].sum(axis=2) / np.where(total > 0, total, 1)
        return Prediction(expected, measured, share_of_object)

    def residuals(
        self, p: Parameters, responses: Responses, recordings: Sequence[PlaneRecording | ObjectRecording]
    ) -> NDArray[np.float64]:
        """Return the whitened residuals of all histograms, flat."""
        parts = []
        for one in recordings:
            got = self.predict(p, responses, one)
            parts.append(((got.expected - got.measured) / tolerance(got.measured)).ravel())
        return np.concatenate(parts)

    def _light(
        self, recording: PlaneRecording | ObjectRecording, geometry: tuple[float, ...], scene: tuple[float, ...]
    ) -> NDArray[np.float64]:
        """Return the transients of a recording's scene for values of `_GEOMETRY` and of the scene's parameters."""
        p = dict(zip(_GEOMETRY, geometry, strict=True))
        samples = self._kept_samples(recording, scene)
        c, s = math.cos(p["roll"]), math.sin(p["roll"])
        turned = samples._replace(tangents=np.ascontiguousarray(samples.tangents @ np.array([[c, -s], [s, c]])))
        return zone_transients(turned, self.sensor, self.axis, footprints=self.footprints(p))

    def _samples(self, recording: PlaneRecording | ObjectRecording, scene: tuple[float, ...]) -> SceneSamples:
        if isinstance(recording, PlaneRecording):
            return plane_samples(recording.distance_m, self.grid, (scene[0], scene[1]))
        forward, *placement, yaw = scene
        transforms = world2cam(recording.sensor2world, (0.0, 0.0, forward), placement)
        return recording.scene.samples(transforms @ turn_about(recording.centre_m, yaw), self.grid)


def undo_pile_up(counts: NDArray[np.float64], cycles: float) -> NDArray[np.float64]:
    """Return counts without pile-up; where hardly a first photon is left, the correction ends."""
    before = np.cumsum(counts, axis=-1) - counts
    left = np.maximum(cycles - before, _LEAST_LEFT * cycles)
    return np.asarray(-cycles * np.log1p(-np.minimum(counts / left, 1 - _LEAST_LEFT)))


def tolerance(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation with which counts are fitted: Poisson, and what the model may be off."""
    peak = counts.max(axis=-1, keepdims=True)
    return np.asarray(np.sqrt(np.maximum(counts, 1.0) + (FLOOR * counts) ** 2 + (PEAK_FLOOR * peak) ** 2))


def about_peak(counts: NDArray[np.float64], before: int, stop: int) -> NDArray[np.bool_]:
    """Return which bins lie about the highest one of each histogram: from some before it, to a stop behind it."""
    top, j = counts.argmax(axis=-1)[..., None], np.arange(counts.shape[-1])
    return np.asarray((j >= top - before) & (j < top + stop))


def peak_centroids(counts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centroid of each histogram about its highest bin, bins; (..., bins) to (...)."""
    level = counts[..., AMBIENT_BINS].mean(axis=-1, keepdims=True)
    signal = np.where(about_peak(counts, 3, 8), np.maximum(counts - level, 0), 0)
    total = signal.sum(axis=-1)
    return np.asarray((signal @ np.arange(counts.shape[-1])) / np.where(total > 0, total, 1))


@kernel
def _spread(light, first_m, step_m, widths, delays, cumulative, first, step, out):  # type: ignore[no-untyped-def]
    """Add the light of every range to the bins that the zone's response spreads it over."""
    n, zones, nodes = light.shape
    bins, last = out.shape[2], cumulative.shape[1] - 1
    reach = last * step
    for i in range(n):
        for zone in range(zones):
            row = cumulative[zone]
            for k in range(nodes):
                amount = light[i, zone, k]
                if amount == 0.0:
                    continue
                start = (first_m + k * step_m) / widths[zone] + delays[i, zone] + first
                low = max(math.floor(start), 0)
                high = min(math.ceil(start + reach), bins)
                before = 0.0
                x = (low - start) / step
                if x > 0.0:
                    j = min(int(x), last - 1)
                    before = row[j] + min(x - j, 1.0) * (row[j + 1] - row[j])
                for b in range(low, high):
                    x = (b + 1 - start) / step
                    after = 0.0
                    if x > 0.0:
                        j = min(int(x), last - 1)
                        after = row[j] + min(x - j, 1.0) * (row[j + 1] - row[j])
                    out[i, zone, b] += amount * (after - before)
                    before = after
