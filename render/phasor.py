"""Noise-free images: the phasor a pixel integrates, and what follows from it (PHYSICS section 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.sensor import Sensor
from phasemark.render.view import Views

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def phasor_to_range_m(phasor: NDArray[np.complexfloating], sensor: Sensor) -> NDArray[np.float64]:
    """Return the range a phasor stands for, (c / 4πf) · arg S in [0, c/2f) (PHYSICS section 3).

    Parameters
    ----------
    phasor : (...) complex
        S_1.
    sensor : Sensor
        The camera; its modulation frequency f is what counts.

    Returns
    -------
    (...) float64
        Metres along the ray; NaN where the phasor is zero.
    """
    range_m = wrap_range_m(sensor.metres_per_radian * np.angle(phasor), sensor)
    return np.where(phasor == 0, np.nan, range_m)


def wrap_range_m(range_m: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Bring ranges into [0, c/2f).

    Parameters
    ----------
    range_m : array_like
        Metres.
    sensor : Sensor

    Returns
    -------
    ndarray
        Metres, in the shape of `range_m`.
    """
    wrapped = np.asarray(range_m, dtype=np.float64) % sensor.unambiguous_range_m
    # the modulo of a tiny negative range rounds up to the period itself
    return np.where(wrapped >= sensor.unambiguous_range_m, 0.0, wrapped)


def wrap_difference_m(difference_m: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Bring differences of ranges into [−c/4f, c/4f).

    Parameters
    ----------
    difference_m : array_like
        Metres.
    sensor : Sensor

    Returns
    -------
    ndarray
        Metres, in the shape of `difference_m`; a difference that is there already stays as it is.
    """
    difference = np.asarray(difference_m, dtype=np.float64)
    period = sensor.unambiguous_range_m
    return difference - period * np.floor(difference / period + 0.5)


@dataclass(frozen=True, eq=False)
class PhasorImages:
    """Noise-free images of a batch of views.

    Parameters
    ----------
    phasor : (n, rows, cols) complex128
        S_1: mean over the pixel's active area of amplitude · exp(iφ).
    intensity : (n, rows, cols) float64
        Mean amplitude, at least ``abs(phasor)``.
    coverage : (n, rows, cols) float64
        Share of the active area that sees the landmark, 0 … 1.
    sensor : Sensor
    views : Views
    upper_coverage : (n, rows, cols) float64, or None
        Share of the active area that sees the landmark's upper part; the rest of `coverage` sees the lower one. None
        where parts are not told apart.
    harmonics : mapping of int to (n, rows, cols) complex128
        S_k for the orders k > 1 that were asked for.
    """

    phasor: NDArray[np.complex128]
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    sensor: Sensor
    views: Views
    upper_coverage: NDArray[np.float64] | None = None
    harmonics: Mapping[int, NDArray[np.complex128]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.phasor)

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range along the ray, in [0, c/2f), NaN where nothing returns; (n, rows, cols)."""
        return phasor_to_range_m(self.phasor, self.sensor)

    @property
    def amplitude(self) -> NDArray[np.float64]:
        """|S_1|, 1 for albedo 1 facing the camera at 1 m; (n, rows, cols)."""
        return np.abs(self.phasor)

    def harmonic(self, order: int) -> NDArray[np.complex128]:
        """Return S_k of one harmonic order, (n, rows, cols).

        Raises
        ------
        UsageError
            The order was not rendered.
        """
        if order == 1:
            return self.phasor
        if order not in self.harmonics:
            raise UsageError(f"harmonic {order} was not rendered: ask for it with Renderer(..., harmonics=({order},))")
        return self.harmonics[order]

    def plot(self, index: int = 0) -> Figure:
        """Draw range, amplitude and coverage of one view for a first look."""
        from phasemark.render.plot import plot_phasor_image

        return plot_phasor_image(self, index)
