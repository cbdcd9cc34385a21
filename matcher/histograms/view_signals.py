"""Expected signal counts of a landmark at some views, and their slopes by differences of exact scenes."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark.render import Sensor, Views
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.sample_counts import signal_of_samples
from phasemark.render.direct.scene_samples import SceneMesh
from phasemark.render.view import VIEW_FIELDS

STEPS: dict[str, float] = {
    "distance_m": 2e-3,
    "delta_rad": math.radians(0.3),
    "bearing_rad": math.radians(0.1),
    "height_m": 2e-3,
    "pitch_rad": math.radians(0.1),
    "roll_rad": math.radians(0.1),
}
"""Half the distance of the two scenes whose difference is a slope: a few standard deviations of a good measurement."""
_VIEWS_AT_ONCE = 16


class ViewSignals:
    """Counts of a direct sensor from one landmark, without pile-up and ambient light.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Landmark frame, metres.
    sensor : Sensor
        With a [histogram] table.
    albedo : float
    """

    def __init__(self, mesh: trimesh.Trimesh, sensor: Sensor, albedo: float = 0.8) -> None:
        histogram_of(sensor)
        self.sensor, self.albedo = sensor, albedo
        self.vertices = np.asarray(mesh.vertices, dtype=np.float64)
        self._grid = footprint_grid(sensor)
        self._scene = SceneMesh(mesh)
        self._own = threading.local()  # a scene has scratch that two threads must not share

    def counts(self, views: Views, workers: int = 1) -> NDArray[np.float64]:
        """Return the expected signal counts of one frame, (n, zones, bins).

        Parameters
        ----------
        views : Views
        workers : int
            Threads; the result does not depend on their number.
        """
        parts = [views[k : k + _VIEWS_AT_ONCE] for k in range(0, len(views), _VIEWS_AT_ONCE)]
        if workers == 1 or len(parts) < 2:
            return np.concatenate([self._counts(part) for part in parts])
        with ThreadPoolExecutor(workers) as pool:
            return np.concatenate(list(pool.map(self._counts, parts)))

    def counts_and_slopes(self, views: Views, free: Sequence[str]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the expected signal counts, and their slopes by parameters of the view.

        Parameters
        ----------
        views : Views
        free : sequence of str

        Returns
        -------
        counts : (n, zones, bins) float64
        slopes : (n, p, zones, bins) float64
            Central differences.
        """
        n, p = len(views), len(free)
        rows = np.stack([getattr(views, name) for name in VIEW_FIELDS], axis=1)
        moved = np.repeat(rows[None], 2 * p + 1, axis=0)
        for k, name in enumerate(free):
            column = VIEW_FIELDS.index(name)
            moved[1 + 2 * k, :, column] += STEPS[name]
            moved[2 + 2 * k, :, column] -= STEPS[name]
        found = self.counts(Views(*moved.reshape(-1, len(VIEW_FIELDS)).T.copy())).reshape(2 * p + 1, n, *self._shape)
        slopes = np.empty((n, p, *self._shape))
        for k, name in enumerate(free):
            slopes[:, k] = (found[1 + 2 * k] - found[2 + 2 * k]) / (2 * STEPS[name])
        return found[0], slopes

    @property
    def _shape(self) -> tuple[int, int]:
        return self.sensor.rows * self.sensor.cols, histogram_of(self.sensor).bins

    def _counts(self, views: Views) -> NDArray[np.float64]:
        if not hasattr(self._own, "scene"):
            self._own.scene = self._scene.for_thread()
        samples = self._own.scene.samples_of_views(views.in_camera(self.sensor), self._grid)
        return signal_of_samples(samples, self.sensor, self.albedo)
