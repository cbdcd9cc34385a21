"""Calibration of a camera's mounting from frames of a landmark taken at known positions.

:func:`calibrate` finds the mounting (pitch, roll, height, bearing, field of view, range offset, from amplitudes the
landmark's albedo, and from a moving camera the delay of its stamps) under which filtered frames are most likely, with
its covariance, a test of the fit, and sentences on numbers that these poses cannot determine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data.progress import Progress, counter
from phasemark.matcher.calibration.judgement import doubts_about, likely_cause
from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd
from phasemark.matcher.calibration.mounting_fit import Fit, Knowledge, Place
from phasemark.matcher.calibration.mounting_model import (
    ALL_NAMES,
    HALF_ANGLES,
    MOUNTING_NAMES,
    NAMES,
    PARAMETERS,
    CalibrationModel,
    Mounting,
)
from phasemark.matcher.calibration.notes import advice, named, observability_notes, odd_pose_notes
from phasemark.matcher.calibration.pose_errors import estimate_pose_std
from phasemark.matcher.calibration.pose_track import LONGEST_GAP_S, PoseTrack
from phasemark.matcher.calibration.recording_fit import Recorded, Recording, prior_std
from phasemark.matcher.calibration.result import Calibration
from phasemark.matcher.chi_squared import p_values_of, scatter_freedom
from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState, assumed_std_m
from phasemark.matcher.filters.kalman_filters import kalman_filter
from phasemark.matcher.filters.mean_phasor import phasor_mean
from phasemark.matcher.filters.stamps import spread_stamps, stamp_jitter
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.residuals import Evidence, ResidualKind
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.matcher.pixel_agreement import MIN_RETURNS
from phasemark.render import Background, Frames, Sensor
from phasemark.render.phasor_images import wrap_difference_m, wrap_range_m
from phasemark.render.sensor.lens_fields import DERIVED, TERMS, Lens
from phasemark.render.sensor.sensor_file import rounded

FEWEST_POSES = 3
"""Unless fewer numbers than that are free."""
_FALSE_ALARM = 0.01
"""A fit whose χ² is exceeded with less than this probability does not fit."""
_UNKNOWN = 3.0
"""Standard deviation, in natural units (1°, 1 cm, 0.1), above which a parameter is not observable."""
_POSES_FOR_ERRORS = 6
"""Fewer poses do not tell the size of their errors."""
_ROUNDS = 2
_MINIMA_COST = 50.0
"""χ² that ending in a small minimum may cost; what fits worse has other reasons."""
_SLACK_M = 0.05
"""Depth to which a wall or floor may cut the landmark at the initial guess of the mounting, metres."""
_USUAL_RENDERINGS = 400
"""Of all poses: what a progress bar reckons with."""
_FRAMES_FOR_SCATTER = 10
"""Frames without amplitudes of one pose from which their scatter is a better judge of noise than the noise law."""
_POSES_FOR_SANDWICH = 3
"""Poses for each free parameter from which their own scatter tells the covariance."""
_FAR_RETURNS = 0.02
"""Share of pixels that may return where the model has nothing, before something is taken to stand there."""
_OUT_OF_VIEW_RAD = math.radians(5.0)
_DELAY_REACH_S = 0.3
"""Longest delay that is estimated, seconds: frames nearer to a gap between poses are left out."""
_BLOCK_S, _BLOCKS = 2.0, 20
"""Length of a block of time, seconds, and the number of blocks that a short recording is cut into."""
_SHORTEST_BLOCK_S = 0.5
_MOST_FRAMES = 800
"""Frames of a recording that enter; more are thinned evenly."""
_FROM_PRIOR = 0.7
"""Standard deviation over that of the prior, from which the data are said not to tell a number."""
_DELAY_UNKNOWN_S = 0.05
_DELAY_NOTED_S, _DELAY_GAIN = 0.015, 0.8
"""A stated delay is doubted if one farther away lowers the mean square residual to that share."""
_NEARBY_M, _FEWEST_NEARBY = 0.25, 0.1
"""Residuals from which a fit can start, and the share of pixels that must have them."""
_UNITS = {
    0.001: "1000 times",
    0.01: "100 times",
    0.1: "10 times",
    10.0: "10 times",
    100.0: "100 times",
    1000.0: "1000 times",
}


def check_names(names: Sequence[str], what: str, lens: Lens | None = None) -> tuple[str, ...]:
    """Return names of parameters in their order; ``fov`` stands for both half angles, ``lens`` for all of a lens.

    Parameters
    ----------
    names : sequence of str
    what : str
        Name of the argument, for messages.
    lens : Lens, optional
        That of the camera.

    Raises
    ------
    UsageError
        A name is unknown, or means what this camera has not.
    """
    groups = {"fov": HALF_ANGLES, "lens": () if lens is None else tuple(lens.terms)}
    spelled: set[str] = set()
    for name in names:
        if name not in groups and name not in ALL_NAMES:
            raise UsageError(
                f"{what} must be among {', '.join(MOUNTING_NAMES)} and fov (both half angles), or the terms of a lens"
                f" {', '.join(TERMS)} and lens (all of them), got {name!r}"
            )
        _check_lens_name(name, what, lens)
        spelled |= set(groups.get(name, (name,)))
    return tuple(name for name in ALL_NAMES if name in spelled)


def _check_lens_name(name: str, what: str, lens: Lens | None) -> None:
    """Refuse a half angle of a camera with a lens, and a term of a lens that the camera has not."""
    if lens is None:
        if name == "lens" or name in TERMS:
            raise UsageError(
                f"{what}: {name!r} belongs to a sensor with a lens, and this one has none: give it a table [lens] in"
                " its sensor file ('phasemark sensor import CAMERA_INFO' writes one)"
            )
    elif name == "fov" or name in HALF_ANGLES:
        raise UsageError(
            f"{what}: {name!r} follows from the lens of this sensor: name its terms instead, {', '.join(lens.terms)} or"
            " lens (all of them)"
        )
    elif name in TERMS and name not in lens.terms:
        raise UsageError(
            f"{what}: the lens of this sensor has no {name!r}: it has {', '.join(lens.terms)}; state the coefficient in"
            " 'lens.distortion', 0 if it is not known"
        )


def _assumed(start: Mounting | None, sensor: Sensor, albedo: float) -> Mounting:
    """Return the initial guess of the mounting, with the lens of the sensor unless it states its own.

    Raises
    ------
    UsageError
        Its lens is of another kind than that of the sensor, or not for this image.
    """
    if start is None:
        return Mounting.of_sensor(sensor, albedo)
    if start.lens is None:
        return start if sensor.lens is None else replace(start, lens=sensor.lens)
    start.on(sensor)
    assert sensor.lens is not None
    if (start.lens.model, tuple(start.lens.terms)) != (sensor.lens.model, tuple(sensor.lens.terms)):
        raise UsageError(
            "'start' must have a lens of the model and with the number of coefficients of the sensor's,"
            f" '{sensor.lens.model}' with {len(sensor.lens.distortion)}, got '{start.lens.model}' with"
            f" {len(start.lens.distortion)}"
        )
    return start


def filter_poses(frames: Sequence[Frames], on: ResidualKind | Literal["auto"] = "auto") -> FilteredFrames:
    """Filter the frames of each pose: the mean phasor where phasors will be compared, else the Kalman filter.

    Parameters
    ----------
    frames : sequence of Frames
        One position each, of one camera; they may differ in number.
    on : {"auto", "ranges", "phasors"}
        As for :func:`calibrate`.

    Returns
    -------
    FilteredFrames
        As many positions.
    """
    lit = all(one.amplitude_e is not None and one.intensity_e is not None for one in frames)
    several = len(frames[0].sensor.frequencies_hz) > 1
    coherent = on == "phasors" or (on == "auto" and lit and frames[0].sensor.kind == "phase" and not several)
    parts = [phasor_mean(one) if coherent else kalman_filter(one) for one in frames]
    parts = [
        _with_known_noise(part) if one.n_frames < _FRAMES_FOR_SCATTER else part
        for part, one in zip(parts, frames, strict=True)
    ]

    def joined(name: str) -> NDArray[np.float64] | None:
        arrays = [getattr(part, name) for part in parts]
        return None if any(array is None for array in arrays) else np.concatenate(arrays)

    first = parts[0]
    return FilteredFrames(
        np.concatenate([part.range_m for part in parts]),
        np.concatenate([part.std_m for part in parts]),
        joined("amplitude_e"),
        joined("intensity_e"),
        np.concatenate([part.state for part in parts]),
        np.concatenate([part.n_effective for part in parts]),
        first.sensor,
        any(part.std_from_scatter for part in parts),
        joined("time_s"),
    )


def _with_known_noise(frames: FilteredFrames) -> FilteredFrames:
    """Replace noise that few frames told by their scatter by what the camera's law says of a surface of albedo 0.8."""
    if not frames.std_from_scatter:
        return frames
    law = assumed_std_m(np.nan_to_num(frames.range_m, nan=1.0), frames.sensor)
    std = np.where(frames.n_effective > 0, law / np.sqrt(np.maximum(frames.n_effective, 1.0)), np.nan)
    return replace(frames, std_m=std, std_from_scatter=False)


