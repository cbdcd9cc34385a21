"""Noise-free images as the matcher weighs them, and how well one landmark's image imitates another's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE, counts
from phasemark.render import Background, Renderer, Sensor, Views, phasor_to_range_m, predicted_range_std
from phasemark.render.phasor_images import wrap_difference_m

_STEP_M = 1e-4


@dataclass(frozen=True, eq=False)
class Appearance:
    """Noise-free images as the matcher weighs them; (n, pixels) arrays.

    Parameters
    ----------
    range_m : float64
    weight : float64
        1/σ² of the filtered range, m⁻²; 0 where one frame does not measure it to 0.1 rad.
    slope : (n, p, pixels) float64
        Of the range by the parameters that may differ.
    coverage : float64
    sensor : Sensor
    """

    range_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    slope: NDArray[np.float64]
    coverage: NDArray[np.float64]
    sensor: Sensor

    @classmethod
    def of(
        cls,
        renderer: Renderer,
        views: Views,
        parameters: Sequence[str],
        rows: tuple[int, int] | None,
        n_frames: int,
        *,
        background: Background | None = None,
    ) -> Appearance:
        """Render some rows of views, or all; where a background returns light, a pixel counts as covered."""
        sensor = renderer.sensor
        n = len(views)

        def phasors(moved: Views) -> NDArray[np.complex128]:
            return renderer.render_views(moved, background=background, rows=rows).phasor.reshape(n, -1)

        image = renderer.render_views(views, background=background, rows=rows)
        s = image.phasor.reshape(n, -1)
        seen = counts(s, image.intensity.reshape(n, -1), sensor) & (s != 0)
        std = predicted_range_std(np.abs(s), image.intensity.reshape(n, -1), sensor)
        slopes = []
        for name in parameters:
            columns = {key: getattr(views, key) for key in ("distance_m", "delta_rad", "bearing_rad", "height_m")}
            ends = [phasors(Views(**{**columns, name: columns[name] + side * _STEP_M})) for side in (1, -1)]
            turn = (ends[0] - ends[1]) / (2 * _STEP_M)
            power = np.where(s != 0, np.abs(s) ** 2, 1.0)
            slopes.append(sensor.metres_per_radian * (s.conj() * turn).imag / power)
        return cls(
            np.where(s != 0, phasor_to_range_m(np.where(s != 0, s, 1.0), sensor), 0.0),
            np.divide(n_frames, std**2, out=np.zeros(std.shape), where=seen),
            np.stack(slopes, axis=1) if slopes else np.zeros((n, 0, s.shape[1])),
            np.where((s != 0) & (background is not None), 1.0, image.coverage.reshape(n, -1)),
            sensor,
        )

    def imitated_by(self, other: Appearance) -> tuple[NDArray[np.float64], ...]:
        """Compare with images of another landmark; shapes broadcast over the views.

        Returns
        -------
        cost, gradient, information
            Whitened squared distance with penalties, (n,); Jᵀ W r (n, p) and Jᵀ W J (n, p, p) by the other's
            parameters.
        """
        returned = self.weight > 0
        may, must = other.coverage >= MAY_RETURN_COVERAGE, other.coverage > MUST_RETURN_COVERAGE
        weight = np.where(may, self.weight, 0.0)
        residual = wrap_difference_m(self.range_m - other.range_m, self.sensor)
        penalty = DISAGREEMENT * ((returned & ~may) | (~returned & must)).sum(axis=-1)
        cost = (weight * residual**2).sum(axis=-1) + penalty
        weighted = weight[..., None, :] * other.slope
        gradient = (weighted * residual[..., None, :]).sum(axis=-1)
        return cost, gradient, weighted @ np.swapaxes(other.slope, -1, -2)

    def one(self, k: int) -> Appearance:
        """Return one view, to be broadcast against others."""
        part = slice(k, k + 1)
        return Appearance(self.range_m[part], self.weight[part], self.slope[part], self.coverage[part], self.sensor)
