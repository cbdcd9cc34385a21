"""Time stamps of recordings: those that repeat, moved to where the frames were taken."""

from __future__ import annotations

import copy
import math

import numpy as np
from numpy.typing import NDArray

from phasemark.render import Frames


def stamp_jitter(stamps_s: NDArray[np.float64]) -> float:
    """Return how far stamps are at least uncertain, standard deviation in seconds.

    Stamps that repeat are known to one period: they are uniform over it. 0 where none repeats.
    """
    steps = np.diff(np.unique(stamps_s))
    if len(steps) == 0 or len(steps) + 1 == len(stamps_s):
        return 0.0
    return float(np.median(steps)) / math.sqrt(12.0)


def spread_stamps(stamps_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move repeated stamps into the gap beside them where the gap has the length of the frames that share a stamp.

    A recorder that is busy stamps a frame late, together with the next one. The stamps are then apart by k periods, 0
    and so on, and the frames were in fact taken one period apart. Stamps beside a gap of another length stay.

    Parameters
    ----------
    stamps_s : (n,) float64
        In the order of the frames, seconds.

    Returns
    -------
    (n,) float64
    """
    steps = np.diff(stamps_s)
    starts = np.flatnonzero(np.append(True, steps != 0))
    ends = np.append(starts[1:], len(stamps_s))
    per_frame = steps[starts[1:] - 1] / (ends - starts)[1:]
    if not (per_frame > 0).any():
        return stamps_s
    period = float(np.median(per_frame[per_frame > 0]))
    out = stamps_s.copy()
    same_gap = 0.25  # share of a period by which a gap may differ from a whole number of them
    for start, end in zip(starts, ends, strict=True):
        k = end - start
        if k == 1:
            continue
        before = stamps_s[start] - stamps_s[start - 1] if start else np.inf
        after = stamps_s[end] - stamps_s[start] if end < len(stamps_s) else np.inf
        if abs(before - k * period) < same_gap * period:
            out[start:end] = stamps_s[start] - before + before / k * np.arange(1, k + 1)
        elif abs(after - k * period) < same_gap * period:
            out[start:end] = stamps_s[start] + after / k * np.arange(k)
    return out


def pose_times_s(stamps_s: NDArray[np.float64], delay_s: float) -> NDArray[np.float64]:
    """Return the time that the pose of each position belongs to: repeated stamps moved, averaged, the delay added.

    Parameters
    ----------
    stamps_s : (n, frames) float64
        Of n positions, or with one frame each of a camera that moves; in the order of the frames, seconds.
    delay_s : float
        Of the sensor, added to a stamp.

    Returns
    -------
    (n,) float64
    """
    moving = stamps_s.shape[1] == 1
    spread = spread_stamps(stamps_s[:, 0])[:, None] if moving else np.stack([spread_stamps(own) for own in stamps_s])
    return np.asarray(spread.mean(axis=1) + delay_s)


def with_tilts_when_taken(frames: Frames, delay_s: float) -> Frames:
    """Return frames of a moving camera with the tilts at the times that their poses belong to.

    A recording states the tilt at the stamp of each frame, which shows the camera where it was at stamp + delay.

    Parameters
    ----------
    frames : Frames
        One frame each, in the order of time; without stamps or tilts they stay as they are.
    delay_s : float
        Of the sensor.
    """
    if frames.time_s is None or frames.tilt_rad is None:
        return frames
    times = pose_times_s(frames.time_s, 0.0)
    known, first = np.unique(np.maximum.accumulate(times), return_index=True)
    taken = copy.copy(frames)
    taken.tilt_rad = np.stack(
        [np.interp(times + delay_s, known, own[first]) for own in frames.tilt_rad[:, 0].T], axis=-1
    )[:, None]
    return taken
