"""Histograms of a direct sensor, measured or simulated, and their capture (PHYSICS section 11)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.inputs.numbers import real_array
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.photon_counts import draw_counts
from phasemark.render.direct.targets import Targets, find_targets
from phasemark.render.exposure.random_streams import draw_key
from phasemark.render.frames import Flag, Frames
from phasemark.render.sensor.camera_unit import camera_unit
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.threads import mapped

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REFERENCE_WINDOW = (4, 8)
"""Bins before and after the highest bin that the centroid of the reference histogram takes in."""


class HistogramFrames:
    """Histograms of n positions, several frames each.

    Parameters
    ----------
    counts : array_like, (n, frames, rows, cols, bins), (frames, rows, cols, bins) or (rows, cols, bins)
        Photon counts; zones in image order.
    sensor : Sensor
        With a [histogram] table.
    reference : array_like, (n, frames, reference bins), optional
        The chip's own reference path; its peak follows the drift of the time converter.
    time_s : array_like, (n, frames), optional
        Time stamps.

    Raises
    ------
    UsageError
        The shapes do not agree, or a count is negative, not finite, complex, masked or beyond what pile-up leaves.
    """

    figure: ClassVar[Callable[..., Figure]]
    """Function that draws it; the package sets it, because drawing imports matplotlib, which takes half a second."""

    def __init__(
        self,
        counts: ArrayLike,
        *,
        sensor: Sensor,
        reference: ArrayLike | None = None,
        time_s: ArrayLike | None = None,
    ) -> None:
        histogram = histogram_of(sensor)
        array = real_array("counts", counts)
        if array.ndim not in (3, 4, 5):
            raise UsageError(f"'counts' must have shape (n, frames, rows, cols, bins), got {array.shape}")
        array = array.reshape((1,) * (5 - array.ndim) + array.shape)
        if array.shape[2:4] != (sensor.rows, sensor.cols):
            raise UsageError(
                f"the histograms have {array.shape[2]} × {array.shape[3]} zones, but the sensor has"
                f" {sensor.rows} × {sensor.cols}"
            )
        if array.shape[4] != histogram.bins:
            raise UsageError(f"the histograms have {array.shape[4]} bins, but the sensor has {histogram.bins}")
        wrong = ~(np.isfinite(array) & (array >= 0))
        if wrong.any():
            at = np.argwhere(wrong)[0]
            raise UsageError(f"counts must not be negative, {_place(at)} has {array[tuple(at)]:g}")
        if histogram.pile_up:
            full = array.sum(axis=-1) >= histogram.cycles
            if full.any():
                at = np.argwhere(full)[0]
                raise UsageError(
                    f"a histogram is saturated: {_place(at)} has {array[tuple(at)].sum():.4g} counts, and 'cycles' ="
                    f" {histogram.cycles:.4g} first photons are all there can be"
                )
        self.counts: NDArray[np.float64] = array
        self.sensor = sensor
        n, frames = array.shape[:2]
        self.reference = None if reference is None else np.array(reference, dtype=np.float64).reshape(n, frames, -1)
        self.time_s = None if time_s is None else np.array(time_s, dtype=np.float64).reshape(n, frames)

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, positions: slice | NDArray[np.integer]) -> Self:
        """Return some positions."""
        return type(self)(
            self.counts[positions],
            sensor=self.sensor,
            reference=None if self.reference is None else self.reference[positions],
            time_s=None if self.time_s is None else self.time_s[positions],
        )

    @property
    def n_frames(self) -> int:
        """Frames of each position."""
        return int(self.counts.shape[1])

    @cached_property
    def targets(self) -> Targets:
        """What the chip makes of the histograms: distance, sigma, signal and status, nearest first."""
        return find_targets(self)

    @property
    def ranges(self) -> Frames:
        """The nearest target of every zone as frames of ranges along the ray, which matchers of ranges take.

        A zone without a target has the flag `NO_RETURN`, one whose range is negative `MISSING`, a dead one `DEAD`.
        """
        return nearest_ranges(self.targets, self.sensor)

    def plot(self, index: int = 0, frame: int = 0) -> Figure:
        """Draw the histograms of all zones of one frame, and the range of the nearest target."""
        return type(self).figure(self, index, frame)

    @property
    def zone_counts(self) -> NDArray[np.float64]:
        """Counts summed over the frames of each position, (n, zones, bins), zones in image order."""
        n, _, rows, cols, bins = self.counts.shape
        return np.asarray(self.counts.sum(axis=1).reshape(n, rows * cols, bins))

    @property
    def reference_shift_bins(self) -> NDArray[np.float64]:
        """How far the peak of the reference histogram lies from where it stood at calibration, bins, (n,)."""
        histogram = histogram_of(self.sensor)
        if self.reference is None or histogram.reference_peak is None:
            return np.zeros(len(self))
        return reference_centroid(self.reference.sum(axis=1)) - histogram.reference_peak

    @property
    def drift_bins(self) -> NDArray[np.float64]:
        """How far histograms are shifted by the drift that the reference histogram shows, bins, (n,)."""
        return histogram_of(self.sensor).reference_gain * self.reference_shift_bins


def nearest_ranges(targets: Targets, sensor: Sensor) -> Frames:
    """Return the nearest target of every zone as frames of ranges; see :attr:`HistogramFrames.ranges`.

    Parameters
    ----------
    targets : Targets
        As the sensor's chip reports them, as ranges or z.
    sensor : Sensor
        With a [histogram] table.

    Returns
    -------
    Frames
        (n, frames, rows, cols).
    """
    cosine = sensor.axis_cosine() if histogram_of(sensor).reports == "z" else 1.0
    range_m = np.asarray(targets.distance_m[..., 0] / cosine)
    flags = np.where(np.isnan(range_m), int(Flag.NO_RETURN), 0).astype(np.uint8)
    flags[..., camera_unit(sensor).dead] = int(Flag.DEAD | Flag.MISSING)
    return Frames(np.where(flags == 0, range_m, np.nan), flags=flags, sensor=sensor)


def reference_centroid(reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centroid of each reference histogram about its highest bin; (n, bins) to (n,), bins.

    The window is the same for all, about the highest bin of their sum, so that it does not jump.
    """
    top = int(reference.sum(axis=0).argmax())
    window = slice(max(top - _REFERENCE_WINDOW[0], 0), top + _REFERENCE_WINDOW[1])
    part = reference[:, window]
    total = part.sum(axis=1)
    least_centroid_counts = 1.0
    if (total < least_centroid_counts).any():
        raise UsageError(f"reference histogram {int((total < least_centroid_counts).argmax())} is empty")
    bins = np.arange(reference.shape[1])[window]
    return np.asarray((part @ bins) / total)


