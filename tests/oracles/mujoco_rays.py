"""Images of a MuJoCo model by dense rays of ``mj_multiRay``: other geometry, and sums in place of integrals."""

from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from phasemark.render.direct import HistogramFrames
from phasemark.render.sensor.sensor import Sensor

LIGHT_M_PER_S = 299_792_458.0
GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def ray_images(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera2world: NDArray[np.float64],
    sensor: Sensor,
    albedo: NDArray[np.float64],
    rays: int,
) -> tuple[NDArray[np.complex128], NDArray[np.float64]]:
    """Return phasors (rows, cols), and the share of each pixel that each of the model's bodies fills (rows, cols, b).

    Parameters
    ----------
    model, data
        Of MuJoCo.
    camera2world : (4, 4) float64
        x forward, y left, z up.
    sensor : Sensor
        Pixels without gaps.
    albedo : (geoms,) float64
    rays : int
        Of each pixel.
    """
    phasor = np.zeros((sensor.rows, sensor.cols), np.complex128)
    shares = np.zeros((sensor.rows, sensor.cols, model.nbody))
    per_metre = 4 * np.pi * sensor.frequencies_hz[0] / LIGHT_M_PER_S
    for at, geom, distance_m, light in _hits(model, data, camera2world, sensor, albedo, rays):
        phasor[at] = (light * np.exp(1j * per_metre * distance_m)).sum() / rays
        shares[at] = np.bincount(model.geom_bodyid[geom], minlength=model.nbody) / rays
    return phasor, shares


def ray_targets_m(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera2world: NDArray[np.float64],
    sensor: Sensor,
    albedo: NDArray[np.float64],
    rays: int,
) -> NDArray[np.float64]:
    """Return the targets that a chip with a Gaussian response reports of expected counts, (rows, cols, targets)."""
    table = sensor.histogram
    assert table is not None
    assert table.irf_std_m is not None
    edges = table.start_m + table.bin_width_m * np.arange(table.bins + 1)
    counts = np.zeros((sensor.rows, sensor.cols, table.bins))
    for at, _, distance_m, light in _hits(model, data, camera2world, sensor, albedo, rays):
        fine, at_m = np.histogram(distance_m, 2500, (0.0, 5.0), weights=light / rays)
        middle = 0.5 * (at_m[1:] + at_m[:-1])
        below = 0.5 * (1 + erf((edges[:, None] - middle) / (np.sqrt(2) * table.irf_std_m)))
        counts[at] = table.cycles * (table.photons * np.diff(below @ fine) + table.ambient + table.dark)
    found: NDArray[np.float64] = HistogramFrames(counts, sensor=sensor).targets.distance_m[0, 0]
    return found


def _hits(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera2world: NDArray[np.float64],
    sensor: Sensor,
    albedo: NDArray[np.float64],
    rays: int,
) -> Iterator[tuple[tuple[int, int], NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]]]:
    """Yield each pixel with the geoms that its rays hit, their distances and the light that returns, ρ cos θ / r²."""
    place = (np.arange(rays) + 0.5) / rays
    golden = np.arange(rays) * (np.sqrt(5) - 1) / 2 % 1.0  # a lattice: no edge runs along a line of it
    geom, distance, normal = np.empty(rays, np.int32), np.empty(rays), np.empty((rays, 3))
    for row, col in np.ndindex(sensor.rows, sensor.cols):
        directions = sensor.ray_directions(col + place, row + golden).reshape(-1, 3) @ camera2world[:3, :3].T
        mujoco.mj_multiRay(
            model, data, camera2world[:3, 3], directions.ravel(), GROUPS, True, -1, geom, distance,
            normal.reshape(-1), rays, mujoco.mjMAXVAL,
        )  # fmt: skip
        hit = geom >= 0
        cosine = np.abs((directions[hit] * normal[hit]).sum(axis=1))
        yield (row, col), geom[hit], distance[hit], albedo[geom[hit]] * cosine / distance[hit] ** 2
