"""Covariances of answers for frames during which the camera or the scene moved: they hold how far the view went."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.matcher.estimate.acceptance import Rules, with_parts
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.residuals import range_slopes
from phasemark.matcher.match import Match, Matches, views_of
from phasemark.matcher.matcher import Matcher
from phasemark.matcher.recordings.stillness import motion_test, unwrapped_alike
from phasemark.render import Frames, Renderer

_PARTS, _FALSE_ALARM = 5, 1e-3
"""Parts that the frames of a position are matched in, and the probability of that where nothing moved."""
_COSINES, _FEWEST_FRAMES = 8, 5
"""Of time, in which slow motion is looked for, two or three swings; and frames below which they say next to nothing."""


def with_motion_spread(
    matcher: Matcher,
    frames: Frames,
    filter_frames: Callable[[Frames], FilteredFrames],
    filtered: FilteredFrames,
    matches: Matches,
) -> Matches:
    """Return answers whose covariances hold how far the view moved while their frames were taken.

    Where a test of the pixels finds motion, or one of the views that the frames show, parts of the frames in a row are
    matched, too, and the covariance grows by the scatter of their views about the answer, less their own noise. An
    answer is refused as "undetermined" if it no longer is within the tolerance, and as a "poor fit" if fewer than two
    parts show its class.

    *Views.* What the ranges of a frame differ by from their mean is a step of the view by least squares, linear about
    the answer, and whitened. At rest every cosine of time has the same share of these steps (the discrete cosine
    transform is orthogonal); slow motion is in the first ones. Their share over that of the others is F, and the level
    of the noise is not needed. A landmark of few pixels before much that stays moves few pixels, but all of its view.

    Parameters
    ----------
    matcher : Matcher
        On frames, not on what a direct sensor counts.
    frames : Frames
        n positions.
    filter_frames : callable
    filtered : FilteredFrames
        Its result.
    matches : Matches
        Of these positions.
    """
    p_value = motion_test(frames).p_value
    moved = np.minimum(p_value, _of_views(matcher, frames, filtered, matches)) < _FALSE_ALARM / 2
    return Matches(
        [
            _with_spread(matcher, frames[k : k + 1], filter_frames, match) if moved[k] and match.accepted else match
            for k, match in enumerate(matches)
        ]
    )


def _of_views(matcher: Matcher, frames: Frames, filtered: FilteredFrames, matches: Matches) -> NDArray[np.float64]:
    """Return the p-value of the slow motion of the views that single frames show, (n,); 1 where they cannot tell."""
    p_value = np.ones(len(frames))
    known = [k for k, match in enumerate(matches) if match.accepted and match.covariance is not None]
    if frames.n_frames < _FEWEST_FRAMES:
        return p_value
    for name in sorted({matches[k].class_name or "" for k in known}):
        mesh = matcher.bank.mesh(name)
        renderer = Renderer(mesh, frames.sensor, albedo=float(mesh.metadata["albedo"]))
        for k in (k for k in known if matches[k].class_name == name):
            slope = _range_slopes(renderer, matches[k], matcher.free)
            ranges = unwrapped_alike(frames[k : k + 1])[0].reshape(frames.n_frames, -1)
            p_value[k] = _slow_p_value(_whitened_steps(ranges, filtered.std_m[k].ravel(), slope))
    return p_value


def _range_slopes(renderer: Renderer, match: Match, free: Sequence[str]) -> NDArray[np.float64]:
    """Return how the ranges of all pixels change with the free parameters of an answer, (p, pixels)."""
    behind = None if match.background is None else replace(match.background, bounces=0)
    image, slope = renderer.render_with_slopes(views_of([match]), free, background=behind)
    phasor = image.phasor.reshape(1, -1)
    first = slope.reshape(len(free), -1, phasor.size)[None, :, 0]  # of several modulation frequencies
    return np.asarray(range_slopes(phasor, first, renderer.sensor.by_frequency[0])[0])


def _whitened_steps(
    ranges: NDArray[np.float64], std_m: NDArray[np.float64], slope: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return least-squares steps of the view from the mean of the frames to each, in units of equal noise, (n, p)."""
    valid = np.isfinite(ranges)
    mean = ranges.sum(axis=0, where=valid) / np.maximum(valid.sum(axis=0), 1)
    weighted = slope * np.divide(1.0, std_m**2, out=np.zeros(std_m.shape), where=std_m > 0)
    values, vectors = np.linalg.eigh(weighted @ slope.T)
    told = values > 1e-9 * values[-1]
    return np.asarray(np.where(valid, ranges - mean, 0.0) @ weighted.T @ (vectors[:, told] / np.sqrt(values[told])))


def _slow_p_value(steps: NDArray[np.float64]) -> float:
    """Return the p-value of what the first cosines of time have of steps (n, p), by F and Bonferroni."""
    n, p = steps.shape
    count = np.arange(1, min(_COSINES, (n - 1) // 2) + 1)[:, None]
    cosines = np.cos(np.pi / n * count * (np.arange(n) + 0.5)) * math.sqrt(2 / n)
    slow, whole = np.square(cosines @ steps).cumsum(axis=0), np.square(steps).sum(axis=0)
    # along each axis, and along all together
    slow, whole = np.column_stack([slow, slow.sum(axis=1)]), np.append(whole, whole.sum())
    rest, axes = whole - slow, np.append(np.ones(p), p)
    if not (p and (rest > 0).all()):
        return 1.0
    ratio = slow / count / (rest / (n - 1 - count))
    return float(slow.size * special.fdtrc(count * axes, (n - 1 - count) * axes, ratio).min())


def _with_spread(
    matcher: Matcher, frames: Frames, filter_frames: Callable[[Frames], FilteredFrames], match: Match
) -> Match:
    ends = np.linspace(0, frames.n_frames, min(_PARTS, frames.n_frames) + 1).astype(int).tolist()
    off, noise = [], []
    for start, stop in pairwise(ends):
        one = matcher.match(filter_frames(frames.some_frames(start, stop)))[0]
        if one.class_name == match.class_name and one.reason in ("", "undetermined"):
            turn = math.remainder(one.delta_rad - match.delta_rad, math.tau / match.symmetry)
            one = replace(one, delta_rad=match.delta_rad + turn)
            off.append([getattr(one, name) - getattr(match, name) for name in matcher.free])
            if one.covariance is not None:
                noise.append(one.covariance - sum(one.systematic.values()))
    fewest = 2
    if len(off) < fewest:
        return replace(match, accepted=False, reason="poor fit")
    known, spread = match.covariance is not None, np.transpose(off) @ off / len(off)
    if noise:
        size = np.sqrt(np.mean(noise, axis=0).diagonal())
        excess, axes = np.linalg.eigh((spread - np.mean(noise, axis=0)) / np.outer(size, size))
        spread = np.outer(size, size) * ((axes * np.maximum(excess, 0.0)) @ axes.T)
    rules = Rules.of_bank(matcher.bank, matcher.free, matcher.false_alarm, matcher.tolerance_m, matcher.tolerance_rad)
    found = with_parts(rules, replace(match, covariance=match.covariance + spread if known else spread), {})
    return found if known else replace(found, covariance=None)
