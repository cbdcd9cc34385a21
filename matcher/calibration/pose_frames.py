"""Frames of known poses: which belong to each, and one filtered frame of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.filters.filtered_frames import FilteredFrames, assumed_std_m
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.render import Frames

Explained = Literal["auto", "ranges", "reported", "phasors"]
"""What a calibration may explain."""


def frames_of_poses(frames: Sequence[Frames], poses: KnownPoses) -> list[Frames]:
    """Assign frames to each pose.

    Parameters
    ----------
    frames : sequence of Frames
        What was read from each file, in order: one position a pose; or one position whose frames belong to all poses
        in turn, `KnownPoses.frames` each or all the same number.
    poses : KnownPoses
        Known poses of the camera.

    Returns
    -------
    list of Frames
        One position each, as many as poses.

    Raises
    ------
    UsageError
        The numbers do not fit.
    """
    positions = [one[k : k + 1] for one in frames for k in range(len(one))]
    n = len(poses)
    if len(positions) == n:
        if poses.frames is not None:
            for k, (own, stated) in enumerate(zip(positions, poses.frames, strict=True)):
                if own.n_frames != stated:
                    raise UsageError(f"{poses.where(k)}: 'frames' says {stated}, but there are {own.n_frames}")
        return positions
    if len(positions) != 1:
        raise UsageError(f"there are {n} poses, but frames of {len(positions)} positions: each pose needs its own")
    whole = positions[0]
    total = whole.n_frames
    counts = poses.frames
    if counts is None:
        if total % n:
            raise UsageError(
                f"{total} frames cannot be shared among {n} poses alike: give each pose a file of its own, or a column"
                " 'frames' with the number of each"
            )
        counts = np.full(n, total // n)
        _refuse_other_stamps(whole, poses, total // n)
    if counts.sum() != total:
        raise UsageError(f"the poses claim {counts.sum()} frames in all, but there are {total}")
    ends = np.cumsum(counts)
    return [whole.some_frames(int(end - count), int(end)) for count, end in zip(counts, ends, strict=True)]


def _refuse_other_stamps(whole: Frames, poses: KnownPoses, count: int) -> None:
    """Refuse poses whose stamps are within the frames of others, if each has a number of them in turn."""
    if whole.time_s is None or poses.time_s is None:
        return
    times = whole.time_s.reshape(-1, count)
    among = (times[:, 0] <= poses.time_s[:, None]) & (poses.time_s[:, None] <= times[:, -1])
    for k, other in np.argwhere(among & ~np.eye(len(poses), dtype=np.bool_)).tolist():
        raise UsageError(
            f"{poses.where(k)}: its stamp is among the frames of {poses.where(other)} if each has {count} of them: give"
            " a column 'frames' with the number of each"
        )


def filter_poses(frames: Sequence[Frames], on: Explained = "auto") -> FilteredFrames:
    """Filter the frames of each pose: the mean phasor where phasors will be compared, else the Kalman filter.

    Parameters
    ----------
    frames : sequence of Frames
        One position each, of one camera; they may differ in number.
    on : {"auto", "ranges", "reported", "phasors"}
        As for :func:`~phasemark.matcher.calibrate`.

    Returns
    -------
    FilteredFrames
        As many positions.
    """
    lit = all(one.amplitude_e is not None and one.intensity_e is not None for one in frames)
    several = len(frames[0].sensor.frequencies_hz) > 1
    coherent = on == "phasors" or (on == "auto" and lit and frames[0].sensor.kind == "phase" and not several)
    parts = [phasor_mean(one) if coherent else kalman_filter(one) for one in frames]
    # frames without amplitudes of one pose from which their scatter is a better judge of noise than the noise law
    frames_for_scatter = 10
    return FilteredFrames.joined(
        [
            _with_known_noise(part) if one.n_frames < frames_for_scatter else part
            for part, one in zip(parts, frames, strict=True)
        ]
    )


def _with_known_noise(frames: FilteredFrames) -> FilteredFrames:
    """Replace noise that few frames told by their scatter by what the camera's law says of a surface of albedo 0.8."""
    if not frames.std_from_scatter:
        return frames
    law = assumed_std_m(np.nan_to_num(frames.range_m, nan=1.0), frames.sensor)
    std = np.where(frames.n_effective > 0, law / np.sqrt(np.maximum(frames.n_effective, 1.0)), np.nan)
    return replace(frames, std_m=std, std_from_scatter=False)
