"""Noise-free images: the phasor a pixel integrates, and what follows from it (PHYSICS section 3)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.inputs.numbers import in_words
from phasemark.render.png import figure_png
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.unwrapping import unwrap_ranges
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
        The camera; only its modulation frequency f counts, the first of several.

    Returns
    -------
    (...) float64
        Metres along the ray; NaN where the phasor is zero.
    """
    imag, real = np.imag(phasor), np.real(phasor)
    if imag.dtype == np.float64:  # the arctangent of arrays without gaps is quicker and, in this precision, the same
        imag, real = np.ascontiguousarray(imag), np.ascontiguousarray(real)
    signed_m = sensor.metres_per_radian * np.arctan2(imag, real)
    # what wrap_range_m does, which for ± c/4f needs no division
    range_m = np.asarray(signed_m + np.where(signed_m < 0, sensor.period_m, 0.0))
    np.copyto(range_m, 0.0, where=range_m >= sensor.period_m)
    np.copyto(range_m, np.nan, where=phasor == 0)
    return range_m


def wrap_range_m(range_m: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Wrap ranges into [0, c/2f), of several frequencies into [0, c / (2 · gcd)).

    Parameters
    ----------
    range_m : array_like
        Metres.
    sensor : Sensor
        The camera.

    Returns
    -------
    ndarray
        Metres, in the shape of `range_m`.
    """
    wrapped = np.asarray(range_m, dtype=np.float64) % sensor.unambiguous_range_m
    # the modulo of a tiny negative range rounds up to the period itself
    return np.where(wrapped >= sensor.unambiguous_range_m, 0.0, wrapped)


def wrap_difference_m(difference_m: ArrayLike, sensor: Sensor) -> NDArray[np.float64]:
    """Wrap differences of ranges into [−c/4f, c/4f), of several frequencies into ± c / (4 · gcd).

    Parameters
    ----------
    difference_m : array_like
        Metres.
    sensor : Sensor
        The camera.

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
        S_1: mean over the pixel's active area of amplitude · exp(iφ), at the first modulation frequency.
    intensity : (n, rows, cols) float64
        Mean amplitude, at least ``abs(phasor)``.
    coverage : (n, rows, cols) float64
        Share of the active area that sees the landmark, 0 … 1.
    sensor : Sensor
        The camera.
    views : Views, or None
        Views of the landmark; None for images of anything else.
    upper_coverage : (n, rows, cols) float64, or None
        Share of the active area that sees the landmark's upper part; the rest of `coverage` sees the lower one. None
        where parts are not distinguished.
    harmonics : mapping of int to (n, rows, cols) complex128
        S_k for the orders k > 1 that were asked for, of the first modulation frequency.
    by_hz : mapping of float to (n, rows, cols) complex128
        S at further frequencies, in hertz: the sensor's other modulation frequencies and the harmonics of each.
    shares : (n, rows, cols, b) float64, or None
        Share of the active area that each of b bodies of a scene fills.
    bodies : tuple of str
        Their names.
    """

    figure: ClassVar[Callable[..., Figure]]
    """Function that draws it; the package sets it, because drawing imports matplotlib, which takes half a second."""

    phasor: NDArray[np.complex128]
    intensity: NDArray[np.float64]
    coverage: NDArray[np.float64]
    sensor: Sensor
    views: Views | None = None
    upper_coverage: NDArray[np.float64] | None = None
    harmonics: Mapping[int, NDArray[np.complex128]] = field(default_factory=dict)
    by_hz: Mapping[float, NDArray[np.complex128]] = field(default_factory=dict)
    shares: NDArray[np.float64] | None = None
    bodies: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Describe in one line how many images there are, and the camera."""
        return f"PhasorImages({len(self)} {'images' if self.views is None else 'views'}, {self.sensor!r})"

    def __len__(self) -> int:
        return len(self.phasor)

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range along the ray, in [0, c/2f), NaN where nothing returns; (n, rows, cols).

        Of several frequencies it is the range of :func:`~phasemark.render.unwrap_ranges`, in [0, c / (2 · gcd)).
        """
        if len(self.sensor.frequencies_hz) == 1:
            return phasor_to_range_m(self.phasor, self.sensor)
        wrapped = np.stack([image.range_m for image in self.by_frequency])
        # noise falls as 1 / (f · amplitude); one factor for all changes nothing
        amplitude = np.stack([image.amplitude for image in self.by_frequency])
        scale = np.array([camera.metres_per_radian for camera in self.sensor.by_frequency])
        std = np.divide(scale[:, None, None, None], amplitude, out=np.ones_like(amplitude), where=amplitude > 0)
        return unwrap_ranges(wrapped, std, self.sensor).range_m

    @property
    def phasors(self) -> NDArray[np.complex128]:
        """S at each of the sensor's m modulation frequencies, (n, m, rows, cols)."""
        return np.stack([self.at_frequency(hz) for hz in self.sensor.frequencies_hz], axis=1)

    @property
    def by_frequency(self) -> tuple[PhasorImages, ...]:
        """The images that the camera sees at each of its modulation frequencies; of one frequency the images alone."""
        if len(self.sensor.frequencies_hz) == 1:
            return (self,)
        known = self._known_hz()
        return tuple(
            replace(
                self,
                phasor=self.at_frequency(hz),
                sensor=camera,
                harmonics={k: known[own] for own in sorted(known) if (k := round(own / hz)) > 1 and k * hz == own},
                by_hz={},
            )
            for hz, camera in zip(self.sensor.frequencies_hz, self.sensor.by_frequency, strict=True)
        )

    def at_frequency(self, hz: float) -> NDArray[np.complex128]:
        """Return S at one modulation frequency, (n, rows, cols).

        Parameters
        ----------
        hz : float
            One of the sensor's frequencies, or a harmonic of one that was rendered.

        Raises
        ------
        UsageError
            The images do not have the frequency.
        """
        known = self._known_hz()
        found = next((values for own, values in known.items() if math.isclose(own, hz, rel_tol=1e-9)), None)
        if found is None:
            raise UsageError(f"the images have no phasor at {hz:.12g} Hz, only at {in_words(sorted(known))} Hz")
        return found

    def _known_hz(self) -> dict[float, NDArray[np.complex128]]:
        """Return all phasors by their frequency, hertz."""
        first_hz = self.sensor.frequencies_hz[0]
        return {first_hz: self.phasor} | {k * first_hz: s for k, s in self.harmonics.items()} | dict(self.by_hz)

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

    @property
    def part_labels(self) -> NDArray[np.int8]:
        """What most of each pixel sees: 0 background or nothing, 1 the lower part, 2 the upper one; (n, rows, cols).

        Of images rendered with ``variant="hard"`` this is the surface that the centre ray meets. Where shares
        are equal the smaller number is returned.

        Raises
        ------
        UsageError
            The images do not distinguish parts.
        """
        if self.upper_coverage is None:
            raise UsageError("these images do not tell the landmark's parts apart: 'upper_coverage' is None")
        shares = np.stack([1 - self.coverage, self.coverage - self.upper_coverage, self.upper_coverage])
        return np.asarray(shares.argmax(axis=0), dtype=np.int8)

    def composed_with(self, behind: PhasorImages) -> PhasorImages:
        """Put a background behind images of the landmark alone (PHYSICS section 3).

        S = S_landmark + (1 − coverage) · S_background, for every harmonic order both have, and the intensity alike. It
        takes the background to be constant over a pixel: before a wall it is good to 4e-4 of the brightest pixel, over
        a floor seen at a slant to about 2e-3, and to a few hundredths where wall and floor meet inside a pixel the
        landmark covers in part. Rendering with the background is exact.

        Parameters
        ----------
        behind : PhasorImages
            What the same camera sees of the background without a landmark, ``Renderer(None, sensor)``; one image, or
            one for each.

        Raises
        ------
        UsageError
            The cameras differ, or the numbers of images do.
        """
        difference = self.sensor.optics_difference(behind.sensor)
        if difference is not None:
            raise UsageError(f"the background was rendered for another camera: {difference}")
        if self.phasor.shape[1:] != behind.phasor.shape[1:] or len(behind) not in (1, len(self)):
            raise UsageError(f"'behind' must hold 1 or {len(self)} images of the same rows, got {len(behind)}")
        free = 1 - self.coverage
        return replace(
            self,
            phasor=self.phasor + free * behind.phasor,
            intensity=self.intensity + free * behind.intensity,
            harmonics={
                order: s + free * behind.harmonics[order]
                for order, s in self.harmonics.items()
                if order in behind.harmonics
            },
            by_hz={hz: s + free * behind.by_hz[hz] for hz, s in self.by_hz.items() if hz in behind.by_hz},
        )

    def plot(self, index: int = 0) -> Figure:
        """Draw range, amplitude and coverage of one view for a first look."""
        return type(self).figure(self, index)

    def _repr_png_(self) -> bytes | None:
        """Show the first view in a notebook; nothing where there is none."""
        return figure_png(self.plot()) if len(self) else None
