"""Expected signal counts of a landmark and the planes behind it at some views, by exact scenes."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark.render.background import Background
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.sample_counts import signal_of_samples, signal_of_surfaces
from phasemark.render.integral.scene_samples import SceneMesh
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.threads import mapped
from phasemark.render.view import VIEW_FIELDS, Views

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


def views_about(view: NDArray[np.float64], free: Sequence[str], wider: float = 1.0) -> Views:
    """Return a view, and those a step, or a multiple of it, above and below in each free parameter, (1 + 2 p)."""
    return Views(*moved_about(view, free, wider).T.copy())


def moved_about(view: NDArray[np.float64], free: Sequence[str], wider: float = 1.0) -> NDArray[np.float64]:
    """Return the same as an array, (1 + 2 p, 6)."""
    moved = np.repeat(view[None], 2 * len(free) + 1, axis=0)
    for k, name in enumerate(free):
        column = VIEW_FIELDS.index(name)
        moved[1 + 2 * k, column] += wider * STEPS[name]
        moved[2 + 2 * k, column] -= wider * STEPS[name]
    return moved


def slopes_about(found: NDArray[np.float64], free: Sequence[str]) -> NDArray[np.float64]:
    """Return the slopes of what was found at :func:`views_about` a view, (p, …): central differences."""
    slopes = np.empty((len(free), *found.shape[1:]))
    for k, name in enumerate(free):
        slopes[k] = (found[1 + 2 * k] - found[2 + 2 * k]) / (2 * STEPS[name])
    return slopes


class ViewSignals:
    """Counts of a direct sensor from one landmark, without pile-up and ambient light.

    Parameters
    ----------
    mesh : trimesh.Trimesh or None
        Landmark frame, metres. None: there is nothing but what stands behind.
    sensor : Sensor
        With a table ``[histogram]``.
    albedo : float
    """

    def __init__(self, mesh: SurfaceMesh | None, sensor: Sensor, albedo: float = 0.8) -> None:
        histogram_of(sensor)
        self.sensor, self.albedo = sensor, albedo
        self.vertices = np.empty((0, 3)) if mesh is None else np.asarray(mesh.vertices, dtype=np.float64)
        self._grid = footprint_grid(sensor)
        self._scene = SceneMesh(mesh)

    def seen_by(self, sensor: Sensor) -> ViewSignals:
        """Return the counts of another direct sensor from the same landmark."""
        other = copy.copy(self)
        other.sensor, other._grid = sensor, footprint_grid(sensor)
        return other

    def counts(self, views: Views, workers: int = 1) -> NDArray[np.float64]:
        """Return the expected signal counts of one frame, (n, zones, bins).

        Parameters
        ----------
        views : Views
        workers : int
            Threads; the result does not depend on their number.
        """

        def counts(part: Views) -> NDArray[np.float64]:
            samples = self._scene.samples_of_views(part.in_camera(self.sensor), self._grid)
            return signal_of_samples(samples, self.sensor, self.albedo)

        return _in_parts(counts, views, workers)

    def surfaces(
        self, views: Views, background: Background, workers: int = 1, finest_m: float | None = None
    ) -> NDArray[np.float64]:
        """Return the expected signal counts of landmark, wall and floor, (n, 3, zones, bins).

        A landmark that reaches through a wall or a floor hides it: a search may try views that cannot be.

        Parameters
        ----------
        views : Views
        background : Background
        workers : int
            Threads; the result does not depend on their number.
        finest_m : float, optional
            How finely ranges of the background are resolved; None: half a bin.
        """
        histogram = histogram_of(self.sensor)
        finest = 0.5 * histogram.bin_width_m if finest_m is None else finest_m
        farthest = histogram.start_m + histogram.bins * histogram.bin_width_m

        def counts(part: Views) -> NDArray[np.float64]:
            samples = self._scene.samples_of_views(
                part.in_camera(self.sensor), self._grid, background=background, finest_m=finest, farthest_m=farthest
            )
            return signal_of_surfaces(samples, self.sensor, self.albedo)

        return _in_parts(counts, views, workers)


def _in_parts(counts: Callable[[Views], NDArray[np.float64]], views: Views, workers: int) -> NDArray[np.float64]:
    parts = [views[k : k + _VIEWS_AT_ONCE] for k in range(0, len(views), _VIEWS_AT_ONCE)]
    return np.concatenate(mapped(counts, parts, workers))
