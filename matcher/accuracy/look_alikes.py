"""Distance from a landmark's noise-free frame to the most similar frame of another class, over distance and side."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.accuracy.appearance import Appearance
from phasemark.matcher.one_frequency import phases_of
from phasemark.render import Background, Renderer, Views

_SHIFT_M = np.arange(-0.04, 0.041, 0.02)
_TURN_RAD = np.radians(np.arange(0.0, 360.0, 10.0))
_STEPS = 3
_LONGEST_STEP = np.array([0.02, math.radians(8.0)])
_PARAMETERS = ("distance_m", "delta_rad")


def class_distances_squared(
    renderer: Renderer,
    views: Views,
    others: Mapping[str, Renderer],
    *,
    n_frames: int = 50,
    background: Background | None = None,
) -> NDArray[np.float64]:
    """Return d² between noise-free frames and the best imitation by each other class (PHYSICS section 7).

    The imitation is sought over distance and side, on a grid about the true distance and then by Gauss–Newton steps, at
    the true bearing and height. A pixel that only one of the two returns counts with the matcher's penalty.

    Parameters
    ----------
    renderer : Renderer
        The true landmark and its camera.
    views : Views
        The true views, n of them.
    others : mapping of str to Renderer
        The other classes, before the same camera.
    n_frames : int
        Frames that are averaged.
    background : Background, optional

    Returns
    -------
    (n, k) float64
        One column for each class of `others`, in their order.
    """
    renderer, others = phases_of(renderer), {name: phases_of(other) for name, other in others.items()}
    truth = Appearance.of(renderer, views, (), None, n_frames, background=background)
    own = np.array([truth.one(k).imitated_by(truth.one(k))[0][0] for k in range(len(views))])
    columns = [_least_cost(truth, views, other, n_frames, background) for other in others.values()]
    found = np.stack(columns, axis=1) if columns else np.zeros((len(views), 0))
    return np.asarray(np.maximum(found - own[:, None], 0.0))


def _least_cost(
    truth: Appearance, views: Views, other: Renderer, n_frames: int, background: Background | None
) -> NDArray[np.float64]:
    """Return the least cost of each true frame as another landmark, (n,)."""
    n = len(views)
    starts = 2
    place = np.empty((n, starts, 2))
    for same in np.unique(np.stack([views.distance_m, views.bearing_rad, views.height_m]), axis=1).T:
        distance, bearing, height = same
        members = np.flatnonzero(
            (views.distance_m == distance) & (views.bearing_rad == bearing) & (views.height_m == height)
        )
        shift, side = (grid.ravel() for grid in np.meshgrid(_SHIFT_M, _TURN_RAD, indexing="ij"))
        grid = Views.broadcast(distance + shift, side, bearing, height)
        images = Appearance.of(other, grid, (), None, n_frames, background=background)
        for k in members:
            best = np.argsort(truth.one(int(k)).imitated_by(images)[0])[:starts]
            place[k] = np.stack([grid.distance_m[best], grid.delta_rad[best]], axis=1)
    whose = np.repeat(np.arange(n), starts)
    at = place.reshape(-1, 2)
    seen = Appearance(
        truth.range_m[whose], truth.weight[whose], truth.slope[whose], truth.coverage[whose], truth.sensor
    )
    least = np.full(len(at), np.inf)
    for step in range(_STEPS + 1):
        moved = Views.broadcast(at[:, 0], at[:, 1], views.bearing_rad[whose], views.height_m[whose])
        parameters = _PARAMETERS if step < _STEPS else ()
        images = Appearance.of(other, moved, parameters, None, n_frames, background=background)
        cost, gradient, information = seen.imitated_by(images)
        least = np.minimum(least, cost)
        if parameters:
            change = np.einsum("nij,nj->ni", np.linalg.pinv(information), gradient)
            at = at + np.clip(change, -_LONGEST_STEP, _LONGEST_STEP)
    return np.asarray(least.reshape(n, starts).min(axis=1))
