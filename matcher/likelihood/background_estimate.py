"""Background behind the landmark, estimated from the frame's own far pixels (PHYSICS section 7).

The landmark stands in front, so what is clearly farther than the nearest surface is background. Its pixels are
explained by a wall, a plane across the line of sight, and below the horizon by a floor; on amplitudes their brightness
gives the albedo too, relative to the landmark's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.matcher.information import NATURAL_UNITS, covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence, Sums, gauss_newton_sums
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Background

CLEARLY_BEHIND_M = 0.4
"""Farther than the nearest surface by more than a landmark is deep."""
NEAREST_WALL_M = 0.05
"""Nothing nearer is taken for a wall or a floor."""
_FEWEST = 6
_FLOOR, _RECEDES, _ROUGHNESS_M = (3, 3), 1.25, 3e-3
"""A floor fills three pixels in each of three rows or more; in one row it is farther than in another by a quarter."""
_HEIGHTS = 256
"""Most heights at which a floor is tried."""
_BACKGROUND_STEP_M = 1e-3
"""Width of a difference between two places of a wall or floor."""
_LONGEST_STEP = 3.0
_FIRST_DAMPING, _LEAST_DAMPING, _HOPELESS_DAMPING = 1e-3, 1e-9, 1e5
_USUAL_ALBEDO = 0.5


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Background that one frame shows behind the landmark.

    Parameters
    ----------
    background : Background or None
        None: nothing returns from behind.
    behind : (pixels,) bool
        Which pixels see background alone, or may see some of it beside the landmark.
    pure : (pixels,) bool
        Which see background alone.
    """

    background: Background | None
    behind: NDArray[np.bool_]
    pure: NDArray[np.bool_]


def estimate_surroundings(
    frames: FilteredFrames,
    index: int = 0,
    *,
    bearing_known: bool = True,
    tilt_known: bool = True,
) -> Surroundings:
    """Estimate wall and floor behind the landmark of one frame.

    Parameters
    ----------
    frames : FilteredFrames
        Filtered frames.
    index : int
        Which of them is looked at.
    bearing_known : bool
        Whether the mount points at the landmark. Otherwise the azimuth of what is near takes its place: the wall is
        perpendicular to the line of sight, and a bearing of 4° ignored would move its two ends by 3 %.
    tilt_known : bool
        Whether pitch and roll are those of the mount. Otherwise a floor is a plane of any slope: at 2 m a pitch of 3°
        ignored would raise it by 10 cm.

    Returns
    -------
    Surroundings
        Without a background where no pixel is clearly behind.
    """
    sensor = frames.sensor
    returned = frames.state[index] == PixelState.RETURN
    ranges = np.where(returned, frames.range_m[index], np.nan)
    nothing = np.zeros(ranges.size, np.bool_)
    if returned.sum() < _FEWEST:
        return Surroundings(None, nothing, nothing)
    ray = np.moveaxis(sensor.pixel_directions(), -1, 0)
    floor_m, on_floor = _floor_in_rows(ranges, frames.std_m[index], ray) if tilt_known else (None, nothing)
    on_floor = on_floor.reshape(ranges.shape)
    forward = sensor.axis_cosine() * ranges
    standing = returned & ~on_floor
    nearest = float(np.nanpercentile(forward[standing], 5)) if standing.any() else math.inf
    far = standing & (forward > nearest + CLEARLY_BEHIND_M)
    lonely = far & _inner(far | on_floor)  # away from the landmark: not mixed
    pure = lonely if lonely.sum() >= _FEWEST else far
    if not (far | on_floor).any():
        return Surroundings(None, nothing, nothing)
    azimuth = math.radians(sensor.bearing_offset_deg)
    if not bearing_known and (standing & ~far).any():
        azimuth = float(np.arctan2(ray[1], ray[0])[standing & ~far].mean())
    facing = math.cos(azimuth) * ray[0] + math.sin(azimuth) * ray[1]
    forward = ranges * facing
    down = -ray[2]
    above = pure & (down <= 0)
    wall_m = None
    if far.any():
        wall_m = _weighted_middle(forward[above] if above.sum() >= 3 else forward[pure])
    drop = down * ranges
    short = pure & (down > 0) & (forward < (wall_m or 0.0) - 0.1)
    if floor_m is None and short.sum() >= _FEWEST:
        height = drop[short]
        if not tilt_known:
            height = height - _slope_of(height, (ray * ranges)[:2, short])
        middle = float(np.median(height))
        if middle > NEAREST_WALL_M and np.median(np.abs(height - middle)) < 0.02 * middle:
            floor_m = middle
    albedo = floor_albedo = _USUAL_ALBEDO
    if frames.amplitude_e is not None:
        # a plane whose normal is θ off the line of sight: |S| = ρ cos θ / r²
        bright = frames.amplitude_e[index] / (sensor.contrast * sensor.signal_e) * ranges**2
        albedo = _albedo_of((bright / facing)[pure & ~short])
        floor_albedo = albedo if not on_floor.any() else _albedo_of((bright / np.maximum(down, 1e-3))[on_floor])
    pure = pure | (on_floor & _inner(far | on_floor))
    far = far | on_floor
    background = Background(wall_m=wall_m, floor_m=floor_m, wall_albedo=albedo, floor_albedo=floor_albedo)
    return Surroundings(background, (far | ~_inner(~far) & returned).ravel(), pure.ravel())


