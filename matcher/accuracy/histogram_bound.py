"""Best possible accuracy from histograms of a direct sensor: the Poisson information in a view (PHYSICS section 11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.histograms.histogram_matcher import glass_counts
from phasemark.matcher.histograms.poisson_fit import frame_sums
from phasemark.matcher.histograms.view_signals import STEPS
from phasemark.render import Views
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_images import HistogramRenderer


def histogram_information(
    renderer: HistogramRenderer, views: Views, free: Sequence[str], n_frames: ArrayLike = 1, workers: int = 1
) -> NDArray[np.float64]:
    """Return Σ ∂λ ∂λᵀ / λ over the bins of all zones, what unknown brightness and ambient light cost taken off.

    Parameters
    ----------
    renderer : HistogramRenderer
    views : Views
    free : sequence of str
        Parameters of the view.
    n_frames : array_like
        Frames that are added up, of each view.
    workers : int

    Returns
    -------
    (n, p, p) float64

    Raises
    ------
    UsageError
        Frames are counted pixel by pixel.
    """
    frames = np.asarray(n_frames, np.float64)
    if frames.ndim > 1 or (frames.ndim == 1 and len(frames) not in (1, len(views))):
        raise UsageError(f"'n_frames' of histograms must be one number, or one for each view, got shape {frames.shape}")
    frames = np.broadcast_to(frames, (len(views),))
    sensor, histogram, p = renderer.sensor, histogram_of(renderer.sensor), len(free)

    def signal(at: Views) -> NDArray[np.float64]:
        return renderer.albedo * renderer.signal(at, workers=workers)[:, 0]

    here = signal(views)
    slopes = np.empty((len(views), p, *here.shape[1:]))
    for k, name in enumerate(free):
        sides = [signal(replace(views, **{name: getattr(views, name) + step})) for step in (STEPS[name], -STEPS[name])]
        slopes[:, k] = (sides[0] - sides[1]) / (2 * STEPS[name])
    out = np.empty((len(views), p, p))
    zones, bins = here.shape[1:]
    level, own, scratch = np.empty((zones, bins)), np.empty((zones, p + 3)), np.empty((2, p + 2))
    whole, gradient = np.empty((p + 1, p + 1)), np.empty(p + 1)
    for k, n in enumerate(frames):
        ambient = np.full(zones, n * histogram.cycles * (histogram.ambient + histogram.dark))
        cycles = n * histogram.cycles if histogram.pile_up else math.inf
        frame_sums(
            np.zeros((zones, bins)), n * here[k], n * slopes[k], 1.0, ambient, n * glass_counts(sensor), cycles, level,
            whole, gradient, own, scratch,
        )  # fmt: skip
        out[k] = whole[:-1, :-1] - np.outer(whole[:-1, -1], whole[-1, :-1]) / whole[-1, -1]
    return out
