"""Problem and solution of a calibration: the two ends that fits of still and of moving cameras share."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd
from phasemark.matcher.calibration.mounting import Mounting
from phasemark.matcher.calibration.mounting_model import CalibrationModel
from phasemark.matcher.calibration.pose_track import LONGEST_GAP_S, PoseTrack
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState
from phasemark.matcher.filters.stamps import spread_stamps, stamp_jitter
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.matcher.pixel_agreement import MIN_RETURNS
from phasemark.render import Background, Sensor

FEWEST_POSES = 3
"""Minimum number of poses. Fewer suffice if fewer parameters are free."""
MOST_FRAMES = 800
"""Frames that enter, of all recordings; more are thinned evenly."""


class AstrayError(UsageError):
    """A descent led to where no camera can be: frames and poses do not belong together."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Frames at known poses, and everything that is assumed of them.

    Parameters
    ----------
    mesh : trimesh.Trimesh
    frames : FilteredFrames
        One for each pose, or with `track` in the order of time.
    poses : KnownPoses
    assumed : Mounting
    names : tuple of str
        What is free.
    on : {"ranges", "phasors"}
    background : Background, optional
    reports_z : bool
    zones : bool
        Whether the offsets of zones and the noise law of a direct sensor are estimated.
    workers : int
    rendered : callable
        Called each time all poses have been rendered.
    one : OneFrequency, optional
        How a camera of several modulation frequencies became that of the frames.
    chip : bool
        Whether ranges are explained as the chip of a direct sensor reports them.
    track : PoseTrack, optional
        Of a moving camera.
    others : tuple of Problem
        Further recordings of the camera, which share the mounting but for small differences.
    moving : bool
        Whether poses go with frames by time.
    asked : Problem, optional
        Of a problem with `track`, the one with all frames and the poses as read.
    """

    mesh: trimesh.Trimesh
    frames: FilteredFrames
    poses: KnownPoses
    assumed: Mounting
    names: tuple[str, ...]
    on: ResidualKind
    background: Background | None
    reports_z: bool
    zones: bool
    workers: int
    rendered: Callable[[], None]
    one: OneFrequency | None
    chip: bool = False
    track: PoseTrack | None = None
    others: tuple[Problem, ...] = ()
    moving: bool = False
    asked: Problem | None = None

    @property
    def recordings(self) -> tuple[Problem, ...]:
        """All recordings, this one first."""
        return (replace(self, others=()), *self.others)

    @property
    def common(self) -> tuple[str, ...]:
        """Names of free parameters common to all recordings: a delay is a fact of the two clocks of each."""
        return tuple(name for name in self.names if name != "delay" or not self.others)

    def changed(self, change: Callable[[Problem], Problem]) -> Problem:
        """Return the problem with a change of every recording."""
        first, *others = map(change, self.recordings)
        return replace(first, others=tuple(others))

    @property
    def sensor(self) -> Sensor:
        """The camera before the calibration."""
        return self.frames.sensor

    def model(self) -> CalibrationModel:
        """Return the model of the frames under any mounting."""
        shared = ("mesh", "sensor", "poses", "background", "reports_z", "workers", "rendered", "track", "one", "chip")
        own = {name: getattr(self, name) for name in shared}
        return CalibrationModel(**own, albedo=self.assumed.albedo, stamp_s=self.frames.time_s)

    def poses_with(self, delay_s: float) -> KnownPoses:
        """Return the poses of the frames of this recording; those of a moving camera at their stamps plus a delay."""
        if self.track is None or self.frames.time_s is None:
            return self.poses
        times = self.frames.time_s + delay_s
        place = tuple(f"pose at {time:.3f} s" for time in times)
        return KnownPoses.of_views(self.track.at(times)[0], place=place, time_s=times)

    def by_time(self, most_frames: int = MOST_FRAMES) -> tuple[Problem, list[str]]:
        """Return the problem with poses by time and the frames that have one, and notes on what was left out."""
        frames = self.frames
        if self.poses.wall_m is not None:
            raise UsageError("'wall_m' belongs to still poses: leave it out for a moving camera")
        if frames.time_s is None:
            raise UsageError(
                "the frames have no time stamps: a moving camera takes a recording with a column t_ms or t_s"
            )
        track = PoseTrack.of(self.poses)
        stamps = spread_stamps(frames.time_s)
        _, same, counts = np.unique(stamps, return_inverse=True, return_counts=True)
        unclear = (counts[same] > 1) | (stamps < np.maximum.accumulate(stamps))
        delay = self.assumed.delay_s
        # longest delay that is estimated, seconds: frames nearer to a gap between poses are left out
        delay_reach_s = 0.3
        reach = max(delay_reach_s, abs(delay)) if "delay" in self.names else 0.0
        known = track.known(stamps + delay - reach, stamps + delay + reach)
        index = np.flatnonzero(~unclear & known & (returns_of(frames) >= MIN_RETURNS))
        index = index[np.argsort(stamps[index], kind="stable")]
        if len(index) < max(FEWEST_POSES, len(self.names)):
            raise UsageError(
                f"{len(index)} of {len(frames)} frames have a pose at their time: frames are stamped from"
                f" {stamps.min():.6g} to {stamps.max():.6g} s and poses from {track.pieces[0][0]:.6g} to"
                f" {track.pieces[-1][1]:.6g} s; are both in one clock and in the unit of their column?"
            )
        gap = f"frames were left out, for no poses within {LONGEST_GAP_S:g} s of each other surround them"
        counted = {
            "frames got a time of their own in a gap beside their repeated stamps": (stamps != frames.time_s).sum(),
            "poses were left out, for their stamps repeat or run backwards": track.dropped,
            "frames were left out, for their stamps repeat or run backwards": unclear.sum(),
            gap: (~known & ~unclear).sum(),
        }
        notes = [f"{n} {words}." for words, n in counted.items() if n]
        if len(index) > most_frames:
            notes.append(f"Of {len(index)} frames {most_frames} entered, evenly spaced.")
            index = index[np.linspace(0, len(index) - 1, most_frames).round().astype(int)]
        track = replace(track, jitter_s=max(track.jitter_s, stamp_jitter(frames.time_s)))
        timed = replace(self, frames=replace(frames, time_s=stamps)[index], track=track, asked=self)
        return replace(timed, poses=timed.poses_with(delay)), notes


def returns_of(frames: FilteredFrames) -> NDArray[np.int64]:
    """Return the number of pixels that returned at each position, (n,)."""
    return np.asarray((frames.state == PixelState.RETURN).reshape(len(frames), -1).sum(axis=1))


@dataclass(frozen=True, eq=False, kw_only=True)
class Fitted:
    """Fields that a solution and the calibration made of it share; the latter documents them."""

    covariance: NDArray[np.float64]
    covariance_from: str
    chi2: float
    dof: int
    p_value: float
    pose_shift: NDArray[np.float64]
    pose_chi2: NDArray[np.float64]
    residual_m: NDArray[np.float64]
    residual_before_m: NDArray[np.float64]
    range_std_m: NDArray[np.float64]
    notes: tuple[str, ...]
    held_out_m: tuple[float, float] = (math.nan, math.nan)
    left_out: float = 0.0
    own: tuple[Mapping[str, tuple[float, float]], ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Solution(Fitted):
    """Result of a fit, beside the fields of :class:`Fitted`.

    Parameters
    ----------
    problem : Problem
        What was solved: of a moving camera with the frames that have a pose.
    theta : (22,) float64
        Mounting, in the order of :data:`~phasemark.matcher.calibration.mounting.ALL_NAMES`.
    use : (K, pixels) bool
        Which pixels count.
    edges : bool
        Whether pixels that see the landmark in part may count.
    frames_left_out : tuple of float
        Of each recording, share of the frames of which more than half of the pixels that see the landmark have no
        weight.
    sensor_fields : mapping of str to value
        Fields of the sensor that were estimated beside the mounting.
    tilt_std_rad : (2,) float64
        By how much the tilts stated are off, pitch and roll.
    pose_std : PoseStd, optional
        Errors of poses that were said to be exact, estimated from residuals that are more than noise.
    """

    problem: Problem
    theta: NDArray[np.float64]
    use: NDArray[np.bool_]
    edges: bool
    frames_left_out: tuple[float, ...] = ()
    sensor_fields: Mapping[str, object] = field(default_factory=dict)
    tilt_std_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    pose_std: PoseStd | None = None


def in_image(values: NDArray[np.float64], use: NDArray[np.bool_], sensor: Sensor) -> NDArray[np.float64]:
    """Return values of pixels, (K, pixels), as images (K, rows, cols); NaN where a pixel does not count."""
    return np.where(use, values, np.nan).reshape(-1, sensor.rows, sensor.cols)


def rms(values: NDArray[np.float64]) -> float:
    """Return the root mean square; NaN of nothing."""
    return math.sqrt(float((values**2).mean())) if values.size else math.nan
