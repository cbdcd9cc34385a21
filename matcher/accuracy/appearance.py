"""Noise-free images as the matcher weighs them, and how well one landmark's image imitates another's.

The best imitation by another class is sought over distance and side.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.one_frequency import phases_of
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MAY_RETURN_COVERAGE, MUST_RETURN_COVERAGE, SURELY, counts
from phasemark.render import Background, Renderer, Sensor, Views, phasor_to_range_m, predicted_range_std
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.view import VIEW_FIELDS

_STEP_M = 1e-4
_SHIFT_M = np.arange(-0.04, 0.041, 0.02)
_TURN_RAD = np.radians(np.arange(0.0, 360.0, 10.0))
_STEPS = 3
_LONGEST_STEP = np.array([0.02, math.radians(8.0)])


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
    may, must : bool
        Where light may return, and where it must.
    sensor : Sensor
    """

    range_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    slope: NDArray[np.float64]
    may: NDArray[np.bool_]
    must: NDArray[np.bool_]
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
        """Render some rows of views, or all; where a background is, all that returns light may and must."""
        sensor = renderer.sensor
        n = len(views)

        def phasors(moved: Views) -> NDArray[np.complex128]:
            return renderer.render_views(moved, background=background, rows=rows).phasor.reshape(n, -1)

        image = renderer.render_views(views, background=background, rows=rows)
        s = image.phasor.reshape(n, -1)
        intensity, coverage = image.intensity.reshape(n, -1), image.coverage.reshape(n, -1)
        seen = counts(s, intensity, sensor)
        std = predicted_range_std(np.abs(s), intensity, sensor)
        slopes = []
        for name in parameters:
            columns = {key: getattr(views, key) for key in VIEW_FIELDS}
            ends = [phasors(Views(**{**columns, name: columns[name] + side * _STEP_M})) for side in (1, -1)]
            turn = (ends[0] - ends[1]) / (2 * _STEP_M)
            power = np.where(s != 0, np.abs(s) ** 2, 1.0)
            slopes.append(sensor.metres_per_radian * (s.conj() * turn).imag / power)
        return cls(
            np.where(s != 0, phasor_to_range_m(np.where(s != 0, s, 1.0), sensor), 0.0),
            np.divide(n_frames, std**2, out=np.zeros(std.shape), where=seen),
            np.stack(slopes, axis=1) if slopes else np.zeros((n, 0, s.shape[1])),
            np.where(background is None, coverage >= MAY_RETURN_COVERAGE, s != 0),
            counts(s, intensity, sensor, SURELY) & ((background is not None) | (coverage > MUST_RETURN_COVERAGE)),
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
        weight = np.where(other.may, self.weight, 0.0)
        residual = wrap_difference_m(self.range_m - other.range_m, self.sensor)
        penalty = DISAGREEMENT * ((returned & ~other.may) | (~returned & other.must)).sum(axis=-1)
        cost = (weight * residual**2).sum(axis=-1) + penalty
        weighted = weight[..., None, :] * other.slope
        gradient = (weighted * residual[..., None, :]).sum(axis=-1)
        return cost, gradient, weighted @ np.swapaxes(other.slope, -1, -2)

    def __getitem__(self, which: slice | NDArray[np.integer]) -> Appearance:
        """Return some of the views; a single one is broadcast against others."""
        light = self.may[which], self.must[which]
        return Appearance(self.range_m[which], self.weight[which], self.slope[which], *light, self.sensor)


def least_cost(
    truth: Appearance,
    place: NDArray[np.float64],
    images: Callable[[NDArray[np.float64], Sequence[str]], Appearance],
    limited: Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """Return the least cost of imitations of true frames along Gauss–Newton steps over distance and side, (n,).

    Parameters
    ----------
    truth : Appearance
    place : (n, 2) float64
        Distance and side of the first imitation of each.
    images : callable (place, parameters)
        Returns the imitations at some places, with slopes by these parameters.
    limited : callable (place, step)
        Returns where a step may lead.
    """
    least = np.full(len(place), np.inf)
    for step in range(_STEPS + 1):
        parameters = ("distance_m", "delta_rad") if step < _STEPS else ()
        cost, gradient, information = truth.imitated_by(images(place, parameters))
        least = np.minimum(least, cost)
        if parameters:
            place = limited(place, np.einsum("nij,nj->ni", np.linalg.pinv(information), gradient))
    return least


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
    own = np.array([truth[k : k + 1].imitated_by(truth[k : k + 1])[0][0] for k in range(len(views))])
    columns = [_as_another(truth, views, other, n_frames, background) for other in others.values()]
    found = np.stack(columns, axis=1) if columns else np.zeros((len(views), 0))
    return np.asarray(np.maximum(found - own[:, None], 0.0))


def _as_another(
    truth: Appearance, views: Views, other: Renderer, n_frames: int, background: Background | None
) -> NDArray[np.float64]:
    """Return the least cost of each true frame as another landmark, (n,)."""
    n = len(views)
    starts = 2
    place = np.empty((n, starts, 2))
    others = [getattr(views, key) for key in VIEW_FIELDS if key != "delta_rad"]
    for distance, *rest in np.unique(others, axis=1).T:
        members = np.flatnonzero((np.transpose(others) == [distance, *rest]).all(axis=1))
        shift, side = (grid.ravel() for grid in np.meshgrid(_SHIFT_M, _TURN_RAD, indexing="ij"))
        grid = Views.broadcast(distance + shift, side, *rest)
        images = Appearance.of(other, grid, (), None, n_frames, background=background)
        for k in members:
            best = np.argsort(truth[k : k + 1].imitated_by(images)[0])[:starts]
            place[k] = np.stack([grid.distance_m[best], grid.delta_rad[best]], axis=1)
    whose = np.repeat(np.arange(n), starts)

    def seen_at(at: NDArray[np.float64], parameters: Sequence[str]) -> Appearance:
        moved = replace(views[whose], distance_m=at[:, 0], delta_rad=at[:, 1])
        return Appearance.of(other, moved, parameters, None, n_frames, background=background)

    def limited(at: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        return at + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP)

    least = least_cost(truth[whose], place.reshape(-1, 2), seen_at, limited)
    return np.asarray(least.reshape(n, starts).min(axis=1))
