"""Renderer of the ranges that the chip of a direct sensor is expected to report (PHYSICS section 11).

A chip does not report the mean range of what a zone sees. It reports targets, one for each surface that it separates,
and a log of ranges has the nearest one of every zone. Where a landmark fills a part of a zone, the range is that of the
landmark, whatever stands behind it, or that of what stands behind it, but never one between.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.background import Backgrounds
from phasemark.render.derivative import VIEW_PARAMETERS, check_parameters
from phasemark.render.direct.bin_counts import detected_counts
from phasemark.render.direct.expected_targets import expected_targets
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.view_signals import STEPS, ViewSignals, moved_about
from phasemark.render.integral.area_integral import Variant
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.view import VIEW_FIELDS, Views

__all__ = ["ChipRenderer"]

_JUMP_M = 0.02
"""Ranges on both sides of a view that differ by more are those of two surfaces: their difference is no slope."""


class ChipRenderer(Renderer):
    """Renders what the chip of a direct sensor reports of one landmark, from any view.

    Images are those of :class:`~phasemark.render.Renderer`, but that the argument of a phasor is the expected range of
    the nearest target of the zone. A phasor is 0 where no target is sure to be reported.

    Parameters
    ----------
    mesh : trimesh.Trimesh or None
        As for :class:`~phasemark.render.Renderer`.
    sensor : Sensor
        With a [histogram] table.
    albedo : float
        Of the Lambertian landmark, in (0, 1].
    unsure_coverage : float, optional
        Coverage that zones have at most whose target may be reported and need not be: their phasor is then that of its
        range. None: their phasor is 0.

    Raises
    ------
    UsageError
        The sensor has no [histogram] table, or whatever :class:`~phasemark.render.Renderer` refuses.
    """

    def __init__(
        self, mesh: SurfaceMesh | None, sensor: Sensor, *, albedo: float = 0.8, unsure_coverage: float | None = None
    ) -> None:
        if sensor.histogram is None:
            raise UsageError("the sensor has no [histogram] table: what its chip reports is not described")
        super().__init__(mesh, sensor, albedo=albedo, harmonics=())
        self._signals, self._unsure_coverage = ViewSignals(mesh, sensor, self.albedo), unsure_coverage

    def seen_by(self, sensor: Sensor) -> ChipRenderer:
        """Return a renderer of the same landmark for another direct sensor; see :meth:`Renderer.seen_by`."""
        other = copy.copy(self)
        other.sensor, other.untrusted_pixels, other._signals = sensor, 0, self._signals.seen_by(sensor)
        return other

    def render_views(
        self,
        views: Views,
        *,
        background: Backgrounds = None,
        rows: tuple[int, int] | None = None,
        variant: Variant = "exact",
        workers: int = 1,
    ) -> PhasorImages:
        """Render a batch of views; see :meth:`Renderer.render`."""
        light = super().render_views(views, background=background, rows=rows, variant=variant, workers=workers)
        if variant != "exact":
            return light
        range_m, sure = self._reported(views, background, workers)
        some = slice(*rows) if rows else slice(None)
        return self._with_ranges(light, range_m[:, some], sure[:, some])

    def render_with_slopes(
        self,
        views: Views,
        parameters: Sequence[str] = VIEW_PARAMETERS,
        *,
        background: Backgrounds = None,
        workers: int = 1,
    ) -> tuple[PhasorImages, NDArray[np.complex128]]:
        """Render views, and how their phasors change.

        With nothing behind the landmark ranges change as the mean range of the light does, in closed form; otherwise
        slopes are differences over the steps of histograms.
        """
        check_parameters(parameters)
        if background is None:
            light, by_light = super().render_with_slopes(views, parameters, workers=workers)
            image = self._with_ranges(light, *self._reported(views, None, workers))
            lit = ((image.phasor != 0) & (light.phasor != 0))[:, None]
            along = np.divide(by_light, light.phasor[:, None], out=np.zeros_like(by_light), where=lit)
            return image, 1j * image.phasor[:, None] * along.imag
        light = super().render_views(views, background=background, workers=workers)
        n, each = len(views), 1 + 2 * len(parameters)
        at = np.stack([getattr(views, name) for name in VIEW_FIELDS], axis=1)
        about = np.concatenate([moved_about(view, parameters) for view in at]) if n else at
        behind = background
        if isinstance(background, Sequence):
            behind = [own for own in background for _ in range(each)]
        moved = Views(*np.ascontiguousarray(about.T))
        range_m, sure = self._reported(moved, behind, workers)
        range_m = range_m.reshape(n, each, self.sensor.rows, self.sensor.cols)
        image = self._with_ranges(light, range_m[:, 0], sure.reshape(range_m.shape)[:, 0])
        slope = np.zeros((n, len(parameters), self.sensor.rows, self.sensor.cols), np.complex128)
        for k, name in enumerate(parameters):
            rise = range_m[:, 1 + 2 * k] - range_m[:, 2 + 2 * k]
            by_parameter = np.where(np.abs(rise) < _JUMP_M, rise, 0.0) / (2 * STEPS[name])
            slope[:, k] = 1j * image.phasor * by_parameter / self.sensor.metres_per_radian
        return image, slope

    def _with_ranges(self, light: PhasorImages, range_m: NDArray[np.float64], sure: NDArray[np.bool_]) -> PhasorImages:
        """Return images with the ranges that the chip reports, or may report where it is not sure to."""
        turn = np.exp(1j * np.nan_to_num(range_m) / self.sensor.metres_per_radian)
        image = replace(light, phasor=np.where(np.isfinite(range_m), light.intensity * turn, 0.0))
        if self._unsure_coverage is None:
            return image
        return replace(
            image, coverage=np.where(sure, image.coverage, np.minimum(image.coverage, self._unsure_coverage))
        )

    def _reported(
        self, views: Views, background: Backgrounds, workers: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return the expected ranges of the nearest targets, and which are sure to be reported; (n, rows, cols) each.

        NaN where there is none, and unless a coverage marks those that are not sure, where none is sure.
        """
        sensor = self.sensor
        found = expected_targets(detected_counts(self._signal(views, background, workers), sensor), sensor)
        distance = np.where(np.isfinite(found.distance_m), found.distance_m, np.inf)
        nearest = distance.argmin(axis=-1)[..., None]
        sure = np.take_along_axis(found.sure, nearest, axis=-1)[..., 0]
        nearest_m = np.take_along_axis(distance, nearest, axis=-1)[..., 0]
        known = sure if self._unsure_coverage is None else np.isfinite(nearest_m)
        nearest_m = np.where(known, nearest_m, np.nan)
        shape = (len(views), sensor.rows, sensor.cols)
        forward: Any = sensor.axis_cosine() if histogram_of(sensor).reports == "z" else 1.0
        offset = sensor.zone_offsets + sensor.range_offset_m  # taken off measured ranges before they are compared
        return np.asarray(nearest_m.reshape(shape) / forward - offset), sure.reshape(shape)

    def _signal(self, views: Views, background: Backgrounds, workers: int) -> NDArray[np.float64]:
        """Return the expected signal counts of landmark and background, (n, zones, bins)."""
        signal = np.empty((len(views), self.sensor.rows * self.sensor.cols, histogram_of(self.sensor).bins))
        behind = background if isinstance(background, Sequence) else [background] * len(views)
        for own in set(behind):
            of = np.flatnonzero([one == own for one in behind])
            if own is None:
                signal[of] = self._signals.counts(views[of], workers)
            else:
                signal[of] = self._signals.surfaces(views[of], own, workers).sum(axis=1)
        return signal
