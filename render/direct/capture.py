"""Taking frames of whatever was rendered: phasors and ranges, or the histograms of a direct sensor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypedDict, Unpack, overload

import numpy as np

from phasemark import UsageError
from phasemark.render.background import Background
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames, capture_histograms
from phasemark.render.direct.histogram_images import HistogramImages, HistogramRenderer
from phasemark.render.exposure import capture as phase_chain
from phasemark.render.frames import Frames
from phasemark.render.integral.surface_mesh import SurfaceMesh
from phasemark.render.phasor_images import PhasorImages
from phasemark.render.renderer import Renderer
from phasemark.render.sensor.sensor import Sensor
from phasemark.render.view import Views

ON_CHIP = ("estimator", "estimator_bins", "max_targets", "threshold", "min_separation_m", "reports", "zone_order")
"""Fields of [histogram] that say what becomes of counts, not what is counted."""


class _Options(TypedDict, total=False):
    n_frames: int
    first_view: int
    first_frame: int
    keep_taps: bool
    workers: int


@overload
def capture(
    image: HistogramImages, sensor: Sensor, *, rng: np.random.Generator, **options: Unpack[_Options]
) -> HistogramFrames: ...
@overload
def capture(
    image: PhasorImages | Sequence[PhasorImages],
    sensor: Sensor,
    *,
    rng: np.random.Generator,
    **options: Unpack[_Options],
) -> Frames: ...
def capture(
    image: PhasorImages | Sequence[PhasorImages] | HistogramImages,
    sensor: Sensor,
    *,
    rng: np.random.Generator,
    n_frames: int = 1,
    first_view: int = 0,
    first_frame: int = 0,
    keep_taps: bool = False,
    workers: int = 1,
) -> Frames | HistogramFrames:
    """Take noisy frames of noise-free images.

    Parameters
    ----------
    image : PhasorImages, four of them, or HistogramImages
        n views; or what a moving camera sees during each phase image (4 m of m modulation frequencies), from
        :func:`~phasemark.render.exposure.render_moving`; or the histograms of a direct sensor, from
        :class:`~phasemark.render.direct.HistogramRenderer`.
    sensor : Sensor
        The camera; it may differ from the one the image was rendered for in electrons, noise and validity, not in
        geometry or modulation. Of histograms only what the chip makes of counts may differ.
    rng : numpy.random.Generator
        Source of all noise. It is advanced by the same amount whatever is captured, and each noise term draws from
        its own stream, so that switching one term off leaves the others' noise as it was.
    n_frames : int
        Frames of each view, with independent noise.
    first_view, first_frame : int
        Numbers of the first view and frame in a longer run. A sample's noise depends on `rng`'s state and on the
        numbers of view, frame and pixel alone, so a run captured piece by piece, each from a generator in the same
        state, has the same bytes as a run captured at once.
    keep_taps : bool
        Whether to keep what each tap reported, as ``frames.taps_e``.
    workers : int
        Threads; the result does not depend on their number.

    Returns
    -------
    Frames or HistogramFrames
        (n, n_frames, rows, cols). An invalid pixel has range NaN, and its flags say why. Several modulation frequencies
        are captured one after the other, each with its own noise, and unwrapped
        (`unwrap_frames`); ``frames.by_frequency`` has each alone. A direct sensor gives neither
        amplitude nor intensity; its own quantity is ``frames.z_m``. Of histograms ``frames.counts`` has the counts, and
        ``frames.targets`` what the chip reports: distance, sigma, signal and status.

    Raises
    ------
    UsageError
        A number is out of range; the image was rendered for other optics or another [histogram] table, or lacks a
        harmonic the sensor needs; it is not finite, or its phasor is larger than its intensity allows; taps or motion
        are asked of a direct sensor.
    """
    if not isinstance(image, HistogramImages):
        return phase_chain.capture(
            image, sensor, rng=rng, n_frames=n_frames, first_view=first_view, first_frame=first_frame,
            keep_taps=keep_taps, workers=workers,
        )  # fmt: skip
    if keep_taps:
        raise UsageError("'keep_taps' must be left out for a direct sensor: it has neither taps nor phase images")
    _refuse_other_sensor(image.sensor, sensor)
    n, bins = sensor.rows * sensor.cols, image.expected.shape[-1]
    return capture_histograms(
        image.expected.reshape(len(image), n, bins), sensor, rng=rng, n_frames=n_frames, first_view=first_view,
        first_frame=first_frame, workers=workers,
    )  # fmt: skip


def capture_ranges(
    mesh: SurfaceMesh,
    sensor: Sensor,
    views: Views,
    *,
    albedo: float = 0.8,
    background: Background | None = None,
    rng: np.random.Generator,
    n_frames: int = 1,
    first_view: int = 0,
) -> Frames:
    """Take frames of a landmark as its sensor gives them; with a table [histogram], as its chip reports them.

    Parameters
    ----------
    mesh : trimesh.Trimesh
    sensor : Sensor
    views : Views
        n of them.
    albedo : float
        Of the landmark.
    background : Background or None
    rng, n_frames, first_view
        As for :func:`capture`.

    Returns
    -------
    Frames
        (n, n_frames, rows, cols).
    """
    if sensor.histogram is None:
        image = Renderer(mesh, sensor, albedo=albedo).render_views(views, background=background)
        return capture(image, sensor, rng=rng, n_frames=n_frames, first_view=first_view)
    counted = HistogramRenderer(mesh, sensor, albedo=albedo).render_views(views, background=background)
    return capture(counted, sensor, rng=rng, n_frames=n_frames, first_view=first_view).ranges


def _refuse_other_sensor(rendered: Sensor, sensor: Sensor) -> None:
    """Refuse histograms that were rendered for a sensor that counts otherwise."""
    own, other = histogram_of(sensor).model_dump(), histogram_of(rendered).model_dump()
    if difference := sensor.optics_difference(rendered):
        raise UsageError(f"the histograms were rendered for another sensor: {difference}")
    names = [f"histogram.{name}" for name in own if name not in ON_CHIP and own[name] != other[name]]
    names += [name for name in ("range_offset_m", "zone_offset_m") if getattr(sensor, name) != getattr(rendered, name)]
    if names:
        raise UsageError(f"the histograms were rendered for another sensor: '{names[0]}' differs")