def _floor_in_rows(
    ranges: NDArray[np.float64], std_m: NDArray[np.float64], ray: NDArray[np.float64]
) -> tuple[float | None, NDArray[np.bool_]]:
    """Return how far below the lens a level floor lies, and which pixels show it, (rows, cols).

    What stands upright is lower in each row below; a floor is as low in all of them, and nearer.
    """
    down = -ray[2]
    seen = np.isfinite(ranges) & (down > 0)
    drop, forward = np.where(seen, down * ranges, np.inf), ray[0] * ranges
    tolerance = 4 * down * np.nan_to_num(std_m, posinf=1e6) + _ROUGHNESS_M
    heights = np.sort(drop[seen & (drop > NEAREST_WALL_M)])
    best, on_floor = None, np.zeros(ranges.shape, np.bool_)
    for height in heights[:: max(1, len(heights) // _HEIGHTS)]:
        agrees = np.abs(drop - height) < tolerance
        rows = np.flatnonzero(agrees.sum(axis=1) >= _FLOOR[0])
        if agrees.sum() <= on_floor.sum() or len(rows) < _FLOOR[1]:
            continue
        middle = [float(np.median(forward[row][agrees[row]])) for row in rows]
        if max(middle) > _RECEDES * min(middle):
            best, on_floor = float(height), agrees
    if best is not None:
        best = _weighted_middle(drop[on_floor])
    return best, on_floor


def _albedo_of(brightness: NDArray[np.float64]) -> float:
    """Return the albedo of the pixels that see a plane alone; the usual one where none does."""
    return float(np.clip(np.median(brightness), 1e-3, 1.0)) if brightness.size else _USUAL_ALBEDO


def _slope_of(height: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what a plane through heights at places (2, n) rises from below the lens to each of them."""
    columns = np.column_stack([np.ones(len(height)), *place])
    weight = np.ones(len(height))
    plane_rounds = 5
    for _ in range(plane_rounds):  # towards the least sum of absolute residuals: pixels that are mixed are few
        root = np.sqrt(weight)
        found = np.linalg.lstsq(columns * root[:, None], height * root, rcond=None)[0]
        away = np.abs(height - columns @ found)
        weight = 1 / np.maximum(away, np.median(away) + 1e-9)
    return np.asarray(columns[:, 1:] @ found[1:])


def fit_background(
    model: RenderedModel,
    evidence: Evidence,
    class_index: int,
    view: NDArray[np.float64],
    free: Sequence[str],
    background: Background,
) -> tuple[Background, NDArray[np.float64]]:
    """Fit wall and floor together with the view of the landmark before them, starting from guesses of both.

    Levenberg–Marquardt on the residuals of matching; slopes by the background are differences of rendered images.

    Parameters
    ----------
    model : RenderedModel
    evidence : Evidence
        One frame.
    class_index : int
    view : (6,) float64
    free : sequence of str
        Which parameters of the view move.
    background : Background
        Where to start; its albedos are kept.

    Returns
    -------
    background : Background
    view : (6,) float64
    """
    columns = [VIEW.index(name) for name in free]
    place, scale = _places(background), _scales(free, background)

    def sums_at(at: NDArray[np.float64], place: NDArray[np.float64]) -> Sums | None:
        return _sums_before(model, evidence, class_index, at, free, _placed(background, place))

    at = view.copy()
    sums, damping = sums_at(at, place), _FIRST_DAMPING
    background_steps = 30
    # A step that promises to lower the whitened squared residual by less than this is not taken.
    background_settled = 0.1
    for _ in range(background_steps):
        if sums is None:
            break
        information = sums.information[0] * np.outer(scale, scale)
        held = information + np.diag(damping * np.diag(information) + 1e-9)
        step = np.linalg.solve(held, sums.gradient[0] * scale)
        step *= min(1.0, _LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        promise = float(sums.gradient[0] @ (step * scale))
        if promise < background_settled:
            break
        there = at.copy()
        there[columns] += (step * scale)[: len(columns)]
        there[0] = np.clip(there[:1], *model.limits(there[1:2]))[0]
        there_place = place + (step * scale)[len(columns) :]
        tried = sums_at(there, there_place) if (there_place > 0).all() else None
        if tried is not None and tried.cost[0] < sums.cost[0]:
            at, place, sums, damping = there, there_place, tried, max(damping * 0.1, _LEAST_DAMPING)
        else:
            damping *= 8
            if damping > _HOPELESS_DAMPING:
                break
    return _placed(background, place), at


def part_of_background(
    model: RenderedModel,
    evidence: Evidence,
    class_index: int,
    view: NDArray[np.float64],
    free: Sequence[str],
    background: Background,
    prior_std: Sequence[float],
) -> NDArray[np.float64]:
    """Return what the uncertainty of an estimated wall and floor adds to the covariance of a view, (p, p).

    Parameters
    ----------
    model, evidence, class_index, view, free, background
        As of :func:`fit_background`, at the solution.
    prior_std : sequence of float
        Of the free parameters before the frame was seen; empty where nothing is known.
    """
    p = len(free)
    sums = _sums_before(model, evidence, class_index, view, free, background)
    if sums is None:
        return np.zeros((p, p))
    information, scale = sums.information[0], _scales(free, background)
    if prior_std:
        information[range(p), range(p)] += np.array(prior_std) ** -2.0
    joint = covariance_of(information, scale, weak="none")
    return np.asarray(joint[:p, :p] - covariance_of(information[:p, :p], scale[:p], weak="none"))


def _scales(free: Sequence[str], background: Background) -> NDArray[np.float64]:
    """Return the natural units of free parameters, and of the places of wall and floor."""
    place_m = 0.1
    return np.array([*(NATURAL_UNITS[name] for name in free), *np.full(len(_places(background)), place_m)])


def _places(background: Background) -> NDArray[np.float64]:
    """Return how far the wall and the floor are, those that there are."""
    return np.array([own for own in (background.wall_m, background.floor_m) if own is not None], np.float64)


def _placed(background: Background, place: NDArray[np.float64]) -> Background:
    """Return a background with the wall and the floor elsewhere."""
    names = [name for name in ("wall_m", "floor_m") if getattr(background, name) is not None]
    return replace(background, **dict(zip(names, place.tolist(), strict=True)))


def _sums_before(
    model: RenderedModel,
    evidence: Evidence,
    class_index: int,
    view: NDArray[np.float64],
    free: Sequence[str],
    background: Background,
) -> Sums | None:
    """Return the sums of one frame with the slopes by the view and by wall and floor; None where a view is impossible.

    The slopes by wall and floor are those over a small step of each.
    """
    before, which = model.with_background(background), np.array([class_index])
    nearest, farthest = before.limits(view[1:2])
    if not nearest[0] <= view[0] <= farthest[0]:
        return None
    place = _places(background)
    beside = [_placed(background, place + step) for step in np.eye(len(place)) * _BACKGROUND_STEP_M]
    try:
        image = before.images(which, view[None], free)
        moved = [model.with_background(own).images(which, view[None], ()).phasor for own in beside]
    except UsageError:  # the landmark does not stand before this wall, or on this floor
        return None
    by_place = [(phasor - image.phasor) / _BACKGROUND_STEP_M for phasor in moved]
    slope = np.concatenate([image.slope, np.stack(by_place, axis=1)], axis=1)
    use = counts(image.phasor, image.intensity, evidence.sensor)
    return gauss_newton_sums(image.phasor, slope, evidence, np.zeros(1, np.int64), use, None)


def without_background(seen: Observation, surroundings: Sequence[Surroundings]) -> Observation:
    """Return frames as they would be with nothing behind: far pixels return nothing, those beside them are missing."""
    nothing = np.stack([own.pure for own in surroundings]) & seen.returned
    unclear = np.stack([own.behind for own in surroundings]) & ~nothing
    keep = seen.returned & ~nothing & ~unclear
    return Observation(
        np.where(keep, seen.range_m, 0.0),
        np.where(keep, seen.weight, 0.0),
        keep,
        (seen.not_returned & ~unclear) | nothing,
    )


def _inner(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels have all their neighbours in a mask."""
    padded = np.pad(mask, 1, constant_values=True)
    rows, cols = mask.shape
    return np.asarray(np.logical_and.reduce([padded[i : i + rows, j : j + cols] for i in range(3) for j in range(3)]))


def _weighted_middle(values: NDArray[np.float64]) -> float:
    """Return the mean of what lies within 5 robust σ of the median: as good as a mean, and outliers do not matter."""
    middle = float(np.median(values))
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return float(values[np.abs(values - middle) <= 5 * spread + 1e-9].mean())