def capture_histograms(
    expected: ArrayLike,
    sensor: Sensor,
    *,
    rng: np.random.Generator,
    n_frames: int = 1,
    first_view: int = 0,
    first_frame: int = 0,
    workers: int = 1,
) -> HistogramFrames:
    """Draw histograms from their expected counts.

    Parameters
    ----------
    expected : (n, zones, bins) array_like
        From :func:`~phasemark.render.direct.expected_counts`.
    sensor : Sensor
        The camera.
    rng : numpy.random.Generator
        Source of all noise; it is advanced by the same amount whatever is captured.
    n_frames : int
        Frames of each view, with independent noise.
    first_view, first_frame : int
        Numbers of the first view and frame in a longer run. A count depends on `rng`'s state and on the numbers of
        view, frame, zone and bin alone.
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    HistogramFrames
        Counts are Poisson, above a mean of 500 a normal of the same mean and variance, rounded. Dead zones count
        nothing.
    """
    means = np.ascontiguousarray(expected, dtype=np.float64)
    histogram = histogram_of(sensor)
    n = sensor.rows * sensor.cols
    if means.ndim != 3 or means.shape[1:] != (n, histogram.bins):
        raise UsageError(f"'expected' must have shape (n, {n}, {histogram.bins}), got {means.shape}")
    if not (np.isfinite(means) & (means >= 0)).all():
        raise UsageError("'expected' must be finite and not negative")
    least_of = {"n_frames": (n_frames, 1), "first_view": (first_view, 0), "first_frame": (first_frame, 0)}
    for name, (value, least) in {**least_of, "workers": (workers, 1)}.items():
        if value < least:
            raise UsageError(f"'{name}' must be at least {least}, got {value!r}")
    dead = camera_unit(sensor).dead.ravel()
    if dead.any():
        means = np.where(dead[:, None], 0.0, means)
    key = draw_key(rng)
    flat = means.reshape(len(means), -1)
    total = len(means) * n_frames
    out = np.empty((total, flat.shape[1]))
    share = -(-total // workers)

    def draw(first: int) -> None:
        draw_counts(flat, first, min(first + share, total), n_frames, first_view, first_frame, key, out)

    mapped(draw, range(0, total, share) if total else (), workers)
    shape = (len(means), n_frames, sensor.rows, sensor.cols, histogram.bins)
    frames = HistogramFrames.__new__(HistogramFrames)
    frames.counts, frames.sensor, frames.reference, frames.time_s = out.reshape(shape), sensor, None, None
    return frames


def _place(at: NDArray[np.integer]) -> str:
    """Name where in an array of counts something is."""
    names = ("position", "frame", "row", "column", "bin")
    return ", ".join(f"{name} {int(k)}" for name, k in zip(names, at, strict=False))
