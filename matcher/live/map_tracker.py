"""A rig among walls, from frame to frame: from the last accepted pose, and in the whole map where there is none."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.live.tracker import Located, step_between
from phasemark.matcher.locate import Locator, RigRecording, simulated_recording
from phasemark.matcher.locate.plane import relative_pose
from phasemark.matcher.locate.recording import (
    FEWEST_COLUMNS,
    FEWEST_TO_STICK,
    HELD_S,
    has_moved,
    same_depths,
)
from phasemark.matcher.sequence import Estimate


class MapTracker:
    """Follows the pose of a rig in a map.

    Parameters
    ----------
    locator : phasemark.matcher.Locator
    speed_m_s, turn_rate_rad_s : float
        How fast the robot may move from frame to frame where frames have no odometry.
    """

    delay_s = 0.0

    def __init__(self, locator: Locator, speed_m_s: float, turn_rate_rad_s: float) -> None:
        self.locator, self._rates = locator, np.array([speed_m_s, speed_m_s, turn_rate_rad_s])
        self._prior: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._stamp_s: float | None = None
        self._odometry: NDArray[np.float64] | None = None
        self._repeated: tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]] | None = None

    def locate(self, frames: RigRecording, stamp_s: float) -> Located:
        """Return the pose at the time of a frame.

        Parameters
        ----------
        frames : RigRecording
            One stop.
        stamp_s : float
            Its stamp.
        """
        step_s, jumps, note = step_between(self._stamp_s, stamp_s)
        now = None if frames.odometry is None else frames.odometry[0]
        frames, stuck = self._without_stuck(frames, stamp_s)
        is_late = bool(self.locator.rig.numbers().delay_s.any())
        if is_late and step_s > 0 and not jumps and now is not None and self._odometry is not None:
            earlier = np.concatenate([[-step_s], relative_pose(now, self._odometry)])
            frames = replace(frames, earlier=earlier[None])
        moves = frames.earlier is not None or frames.depth_m.shape[1] > 1
        if jumps:
            self._prior = None
        elif self._prior is not None and now is not None and self._odometry is not None:
            self._prior = self.locator.rig.odometry.moved(*self._prior, relative_pose(self._odometry, now))
        elif self._prior is not None:
            self._prior = self._prior[0], self._prior[1] + np.diag((self._rates * step_s) ** 2)
        self._stamp_s = stamp_s if jumps or self._stamp_s is None else max(stamp_s, self._stamp_s)
        self._odometry, expected = now, self._prior is not None
        found, self._prior = self.locator.locate_next(frames, 0, self._prior)
        others: Any = tuple((one.weight, np.array(one[:3])) for one in found.alternatives)
        known = math.isfinite(found.x_m)
        estimate = Estimate(
            found.accepted, found.reason, found.pose if known else None, found.covariance if known else None,
            others[0][0] if others else 0.0, found.accepted, poses=others,
        )  # fmt: skip
        # a frame without odometry around it shows where the robot was when its sensors saw it
        aged_s = 0.0 if moves else float(self.locator.rig.numbers().delay_s.mean())
        if aged_s and now is not None and self._prior is not None:  # the next step of the odometry begins later
            self._prior = self._prior[0], self._prior[1] + np.diag((self._rates * aged_s) ** 2)
        return Located(estimate, None, None, expected and found.accepted, note=note, aged_s=aged_s, stuck=tuple(stuck))

    def _without_stuck(self, frames: RigRecording, stamp_s: float) -> tuple[RigRecording, list[str]]:
        """Return a frame without sensors that repeat what they measured before the odometry moved, and their names."""
        depth = frames.depth_m[0, -1]
        if frames.odometry is None:
            return frames, []
        now = np.tile(np.append(frames.odometry[0], stamp_s), (len(depth), 1))
        before, times, begun = self._repeated or (np.full_like(depth, np.inf), np.zeros(len(depth), np.int64), now)
        again = same_depths(depth, before) & (np.isfinite(depth).sum(axis=1) >= FEWEST_COLUMNS)
        times, begun = np.where(again, times + 1, 1), np.where(again[:, None], begun, now)
        self._repeated = depth, times, begun
        way = now - begun
        way[:, 2] = np.remainder(way[:, 2] + math.pi, math.tau) - math.pi
        way = np.abs(way)
        stuck = (times >= FEWEST_TO_STICK) & has_moved(way) & (way[:, 3] > HELD_S)
        names = [name for name, one in zip(self.locator.rig.names, stuck, strict=True) if one]
        return (frames.without(np.broadcast_to(stuck, frames.depth_m.shape[:3])) if names else frames), names

    def warm(self) -> None:
        """Locate a simulated frame, with a start and without: kernels are there before the first frame is."""
        low_x, low_y, high_x, high_y = self.locator.model.outline.bounds_m
        middle = np.array([[(low_x + high_x) / 2, (low_y + high_y) / 2, 0.0]])
        stop = simulated_recording(self.locator.wall_map, self.locator.rig, middle, np.random.default_rng(0))
        self.locator.locate_next(stop, 0, (middle[0], np.eye(3) * 1e-2))

    def close(self) -> None:
        """Nothing runs beside."""
