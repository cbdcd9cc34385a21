"""The transient of each zone: how its light is spread over path length (PHYSICS section 11).

Samples are added to a fine axis of ranges, each to its four nearest nodes with Lagrange weights, which keeps the first
four moments. What convolves it with an instrument response as wide as a bin is then good to 1e-5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.render.direct.footprints import (
    Footprints,
    footprint_areas,
    footprint_weight,
    footprints_of,
    histogram_of,
)
from phasemark.render.integral.scene_samples import SceneSamples
from phasemark.render.kernel import kernel
from phasemark.render.sensor.sensor import Sensor

PARTS = 2
"""Parts of a scene that may differ in albedo."""


class RangeAxis(NamedTuple):
    """Evenly spaced ranges: n nodes from `first_m`, `step_m` apart."""

    first_m: float
    step_m: float
    n: int

    @property
    def nodes_m(self) -> NDArray[np.float64]:
        """Return the ranges, (n,)."""
        return np.asarray(self.first_m + self.step_m * np.arange(self.n), dtype=np.float64)


def range_axis(sensor: Sensor, *, longest_m: float | None = None) -> RangeAxis:
    """Return the ranges from which light can reach the histogram.

    Parameters
    ----------
    sensor : Sensor
        The camera.
    longest_m : float, optional
        Where the axis may end before the histogram does, for scenes that do.
    """
    histogram = histogram_of(sensor)
    nodes_per_bin = 16
    step = histogram.bin_width_m / nodes_per_bin
    last = histogram.start_m + 1.1 * histogram.length_m - min(histogram.irf_reach_m[0], 0.0)
    if longest_m is not None:
        last = min(last, longest_m)
    border = 2  # nodes beyond either end, for the outermost Lagrange weights
    return RangeAxis(-border * step, step, int(np.ceil(max(last, step) / step)) + 2 * border)


def zone_transients(
    samples: SceneSamples, sensor: Sensor, axis: RangeAxis, *, footprints: Footprints | None = None
) -> NDArray[np.float64]:
    """Return the transients of all zones.

    Parameters
    ----------
    samples : SceneSamples
        n poses.
    sensor : Sensor
        The camera.
    axis : RangeAxis
        Range axis of the transients.
    footprints : Footprints, optional
        Without it those of the sensor.

    Returns
    -------
    (n, parts, zones, nodes) float64
        Amplitude for albedo 1 per node; the sum over nodes is the zone's intensity. Light from beyond the axis is
        left out.
    """
    zones = footprints_of(sensor) if footprints is None else footprints
    out = np.zeros((samples.n_views, PARTS, len(zones.centre), axis.n))
    samples = through_lens(samples, sensor)
    _add_samples(samples, zones, 1 / footprint_areas(zones), axis, out)
    return out


def through_lens(samples: SceneSamples, sensor: Sensor) -> SceneSamples:
    """Return samples with the amplitude that passes the lens: less by cos⁴ off the axis where it vignettes."""
    if not sensor.vignetting:
        return samples
    return samples._replace(amplitude=samples.amplitude / (1 + (samples.tangents**2).sum(axis=1)) ** 2)


@kernel
def _add_samples(samples, zones, scale, axis, out):  # type: ignore[no-untyped-def]
    """Add every sample to the zones that see it."""
    n_zones, n = out.shape[2], out.shape[3]
    for view in range(len(samples.start) - 1):
        for k in range(samples.start[view], samples.start[view + 1]):
            x = (samples.range_m[k] - axis.first_m) / axis.step_m
            i = int(x)
            if i < 1 or i + 2 >= n:
                continue
            f = x - i
            a = -f * (f - 1) * (f - 2) / 6
            b = (f + 1) * (f - 1) * (f - 2) / 2
            c = -(f + 1) * f * (f - 2) / 2
            d = (f + 1) * f * (f - 1) / 6
            for q in range(n_zones):
                w = footprint_weight(zones, q, samples.tangents[k, 0], samples.tangents[k, 1])
                if w == 0.0:
                    continue
                w *= samples.amplitude[k] * scale[q]
                row = out[view, samples.part[k], q]
                row[i - 1] += w * a
                row[i] += w * b
                row[i + 1] += w * c
                row[i + 2] += w * d