def calibrate(
    mesh: trimesh.Trimesh,
    frames: FilteredFrames,
    poses: KnownPoses,
    *,
    free: Sequence[str] | None = None,
    fixed: Sequence[str] = (),
    start: Mounting | None = None,
    albedo: float = 0.8,
    on: ResidualKind | Literal["auto"] = "auto",
    background: Background | None = None,
    pose_std: PoseStd | None = None,
    reports_z: bool | None = None,
    moving: bool = False,
    zones: bool | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Calibration:
    """Estimate how a camera is mounted, by maximum likelihood.

    With y the filtered ranges of all poses, or the phasors z, and f the rendered ones, the residuals are those of
    matching (PHYSICS section 7) with the variance of the noise law; what moves is not the view, which is known, but the
    camera. On ranges small minima are left for lower ones nearby. The covariance is the inverse of Jᵀ Σ⁻¹ J with slopes
    over about the standard deviations found. Where χ² says that
    the residuals are more than noise, it is the sandwich over poses, or, if there are few of them, is scaled by χ².

    Parameters
    ----------
    mesh : trimesh.Trimesh
        The landmark.
    frames : FilteredFrames
        One for each pose; their sensor is the camera before the calibration. For phasors best from
        :func:`~phasemark.matcher.phasor_mean`.
    poses : KnownPoses
        Known poses of the camera.
    free : sequence of str, optional
        What to estimate: :data:`NAMES`, and of a sensor with a lens fx, fy, cx, cy and the coefficients that it states
        (all of them: ``lens``) in place of half angles. None: all of it but the lens. On ranges the albedo is told only
        by pixels that mix the landmark with a background of known albedo, and left out where there is none.
    fixed : sequence of str
        What of that to leave as it is.
    start : Mounting, optional
        Initial guess of the mounting, and the values of what is fixed; None: what the sensor states.
    albedo : float
        Of the landmark, as assumed.
    on : {"auto", "ranges", "phasors"}
        "auto": phasors where the frames have amplitude and intensity. Of several modulation frequencies the unwrapped
        ranges.
    background : Background, optional
        What stands behind; a pose's own `wall_m` replaces its wall. Without one, where more than a few pixels return
        beside the landmark, only those that see nothing else count.
    pose_std : PoseStd, optional
        How well the poses are known; then their errors are estimated too. None: they are taken as exact, and if
        then the residuals are more than noise, the sizes of their errors are estimated as well.
    reports_z : bool, optional
        Whether the camera measures z, from which its ranges were made with the half angles it is thought to have; None:
        what the sensor says of itself.
    moving : bool
        Whether the camera moved: every frame then has a pose of its own, interpolated from `poses.time_s` at its stamp
        plus the delay, and the delay is among what can be free. On ranges.
    zones : bool, optional
        Whether to estimate the offsets of zones, the noise law and systematic errors of a direct sensor; None: with
        `moving`.
    workers : int
        Threads that render.
    progress : callable (done, total), optional
        Called with how many times all poses have been rendered, and how often they usually are.

    Returns
    -------
    Calibration

    Raises
    ------
    UsageError
        With one line: names or numbers are wrong, frames and poses do not go together, or the poses do not tell what is
        free.
    """
    one = OneFrequency(frames.sensor, "combined") if len(frames.sensor.frequencies_hz) > 1 else None
    if one is not None:
        if on == "phasors":
            raise UsageError(
                "a calibration with several modulation frequencies takes 'on' = ranges: phasors of the frequencies wrap"
                " apart, and one range offset turns each by another angle"
            )
        on, frames = "ranges", one.frames(frames)
    sensor = frames.sensor
    has_light = frames.amplitude_e is not None and frames.intensity_e is not None and sensor.kind == "phase"
    if on not in ("auto", "ranges", "phasors"):
        raise UsageError(f"'on' must be auto, ranges or phasors, got {on!r}")
    recorded = moving or bool(zones)
    if recorded and on == "phasors":
        raise UsageError("'on' must be auto or ranges for a moving camera or offsets of zones, got 'phasors'")
    if zones and sensor.kind != "direct":
        raise UsageError("offsets of zones belong to sensors of 'kind' = 'direct'")
    quantity: ResidualKind = ("phasors" if has_light and not recorded else "ranges") if on == "auto" else on
    lens = sensor.lens
    names = (MOUNTING_NAMES if moving else NAMES) if free is None else check_names(free, "'free'", lens)
    if lens is not None:
        names = tuple(name for name in names if name not in HALF_ANGLES)
    if "delay" in names and not moving:
        raise UsageError("the delay takes a moving camera: give moving=True, and time stamps of frames and poses")
    if recorded:
        if "albedo" in names and free is not None:
            raise UsageError(
                "the albedo cannot be free for a moving camera or with offsets of zones: give fixed=albedo"
            )
        names = tuple(name for name in names if name != "albedo")
    lit = quantity == "phasors" or background is not None or poses.wall_m is not None
    if free is None and not lit:
        names = tuple(name for name in names if name != "albedo")
    kept = check_names(fixed, "'fixed'", lens)
    names = tuple(name for name in names if name not in kept)
    assumed = _assumed(start, sensor, albedo)
    z = sensor.quantity == "z" if reports_z is None else reports_z
    rendered = counter(progress, _USUAL_RENDERINGS)
    if recorded:
        with_zones = zones is not False and sensor.kind == "direct"
        whole = _Job(mesh, background, assumed, names, z, with_zones, workers, rendered, one)
        return _of_camera(_from_recording(whole, frames, poses, moving), one)
    frames = _without_zones(frames)
    _check(frames, poses, names, lit)
    evidence = Evidence.from_frames(frames, quantity)
    model = CalibrationModel(
        mesh,
        sensor,
        poses,
        albedo=assumed.albedo,
        background=background,
        reports_z=z,
        workers=workers,
        rendered=rendered,
        one=one,
    )
    _check_view(model, evidence, assumed)
    edges = model.has_background or not _returns_beside(model, evidence, assumed)
    exact = pose_std is None or pose_std.exact
    noise_measured = frames.amplitude_e is not None or frames.std_from_scatter or sensor.kind == "direct"
    known = None if exact or pose_std is None else pose_std.factor(poses)
    fit = Fit(model, evidence, names, known, edges=edges, noise_measured=noise_measured)
    theta = fit.start(assumed.vector)
    images = model.images(theta, np.zeros((len(poses), 3)))
    use = fit.pixels(theta, images, cautious=True)
    _check_pixels(use, poses, evidence)
    _check_observable(fit.information(theta, use), fit, poses)
    place = fit.solve(theta, use)
    if _fit_probability(fit, place, frames, less=_MINIMA_COST) >= _FALSE_ALARM:
        place = fit.search(place)
    estimated = None
    if pose_std is None and len(poses) >= _POSES_FOR_ERRORS and _fit_probability(fit, place, frames) < _FALSE_ALARM:
        for _ in range(_ROUNDS):
            estimated = estimate_pose_std(fit.blocks(place, PoseStd(1.0, 1.0, 1.0).factor(poses)))
            fit = Fit(model, evidence, names, estimated.factor(poses), edges=edges, noise_measured=noise_measured)
            place = fit.solve(place.theta, place.use, place.shift)
    knowledge = fit.knowledge(place)
    _check_observable(knowledge.information, fit, poses)
    found = _concluded(fit, place, knowledge, frames, assumed, edges, estimated)
    held_out = _leave_one_out(fit, place, found)
    doubts = doubts_about(place.theta, assumed.vector, names, held_out, scale=model.scale)
    cause = ""
    if doubts:
        job = _Job(
            mesh, background, assumed, tuple(n for n in names if n != "albedo"), z, False, workers, rendered, one
        )
        cause = _cause(job, frames, poses, edges)
    return _of_camera(replace(found, doubts=tuple(doubts), cause=cause, held_out_m=held_out), one)


def _of_camera(found: Calibration, one: OneFrequency | None) -> Calibration:
    """Return a calibration of the camera of several frequencies that a camera of one frequency stood for."""
    if one is None:
        return found
    return replace(found, sensor=one.camera_like(found.sensor), base=one.camera)


def _leave_one_out(fit: Fit, place: Place, found: Calibration) -> tuple[float, float]:
    """Return the r.m.s. residual of each pose with the mounting assumed, and with that of all other poses.

    The second by the jackknife of the linearised problem: without pose k the mounting moves by −(H − H_k)⁻¹ g_k.
    """
    if len(fit.evidence.weight) <= FEWEST_POSES:
        return math.nan, math.nan
    linear = fit.linear(place)
    by_pose, _ = linear.gradients(place.residual, place.u)
    own = linear.pose_information()
    slope, _ = fit.model.slopes(place.theta, place.shift, fit.free, "ranges")
    slope_m = fit.evidence.sensor.metres_per_radian * slope.imag
    after = found.residual_m.reshape(len(by_pose), -1).copy()
    before = found.residual_before_m.reshape(after.shape)
    for k, gradient in enumerate(by_pose):
        step = covariance_of(linear.information - own[k], fit.scale, weak="wide") @ gradient
        after[k] += np.einsum("pr,p->r", slope_m[k], np.clip(step, -10 * fit.scale, 10 * fit.scale))
    both = np.isfinite(before) & np.isfinite(after)
    if not both.any():
        return math.nan, math.nan
    return tuple(math.sqrt(float((one[both] ** 2).mean())) for one in (before, after))  # type: ignore[return-value]


@dataclass(frozen=True)
class _Job:
    """Settings with which a recording is calibrated."""

    mesh: trimesh.Trimesh
    background: Background | None
    assumed: Mounting
    names: tuple[str, ...]
    reports_z: bool
    zones: bool
    workers: int
    rendered: Callable[[], None]
    """Called each time all poses have been rendered."""
    one: OneFrequency | None = None


def _without_zones(frames: FilteredFrames) -> FilteredFrames:
    """Take the stated offsets of zones off; the range offset stays, for it is estimated."""
    if not frames.sensor.zone_offset_m:
        return frames
    return replace(frames, range_m=frames.range_m - frames.sensor.zone_offsets)


def _track_of(frames: FilteredFrames, poses: KnownPoses, job: _Job) -> tuple[PoseTrack, FilteredFrames, list[str]]:
    """Return the poses by time, the frames that have one in the order of time, and notes on what was left out."""
    if frames.time_s is None:
        raise UsageError("the frames have no time stamps: a moving camera takes a recording with a column t_ms or t_s")
    track = PoseTrack.of(poses)
    stamps = spread_stamps(frames.time_s)
    repeated = np.isin(
        stamps, [stamp for stamp, n in zip(*np.unique(stamps, return_counts=True), strict=True) if n > 1]
    )
    backwards = stamps < np.maximum.accumulate(stamps)
    delay = job.assumed.delay_s
    reach = max(_DELAY_REACH_S, abs(delay)) if "delay" in job.names else 0.0
    known = track.known(stamps + delay - reach, stamps + delay + reach)
    returned = (frames.state == PixelState.RETURN).reshape(len(frames), -1).sum(axis=1) >= MIN_RETURNS
    index = np.flatnonzero(~repeated & ~backwards & known & returned)
    index = index[np.argsort(stamps[index], kind="stable")]
    if len(index) < max(FEWEST_POSES, len(job.names)):
        raise UsageError(
            f"{len(index)} of {len(frames)} frames have a pose at their time: frames are stamped from"
            f" {stamps.min():.6g} to {stamps.max():.6g} s and poses from {track.pieces[0][0]:.6g} to"
            f" {track.pieces[-1][1]:.6g} s; are both in one clock and in the unit of their column?"
        )
    notes = []
    for n, what in (
        (
            int((stamps != frames.time_s).sum()),
            "frames got a time of their own in a gap beside their repeated stamps",
        ),
        (track.dropped, "poses were left out, for their stamps repeat or run backwards"),
        (int((repeated | backwards).sum()), "frames were left out, for their stamps repeat or run backwards"),
        (
            int((~known & ~repeated & ~backwards).sum()),
            f"frames were left out, for no poses within {LONGEST_GAP_S:g} s of each other surround them",
        ),
    ):
        if n:
            notes.append(f"{n} {what}.")
    if len(index) > _MOST_FRAMES:
        notes.append(f"Of {len(index)} frames {_MOST_FRAMES} entered, evenly spaced.")
        index = index[np.linspace(0, len(index) - 1, _MOST_FRAMES).round().astype(int)]
    track = replace(track, jitter_s=max(track.jitter_s, stamp_jitter(frames.time_s)))
    return track, replace(frames, time_s=stamps)[index], notes


def _blocks(stamps: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the block of time of each frame."""
    span = float(stamps[-1] - stamps[0])
    length = min(_BLOCK_S, max(span / _BLOCKS, _SHORTEST_BLOCK_S))
    return np.asarray(np.floor((stamps - stamps[0]) / length), np.int64)


def _recording(
    job: _Job,
    frames: FilteredFrames,
    poses: KnownPoses,
    track: PoseTrack | None,
    edges: bool | None,
) -> Recording:
    """Set up the calibration of frames, one for each pose or by time."""
    stamps = frames.time_s
    moving = track is not None and stamps is not None
    model = CalibrationModel(
        job.mesh,
        frames.sensor,
        poses,
        albedo=job.assumed.albedo,
        background=job.background,
        reports_z=job.reports_z,
        workers=job.workers,
        rendered=job.rendered,
        track=track,
        stamp_s=stamps if moving else None,
        one=job.one,
    )
    evidence = Evidence.from_frames(frames, "ranges")
    if edges is None:
        direct = frames.sensor.kind == "direct"
        edges = model.has_background or not (direct or _returns_beside(model, evidence, job.assumed))
    block = _blocks(stamps) if moving and stamps is not None else np.arange(len(frames))
    jitter_s = track.jitter_s if track is not None else 0.0
    return Recording(
        model, evidence, job.names, job.assumed.vector, block, edges=edges, zones=job.zones, jitter_s=jitter_s
    )


def _poses_at(track: PoseTrack, times: NDArray[np.float64]) -> KnownPoses:
    """Return the poses at some times, named by them."""
    distance, delta, bearing, height = np.ascontiguousarray(track.at(times)[0].T)
    place = tuple(f"pose at {time:.3f} s" for time in times)
    return KnownPoses(distance, delta, bearing, height, place=place, time_s=times)


def _from_recording(job: _Job, frames: FilteredFrames, poses: KnownPoses, moving: bool) -> Calibration:
    """Calibrate on many poses, by time or one for each frame."""
    notes: list[str] = []
    track = None
    if not job.names:
        raise UsageError("nothing is free: there is nothing to calibrate")
    if moving:
        if poses.wall_m is not None:
            raise UsageError("'wall_m' belongs to still poses: leave it out for a moving camera")
        track, frames, notes = _track_of(frames, poses, job)
        assert frames.time_s is not None
        poses = _poses_at(track, frames.time_s + job.assumed.delay_s)
    else:
        _check(frames, poses, job.names, True)
    recording = _recording(job, frames, poses, track, None)
    if not moving:
        _check_view(recording.model, recording.evidence, job.assumed)
    _check_ranges(recording, job.assumed)
    theta, _ = recording.approach(job.assumed.vector)
    found = recording.solve(theta)
    left_out = 1 - float(found.use.sum()) / max(int(found.candidates.sum()), 1)
    std = np.sqrt(np.diag(found.covariance))
    if "delay" in job.names and std[job.names.index("delay")] > _DELAY_UNKNOWN_S:
        raise UsageError(
            f"the delay cannot be determined from this recording (± {1e3 * std[job.names.index('delay')]:.0f} ms): turn"
            " and approach faster, or state it with Mounting(delay_s=…) and give fixed=delay"
        )
    untold = [
        name for name, one in zip(job.names, std, strict=True)
        if one > _FROM_PRIOR * prior_std(name, job.assumed.vector, recording.model.scale)
    ]  # fmt: skip
    if untold:
        notes.append(
            f"The {named(untold)} {'are' if len(untold) > 1 else 'is'} not told by these frames and as assumed, within"
            " the standard deviations shown."
        )
    notes += _recording_notes(found, left_out)
    doubts = doubts_about(
        found.theta, job.assumed.vector, job.names, found.held_out_m, left_out, scale=recording.model.scale
    )
    if moving and "delay" not in job.names:
        doubts += _delay_doubts(job, frames, poses, recording, track)
    cause = _cause(job, frames, poses, recording.edges, track) if doubts else ""
    mounting = recording.model.mounting(found.theta)
    if moving and track is not None and frames.time_s is not None:
        poses = _poses_at(track, frames.time_s + mounting.delay_s)
    beside = found.residual_m - _of_pose_errors(recording, found)
    chi2 = np.where(found.use, (beside / found.std_m) ** 2, 0.0).sum(axis=1)
    dof = int(found.use.sum()) - len(job.names)
    shape = found.residual_m.shape[0], frames.sensor.rows, frames.sensor.cols
    sensor = _calibrated(frames.sensor, mounting, job.names, found.covariance)
    if job.zones:
        sensor = _with_zones(sensor, found, shape[1:])
    return Calibration(
        sensor=sensor,
        base=frames.sensor,
        mounting=mounting,
        assumed=job.assumed,
        free=job.names,
        covariance=found.covariance,
        covariance_from="noise, slow errors and weak priors (restricted maximum likelihood)",
        chi2=found.chi2,
        dof=dof,
        p_value=float(special.chdtrc(max(dof, 1), found.chi2)),
        on="ranges",
        poses=poses,
        pose_shift=found.pose_error[:, :3],
        pose_chi2=chi2,
        pose_residuals=found.use.sum(axis=1),
        residual_m=np.where(found.use, found.residual_m, np.nan).reshape(shape),
        residual_before_m=np.where(found.use, found.before_m, np.nan).reshape(shape),
        range_std_m=np.where(found.use, found.std_m, np.nan).reshape(shape),
        notes=tuple(notes),
        doubts=tuple(doubts),
        cause=cause,
        held_out_m=found.held_out_m,
        left_out=left_out,
    )


def _check_ranges(recording: Recording, assumed: Mounting) -> None:
    """Refuse ranges that are nowhere near those that the model expects."""
    images = recording.images(assumed.vector)
    seen = recording.candidates(images)
    if not seen.any():
        raise UsageError(
            "no pixel sees the landmark alone and returns something: do poses, landmark and frames belong together?"
        )
    sensor = recording.evidence.sensor
    measured = recording.evidence.seen.range_m[seen]
    expected = measured - recording.residual(images)[seen]
    if (np.abs(measured - expected) < _NEARBY_M).mean() >= _FEWEST_NEARBY:
        return
    ratio = float(np.median(measured / np.maximum(wrap_range_m(expected, sensor), 1e-6)))
    unit = next((text for factor, text in _UNITS.items() if 0.6 < ratio / factor < 1.6), None)
    hint = f", about {unit} {'more' if ratio > 1 else 'less'}: are both in the units stated?" if unit else ""
    raise UsageError(
        f"the landmark should be {np.median(expected):.3g} m away, but the ranges are {np.median(measured):.3g} m"
        f" (medians){hint or ': do poses, landmark and frames belong together?'}"
    )


def _delay_doubts(
    job: _Job, frames: FilteredFrames, poses: KnownPoses, fixed: Recording, track: PoseTrack | None
) -> list[str]:
    """Warn if another delay than the stated one fits much better."""
    freed = _recording(replace(job, names=(*job.names, "delay")), frames, poses, track, fixed.edges)
    start = job.assumed.vector
    with_it, without = freed.approach(start)[0], fixed.approach(start)[0]
    moved = float(with_it[ALL_NAMES.index("delay")]) - job.assumed.delay_s
    if abs(moved) < _DELAY_NOTED_S or freed.misfit(with_it) > _DELAY_GAIN * fixed.misfit(without):
        return []
    return [f"frames fit much better {1e3 * moved:+.0f} ms from the delay stated, {1e3 * job.assumed.delay_s:.0f} ms"]


def _of_pose_errors(recording: Recording, found: Recorded) -> NDArray[np.float64]:
    """Return the ranges that the estimated errors of the poses add, (K, pixels)."""
    _, pose = recording.slopes(found.theta)
    return np.asarray(np.einsum("ks,ksr->kr", found.pose_error, pose))


def _recording_notes(found: Recorded, left_out: float) -> list[str]:
    """Note how many pixels disagreed, and which errors noise does not explain."""
    frames = int((found.use.sum(axis=1) > 0).sum())
    notes = [
        f"{int(found.use.sum())} pixels of {frames} frames counted; {100 * left_out:.1f} % of those that should see the"
        " landmark disagreed with it and were left out."
    ]
    distance, delta, bearing, height, time = found.systematic
    parts = [
        text
        for size, text in (
            (distance, f"{1e3 * distance:.2g} mm in distance"),
            (delta, f"{math.degrees(delta):.2g}° in δ"),
            (bearing, f"{math.degrees(bearing):.2g}° in bearing"),
            (height, f"{1e3 * height:.2g} mm in height"),
            (time, f"{1e3 * time:.2g} ms in time"),
        )
        if size > 0
    ]
    if parts:
        notes.append(
            f"Beyond noise, poses and ranges disagree by {', '.join(parts)} (standard deviations): systematic errors"
            " of the sensor file."
        )
    return notes


def _with_zones(sensor: Sensor, found: Recorded, shape: tuple[int, int]) -> Sensor:
    """Return the sensor with zone offsets, noise law and systematic errors."""
    constant, shot, ambient = found.noise
    distance, delta, bearing, height, time = found.systematic
    table = tuple(tuple(row) for row in found.zone_m.reshape(shape).tolist())
    return sensor.with_(
        zone_offset_m=rounded(table),
        range_std_m=rounded(constant),
        range_shot_std_m=rounded(shot),
        range_ambient_std_m=rounded(ambient),
        systematic_distance_m=rounded(float(distance)),
        systematic_delta_deg=rounded(math.degrees(delta)),
        systematic_bearing_deg=rounded(math.degrees(bearing)),
        systematic_height_m=rounded(float(height)),
        systematic_time_s=rounded(float(time)),
    )


def _cause(job: _Job, frames: FilteredFrames, poses: KnownPoses, edges: bool, track: PoseTrack | None = None) -> str:
    """Name the likely cause of a misfit: the change of a stated value that fits much better."""

    def misfit(job: _Job, frames: FilteredFrames, poses: KnownPoses, track: PoseTrack | None) -> tuple[float, float]:
        recording = _recording(job, frames, poses, track, edges)
        theta, _ = recording.approach(job.assumed.vector)
        away = (theta - job.assumed.vector)[recording.columns] / recording.scale / recording.prior
        held = theta.copy()  # no farther than what can be
        held[recording.columns] = (
            job.assumed.vector[recording.columns] + np.clip(away, -3, 3) * recording.prior * recording.scale
        )
        return recording.misfit(held), float(theta[ALL_NAMES.index("delay")])

    def other_quantity() -> tuple[float, str]:
        cosine = frames.sensor.axis_cosine()
        changed = frames.range_m * cosine if job.reports_z else frames.range_m / cosine
        right, wrong = ("range", "z") if job.reports_z else ("z", "range")
        other = replace(job, reports_z=not job.reports_z)
        return (
            misfit(other, replace(frames, range_m=changed), poses, track)[0],
            f"the numbers are likely {right}, not {wrong}: give quantity={right}",
        )

    def free_delay() -> tuple[float, str]:
        cost, delay = misfit(replace(job, names=(*job.names, "delay")), frames, poses, track)
        return cost, f"frames likely show the pose {1e3 * delay:+.0f} ms from their stamp: leave the delay free"

    def reordered(which: NDArray[np.intp], sentence: str) -> Callable[[], tuple[float, str]]:
        return lambda: (misfit(job, frames, poses[which], None)[0], sentence)

    def mirrored() -> tuple[float, str]:
        turned = replace(poses, delta_rad=-poses.delta_rad, bearing_rad=-poses.bearing_rad)
        other = None
        if track is not None:
            other = track.mirrored()
        return misfit(job, frames, turned, other)[
            0
        ], "angles of the poses likely have the other sign: counter-clockwise"

    def flipped() -> tuple[float, str]:
        arrays = {name: getattr(frames, name)[:, :, ::-1] for name in ("range_m", "std_m", "state", "n_effective")}
        return misfit(job, replace(frames, **arrays), poses, track)[0], "images are likely mirrored: give flip_h=True"

    alternatives: list[tuple[str, Callable[[], tuple[float, str]]]] = [
        ("quantity", other_quantity), ("mirror", mirrored), ("flip", flipped),
    ]  # fmt: skip
    if track is not None and "delay" not in job.names:
        alternatives.append(("delay", free_delay))
    if track is None:
        order = np.arange(len(poses))
        alternatives += [
            ("order", reordered(order[::-1], "the poses are likely in the reverse order of the frames")),
            ("order", reordered(np.roll(order, 1), "each frame likely belongs to the pose before: check the order")),
            ("order", reordered(np.roll(order, -1), "each frame likely belongs to the next pose: check the order")),
        ]
    return likely_cause(misfit(job, frames, poses, track)[0], alternatives)


def _check(frames: FilteredFrames, poses: KnownPoses, names: tuple[str, ...], lit: bool) -> None:
    if len(frames) != len(poses):
        raise UsageError(
            f"there are {len(poses)} poses, but frames of {len(frames)} positions: each pose needs its own"
        )
    if not names:
        raise UsageError("nothing is free: there is nothing to calibrate")
    if "albedo" in names and not lit:
        raise UsageError("the albedo takes amplitudes, or a wall or floor behind: ranges alone do not tell it")
    needed = min(FEWEST_POSES, len(names))
    if len(poses) < needed:
        raise UsageError(
            f"too few poses: {len(poses)}, but {named(names)} take at least {needed}; ten or more at several distances"
            " and sides are better"
        )
    returned = (frames.state == PixelState.RETURN).reshape(len(frames), -1).sum(axis=1)
    if returned.min() < MIN_RETURNS:
        k = int(returned.argmin())
        raise UsageError(f"{poses.where(k)}: {returned[k]} pixels returned: was the landmark in view?")


def _check_view(model: CalibrationModel, evidence: Evidence, assumed: Mounting) -> None:
    """Refuse poses from which the landmark cannot be seen, and units that cannot be right."""
    poses = model.poses
    edge = max(assumed.half_angle_h_rad, assumed.half_angle_v_rad) * math.sqrt(2) + _OUT_OF_VIEW_RAD
    reach = np.arctan2(model.reach_m, poses.distance_m)
    bearing = poses.bearing_rad + assumed.bearing_rad
    out = np.flatnonzero(np.abs(bearing) - reach > edge)
    if out.size:
        k = int(out[0])
        raise UsageError(
            f"{poses.where(k)}: the landmark is not in view: it stands {math.degrees(bearing[k]):.1f}° from"
            f" the optical axis, and the image ends at {math.degrees(assumed.half_angle_h_rad):.1f}°; are heading and"
            " bearing in degrees, counter-clockwise?"
        )
    model.check_behind(assumed.vector, _SLACK_M)
    inside = np.flatnonzero(model.lens_within())
    if inside.size:
        k = int(inside[0])
        raise UsageError(
            f"{poses.where(k)}: the lens would be in the landmark, {poses.distance_m[k]:g} m from its axis: distances"
            " are in metres, from lens to axis"
        )
    _check_units(model, evidence)


def _check_units(model: CalibrationModel, evidence: Evidence) -> None:
    """Refuse ranges and poses whose distances differ by a unit."""
    poses, seen = model.poses, evidence.seen
    nearest = np.array(
        [np.percentile(r[m], 10) if m.any() else np.nan for r, m in zip(seen.range_m, seen.returned, strict=True)]
    )
    away = np.abs(wrap_difference_m(seen.range_m - poses.distance_m[:, None], evidence.sensor))
    hit = (seen.returned & (away < model.reach_m + 0.3)).any(axis=1)
    if hit.mean() < 0.5:
        ratio = float(np.nanmedian(nearest / poses.distance_m))
        unit = next((text for factor, text in _UNITS.items() if 0.6 < ratio / factor < 1.6), None)
        hint = f", about {unit} {'more' if ratio > 1 else 'less'}: are both in the units stated?" if unit else ""
        k = int(np.flatnonzero(~hit)[0])
        raise UsageError(
            f"{poses.where(k)}: the landmark should be {poses.distance_m[k]:.3g} m away, but the nearest returns are"
            f" {nearest[k]:.3g} m away{hint}"
        )


def _returns_beside(model: CalibrationModel, evidence: Evidence, assumed: Mounting) -> bool:
    """Return True if many pixels see something behind the landmark although no background was given."""
    seen = evidence.seen
    away = np.abs(wrap_difference_m(seen.range_m - model.poses.distance_m[:, None], evidence.sensor))
    return bool((seen.returned & (away > model.reach_m + 0.3)).mean() > _FAR_RETURNS)


def _check_pixels(use: NDArray[np.bool_], poses: KnownPoses, evidence: Evidence) -> None:
    counted = use.sum(axis=1)
    if counted.sum() == 0 or (counted == 0).all():
        raise UsageError(
            "no pixel sees the landmark and returns something: do poses, landmark and frames belong together?"
        )
    empty = np.flatnonzero(counted == 0)
    if empty.size > len(poses) / 2:
        raise UsageError(
            f"{poses.where(int(empty[0]))}: no pixel sees the landmark alone and returns something, nor at"
            f" {empty.size - 1} other poses: is the landmark in view, and is a wall or floor behind it stated?"
        )


def _check_observable(information: NDArray[np.float64], fit: Fit, poses: KnownPoses) -> None:
    covariance = covariance_of(information, fit.scale, weak="wide")
    scaled = covariance / np.outer(fit.scale, fit.scale)
    values, vectors = np.linalg.eigh(scaled)
    if not math.sqrt(float(values[-1])) > _UNKNOWN:
        return
    weak = np.abs(vectors[:, -1])
    names = [name for name, share in zip(fit.free, weak, strict=True) if share > 0.3 * weak.max()]
    together = "cannot be distinguished" if len(names) > 1 else "cannot be determined"
    raise UsageError(
        f"{named(names)} {together} from these poses: {advice(names, poses)}; and do they belong to these"
        " frames (their order, angles in degrees, bearings counter-clockwise)?"
    )


def _degrees_of_freedom(fit: Fit, place: Place) -> int:
    return int(place.use.sum()) * fit.evidence.per_pixel - len(fit.free)


def _fit_probability(fit: Fit, place: Place, frames: FilteredFrames, *, less: float = 0.0) -> float:
    """Return the chance of a χ² as large as that of a place less something."""
    dof = np.array([_degrees_of_freedom(fit, place)])
    return float(p_values_of(np.array([max(place.cost - less, 0.0)]), dof, scatter_freedom(frames)[:1])[0])


def _concluded(
    fit: Fit,
    place: Place,
    knowledge: Knowledge,
    frames: FilteredFrames,
    assumed: Mounting,
    edges: bool,
    estimated: PoseStd | None,
) -> Calibration:
    """Return the calibration of a fit; `estimated` are the pose errors found from the residuals, if requested."""
    model, evidence = fit.model, fit.evidence
    poses, sensor = model.poses, frames.sensor
    pose_residuals = place.use.sum(axis=1) * evidence.per_pixel
    pose_chi2 = (place.residual**2).sum(axis=1)
    dof, p_value = _degrees_of_freedom(fit, place), _fit_probability(fit, place, frames)
    covariance = covariance_of(knowledge.information, fit.scale, weak="wide")
    expected, source = float(max(dof, 1)), "the noise law"
    if frames.std_from_scatter:
        # weights that were estimated from ν + 1 frames are too large in the mean by ν / (ν − 2), and scatter themselves
        nu = max(float(np.median(frames.n_effective.reshape(len(poses), -1)[place.use])) - 1, 5.0)
        covariance = covariance * nu / (nu - 4)
        expected, source = expected * nu / (nu - 2), "the scatter of the frames"
    notes: list[str] = []
    if estimated is not None:
        notes.append(
            "With exact poses the residuals are more than noise. The poses were taken to be uncertain, by what the"
            f" residuals say: {1e3 * estimated.position_m:.2g} mm in place, {math.degrees(estimated.heading_rad):.2g}°"
            f" in heading, {math.degrees(estimated.delta_rad):.2g}° in δ (state yours with pose_std=…)."
        )
    if dof > 0 and p_value < _FALSE_ALARM:
        excess = place.cost / expected
        if len(poses) >= _POSES_FOR_SANDWICH * len(fit.free):
            plain = covariance_of(knowledge.information, fit.scale, weak="wide")
            covariance = plain @ knowledge.scatter @ plain * len(poses) / (len(poses) - len(fit.free))
            source = "the scatter of the poses (sandwich), for the residuals are more than noise"
        else:
            covariance = covariance * excess
            source += f", scaled by χ² = {excess:.3g} for each degree of freedom, for the residuals are more than noise"
        notes.append(
            f"The model does not fit: χ² is {excess:.3g} times what noise leaves (p = {p_value:.2g}): are landmark,"
            " background and units right, and are the poses as exact as stated?"
        )
        notes += odd_pose_notes(poses, pose_chi2 / np.maximum(pose_residuals, 1))
    if not edges:
        notes.append(
            "Something returns beside the landmark and no background=… or wall_m says what: pixels at the landmark's"
            " edges were left out, which tell most."
        )
    unseen = int((pose_residuals == 0).sum())
    if unseen:
        k = int(np.flatnonzero(pose_residuals == 0)[0])
        notes.append(f"{unseen} of {len(poses)} poses tell nothing: no pixel counts, first at {poses.where(k)}.")
    notes += observability_notes(fit.free, covariance, fit.scale, poses)
    mounting = model.mounting(place.theta)
    if mounting.albedo > 1 and "albedo" in fit.free:
        notes.append(
            f"An albedo of {mounting.albedo:.3g} cannot be: signal_e of the sensor is too low, or the amplitudes are"
            " not in electrons. Only their product was measured."
        )
    shape = (len(poses), sensor.rows, sensor.cols)
    before = model.images(assumed.vector, np.zeros((len(poses), 3)))
    after = evidence.sensor.metres_per_radian * np.angle(evidence.value * place.images.phasor.conj())
    thought = evidence.sensor.metres_per_radian * np.angle(evidence.value * before.phasor.conj())
    return Calibration(
        sensor=_calibrated(sensor, mounting, fit.free, covariance, estimated, poses),
        base=sensor,
        mounting=mounting,
        assumed=assumed,
        free=fit.free,
        covariance=covariance,
        covariance_from=source,
        chi2=place.cost,
        dof=dof,
        p_value=p_value,
        on=evidence.on,
        poses=poses,
        pose_shift=place.shift,
        pose_chi2=pose_chi2,
        pose_residuals=pose_residuals,
        residual_m=np.where(place.use & (place.images.phasor != 0), after, np.nan).reshape(shape),
        residual_before_m=np.where(place.use & (before.phasor != 0), thought, np.nan).reshape(shape),
        range_std_m=np.where(place.use, np.maximum(evidence.seen.weight, 1e-300) ** -0.5, np.nan).reshape(shape),
        notes=tuple(notes),
    )


def _calibrated(
    sensor: Sensor,
    mounting: Mounting,
    free: Sequence[str],
    covariance: NDArray[np.float64],
    pose_std: PoseStd | None = None,
    poses: KnownPoses | None = None,
) -> Sensor:
    """Return a sensor with its mounting and what is common to all its frames: the covariance of what was estimated.

    What an earlier calibration estimated and this one left stays, uncorrelated with the rest; not half angles beside
    terms of a lens, from which they follow.
    """
    there = _mounted(sensor, mounting, free)
    known = [name for name in free if PARAMETERS[name].field is not None]
    fields = [str(PARAMETERS[name].field) for name in known]
    unit = np.array([PARAMETERS[name].shown if PARAMETERS[name].unit == "°" else 1.0 for name in known])
    index = [list(free).index(name) for name in known]
    own = covariance[np.ix_(index, index)] * np.outer(unit, unit)
    replaced = {*fields, *(DERIVED if set(free) & set(TERMS) else ())}
    older = [k for k, name in enumerate(sensor.calibration_fields) if name not in replaced]
    n = len(fields)
    whole = np.zeros((n + len(older), n + len(older)))
    whole[:n, :n] = (own + own.T) / 2
    whole[n:, n:] = sensor.calibration_matrix[np.ix_(older, older)]
    changes: dict[str, object] = {}
    if pose_std is not None and poses is not None and sensor.kind == "direct":
        across = pose_std.position_m / float(np.median(poses.distance_m))
        changes = {
            "systematic_distance_m": rounded(pose_std.position_m),
            "systematic_delta_deg": rounded(math.degrees(math.hypot(pose_std.delta_rad, across))),
            "systematic_bearing_deg": rounded(math.degrees(math.hypot(pose_std.heading_rad, across))),
        }
    return there.with_(
        calibration_fields=(*fields, *(sensor.calibration_fields[k] for k in older)),
        calibration_covariance=rounded(tuple(tuple(row) for row in whole.tolist())),
        **changes,
    )


def _mounted(sensor: Sensor, mounting: Mounting, free: Sequence[str]) -> Sensor:
    """Return a sensor with the fields that were estimated or restated, to the digits of a sensor file."""
    there, before = mounting.on(sensor), Mounting.of_sensor(sensor, mounting.albedo)
    changed = [
        name
        for name, parameter in PARAMETERS.items()
        if parameter.field is not None and (name in free or mounting.number(name) != before.number(name))
    ]
    if sensor.lens is not None:
        changed = [name for name in changed if name not in HALF_ANGLES]
    return sensor.with_numbers(
        {field: rounded(there.number(field)) for field in (str(PARAMETERS[name].field) for name in changed)}
    )
