"""Noise-free histograms of a landmark at views, with what stands behind it: the direct sensor's counterpart of phasors.

:class:`HistogramRenderer` is to a direct sensor what :class:`~phasemark.render.Renderer` is to any camera, with calls
of the same shape. What it makes of views is the expected count of every bin (PHYSICS section 11).
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark.render.background import Background
from phasemark.render.direct.bin_counts import bin_response, counts_of_light, detected_counts
from phasemark.render.direct.footprints import footprint_grid, histogram_of
from phasemark.render.direct.transients import range_axis, zone_transients
from phasemark.render.integral.scene_samples import WALL, SceneMesh
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.threads import check_workers, mapped
from phasemark.render.view import Views

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_VIEWS_AT_ONCE = 4


@dataclass(frozen=True, eq=False)
class HistogramImages:
    """Noise-free histograms of a batch of views.

    Parameters
    ----------
    expected : (n, rows, cols, bins) float64
        Expected counts of one frame: signal, stray light, ambient light, dark counts, crosstalk, after pile-up.
    signal : (n, rows, cols) float64
        Counts of the landmark and what stands behind it, all bins together, without pile-up.
    sensor : Sensor
        The camera.
    views : Views, or None
        Views of the landmark; None for histograms of anything else.
    shares : (n, rows, cols, b) float64, or None
        Share of each zone that each of b bodies of a scene fills.
    bodies : tuple of str
        Their names.
    """

    figure: ClassVar[Callable[..., Figure]]
    """Function that draws it; the package sets it, because drawing imports matplotlib, which takes half a second."""

    expected: NDArray[np.float64]
    signal: NDArray[np.float64]
    sensor: Sensor
    views: Views | None = None
    shares: NDArray[np.float64] | None = None
    bodies: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.expected)

    def plot(self, index: int = 0) -> Figure:
        """Draw the histograms of all zones of one view."""
        return type(self).figure(self, index)


class HistogramRenderer:
    """Renders histograms of one landmark for one direct sensor, from any view.

    Parameters
    ----------
    mesh : trimesh.Trimesh or None
        The landmark, as for :class:`~phasemark.render.Renderer`. None: only what stands behind it.
    sensor : Sensor
        With a [histogram] table.
    albedo : float
        Of the Lambertian landmark, in (0, 1].
    intersector : {"auto", "embree", "float64"}
        Library that traces rays, as for :class:`~phasemark.render.Renderer`.

    Raises
    ------
    UsageError
        The sensor has no [histogram] table, or whatever :class:`~phasemark.render.Renderer` refuses.

    Examples
    --------
    >>> import trimesh
    >>> from phasemark.render import Background, preset
    >>> from phasemark.render.direct import HistogramRenderer
    >>> plate = trimesh.creation.box((0.002, 2.0, 2.0))  # its front is 1 m from the lens at D = 1.001
    >>> images = HistogramRenderer(plate, preset("vl53l5cx-8x8")).render(distance_m=1.001)
    >>> images.expected.shape, int(images.expected[0, 4, 4].argmax())  # bin 26 begins at 0.975 m
    ((1, 8, 8, 128), 26)
    """

    def __init__(
        self,
        mesh: SurfaceMesh | None,
        sensor: Sensor,
        *,
        albedo: float = 0.8,
        intersector: str = "auto",
    ) -> None:
        histogram_of(sensor)
        self.sensor = sensor
        self.albedo = float(albedo)
        self._exact = Renderer(mesh, sensor, albedo=albedo, intersector=intersector)
        self._scene = SceneMesh(mesh, intersector=intersector)
        self.grid = footprint_grid(sensor)
        self.axis = range_axis(sensor)

    def with_albedo(self, albedo: float) -> HistogramRenderer:
        """Return a renderer of the same landmark with another albedo, which shares all that belongs to the mesh.

        Parameters
        ----------
        albedo : float
            In (0, 1].

        Raises
        ------
        UsageError
            It is not.
        """
        other = copy.copy(self)
        other._exact = self._exact.with_albedo(albedo)
        other.albedo = float(albedo)
        return other

    def render(
        self,
        distance_m: ArrayLike,
        delta_rad: ArrayLike = 0.0,
        bearing_rad: ArrayLike = 0.0,
        height_m: ArrayLike = 0.0,
        pitch_rad: ArrayLike = 0.0,
        roll_rad: ArrayLike = 0.0,
        *,
        background: Background | None = None,
        workers: int = 1,
    ) -> HistogramImages:
        """Render views; the arguments broadcast against each other and are flattened in C order.

        Parameters
        ----------
        distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad : array_like
            The views, PHYSICS sections 1 and 9.
        background : Background, optional
            What stands behind the landmark; None: nothing.
        workers : int
            Threads; the result does not depend on their number.

        Returns
        -------
        HistogramImages

        Raises
        ------
        UsageError
            As :meth:`phasemark.render.Renderer.render`.
        """
        views = Views.broadcast(distance_m, delta_rad, bearing_rad, height_m, pitch_rad, roll_rad)
        return self.render_views(views, background=background, workers=workers)

    def render_views(self, views: Views, *, background: Background | None = None, workers: int = 1) -> HistogramImages:
        """Render a batch of views; see :meth:`render`."""
        signal = self.signal(views, background=background, workers=workers)
        rows, cols = self.sensor.rows, self.sensor.cols
        total = self.albedo * signal[:, 0] + signal[:, 1]
        return HistogramImages(
            detected_counts(total, self.sensor).reshape(len(views), rows, cols, -1),
            total.sum(axis=-1).reshape(len(views), rows, cols),
            self.sensor,
            views,
        )

    def expected(self, views: Views, *, background: Background | None = None, workers: int = 1) -> NDArray[np.float64]:
        """Return the expected counts of one frame, pile-up included, (n, zones, bins), zones in image order."""
        signal = self.signal(views, background=background, workers=workers)
        return detected_counts(self.albedo * signal[:, 0] + signal[:, 1], self.sensor)

    def signal(self, views: Views, *, background: Background | None = None, workers: int = 1) -> NDArray[np.float64]:
        """Return the expected signal counts of the landmark for albedo 1, and of what stands behind it.

        Counts are linear in albedos until pile-up; :func:`~phasemark.render.direct.detected_counts` goes on from here.

        Parameters
        ----------
        views : Views
            Views of the landmark.
        background : Background, optional
            Wall and floor; nothing stands behind the landmark without it.
        workers : int
            Number of threads.

        Returns
        -------
        (n, 2, zones, bins) float64
            Landmark, background; stray light between zones included, pile-up not.
        """
        check_workers(workers)
        seen = views.in_camera(self.sensor)
        self._exact.check_can_be_seen(seen, background)
        histogram = histogram_of(self.sensor)
        n = self.sensor.rows * self.sensor.cols
        out = np.zeros((len(views), 2, n, histogram.bins))
        bin_response(self.sensor, self.axis)  # cached before threads ask for it
        tasks = [slice(k, min(k + _VIEWS_AT_ONCE, len(views))) for k in range(0, len(views), _VIEWS_AT_ONCE)]

        def run(task: slice) -> None:
            samples = self._scene.samples_of_views(
                seen[task], self.grid, background=background, finest_m=0.5 * histogram.bin_width_m,
                farthest_m=self.axis.nodes_m[-1],
            )  # fmt: skip
            samples = samples._replace(part=(samples.part >= WALL).astype(np.int32))
            light = zone_transients(samples, self.sensor, self.axis)
            for part in range(1 if background is None else 2):
                out[task, part] = counts_of_light(light[:, part], self.sensor, self.axis)

        mapped(run, tasks, workers)
        return out

    def check_in_view(self, views: Views) -> None:
        """Refuse views that are tilted so far that the landmark is out of the image.

        Parameters
        ----------
        views : Views
            Views of the landmark.

        Raises
        ------
        UsageError
            As :meth:`phasemark.render.Renderer.check_in_view`.
        """
        self._exact.check_in_view(views)
