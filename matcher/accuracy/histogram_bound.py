"""Best possible accuracy from histograms of a direct sensor: the Poisson information in a view (PHYSICS section 11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.matcher.histograms.poisson_fit import sums_of_frame
from phasemark.matcher.histograms.scene_models import FLOOR, WALL, WALL_STEP_M, planes_of
from phasemark.matcher.information import eliminated
from phasemark.render import Background, Views
from phasemark.render.direct.bin_counts import glass_counts
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_images import HistogramRenderer
from phasemark.render.direct.view_signals import STEPS

_ALBEDOS = {WALL: "wall_albedo", FLOOR: "floor_albedo"}


def histogram_information(
    renderer: HistogramRenderer,
    views: Views,
    free: Sequence[str],
    n_frames: ArrayLike = 1,
    workers: int = 1,
    background: Background | None = None,
    free_wall: bool = False,
) -> NDArray[np.float64]:
    """Return Σ ∂λ ∂λᵀ / λ over the bins of all zones, less what unknown brightness and ambient light cost.

    Parameters
    ----------
    renderer : HistogramRenderer
    views : Views
    free : sequence of str
        Parameters of the view.
    n_frames : array_like
        Frames that are added up, of each view.
    workers : int
    background : Background, optional
        What stands behind the landmark; the brightness of each plane is unknown too.
    free_wall : bool
        Whether the distance of the wall is unknown too.

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
    sensor, histogram = renderer.sensor, histogram_of(renderer.sensor)

    def signal(at: Views, behind: Background | None = background) -> NDArray[np.float64]:
        found = renderer.signal(at, background=behind, workers=workers)
        return renderer.albedo * found[:, 0] + found[:, 1]

    here = signal(views)
    columns = []
    for name in free:
        sides = [signal(replace(views, **{name: getattr(views, name) + step})) for step in (STEPS[name], -STEPS[name])]
        columns.append((sides[0] - sides[1]) / (2 * STEPS[name]))
    for plane in planes_of(background):
        assert background is not None
        others: dict[str, Any] = {name: 0.0 for kind, name in _ALBEDOS.items() if kind != plane}
        columns.append(renderer.signal(views, background=replace(background, **others), workers=workers)[:, 1])
    if free_wall:
        assert background is not None
        farther, nearer = (signal(views, wall) for wall in background.moved_walls(WALL_STEP_M))
        columns.append((farther - nearer) / (2 * WALL_STEP_M))
    slopes = np.stack(columns, axis=1)
    zones, bins = here.shape[1:]
    whole = np.empty((len(views), len(columns) + 1, len(columns) + 1))
    for k, n in enumerate(frames):
        ambient = np.full(zones, n * histogram.cycles * (histogram.ambient + histogram.dark))
        cycles = n * histogram.cycles if histogram.pile_up else math.inf
        nothing, glass = np.zeros((zones, bins)), n * glass_counts(sensor)
        whole[k] = sums_of_frame(nothing, n * here[k], n * slopes[k], 1.0, ambient, glass, cycles).information
    return eliminated(whole, len(free))
