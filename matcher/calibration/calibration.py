"""Calibration of a camera's mounting from frames of a landmark taken at known positions.

:func:`calibrate` finds the mounting (pitch, roll, height, bearing, field of view, range offset, from amplitudes the
landmark's albedo, and from a moving camera the delay of its stamps) under which filtered frames are most likely, with
its covariance, a test of the fit, and sentences on numbers that these poses cannot determine.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np
import trimesh

from phasemark import UsageError
from phasemark.data.progress import Progress, counter
from phasemark.matcher.calibration.judgement import cause_of_refusal, doubts_about, likely_cause
from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd
from phasemark.matcher.calibration.mounting import HALF_ANGLES, MOUNTING_NAMES, Mounting, check_names
from phasemark.matcher.calibration.pose_frames import Explained
from phasemark.matcher.calibration.problem import AstrayError, Problem
from phasemark.matcher.calibration.recording_fit import solve_recording
from phasemark.matcher.calibration.result import Calibration, concluded
from phasemark.matcher.calibration.still_fit import solve_still
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.one_frequency import OneFrequency
from phasemark.matcher.pixel_agreement import MIN_RETURNS
from phasemark.render import Background, Sensor


def calibrate(
    mesh: trimesh.Trimesh,
    frames: FilteredFrames | Sequence[FilteredFrames],
    poses: KnownPoses | Sequence[KnownPoses],
    *,
    free: Sequence[str] | None = None,
    fixed: Sequence[str] = (),
    start: Mounting | None = None,
    albedo: float = 0.8,
    on: Explained = "auto",
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
    frames : FilteredFrames or sequence of FilteredFrames
        One for each pose; their sensor is the camera before the calibration. For phasors best from
        :func:`~phasemark.matcher.phasor_mean`. Of a moving camera several recordings may be given: each then has small
        errors of its own in range offset, bearing, pitch, roll and delay, whose sizes are estimated too.
    poses : KnownPoses or sequence of KnownPoses
        Known poses of the camera; of several recordings in their order. Where they state no tilt, it is that of the
        frames.
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
    on : {"auto", "ranges", "reported", "phasors"}
        "auto": phasors where the frames have amplitude and intensity. Of several modulation frequencies the unwrapped
        ranges. "reported": ranges as the chip of a direct sensor with a [histogram] table makes them, of the nearest
        surface of each zone; zones that a landmark fills in part then count, whatever stands behind it.
    background : Background, optional
        What stands behind; a pose's own `wall_m` replaces its wall. With `bounces`, on ranges of still poses, light
        that bounces is computed at the mounting that is assumed and again at the one found; the albedo of the floor is
        estimated if its standard deviation is positive. Without a background, where more than a few pixels return
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
        `moving`, unless the delay alone is free.
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
    first, *others = _recordings(frames, poses, moving)
    camera = first[0].sensor
    one = OneFrequency(camera, "combined") if len(camera.frequencies_hz) > 1 else None
    recorded = moving or bool(zones) or on == "reported"
    bounces = background is not None and bool(background.bounces)
    if bounces and recorded:
        raise UsageError("light that bounces takes still poses, ranges as measured and no offsets of zones")
    quantity = _quantity(first[0], "ranges" if bounces and on == "auto" else on, recorded)
    if bounces and quantity == "phasors":
        raise UsageError("light that bounces takes 'on' = ranges")
    sensor = camera if one is None else one.frames(first[0]).sensor
    if zones and sensor.kind != "direct":
        raise UsageError("offsets of zones belong to sensors of 'kind' = 'direct'")
    behind = background is not None or first[1].wall_m is not None
    if on == "reported" and (sensor.histogram is None or behind):
        raise UsageError(
            "'on' = reported goes with a direct sensor that has a [histogram] table, and takes what stands behind the"
            " landmark for unknown: leave walls and floors out"
        )
    lit = quantity == "phasors" or behind
    usual_renderings = 400  # of all poses: what a progress bar reckons with
    names = _names(free, fixed, sensor, lit and not bounces, moving, recorded, background)
    if zones is None:  # a delay alone leaves what a calibration found of the zones
        zones = moving and names != ("delay",)
    problem_of = partial(
        Problem,
        mesh,
        assumed=_assumed(start, sensor, albedo, background),
        names=names,
        on=quantity,
        background=background,
        reports_z=sensor.quantity == "z" if reports_z is None else reports_z,
        zones=zones and sensor.kind == "direct",
        workers=workers,
        rendered=counter(progress, usual_renderings * (1 + len(others))),
        one=one,
        chip=on == "reported",
        moving=moving,
    )
    if others and names == ("delay",):
        raise UsageError("each recording has a delay of its own: with free=delay give one recording at a time")
    _refuse_twice([own for own, _ in (first, *others)])
    each = [problem_of(own if one is None else one.frames(own), known) for own, known in (first, *others)]
    problem = replace(each[0], others=tuple(each[1:]))
    try:
        solution = solve_recording(problem) if recorded else solve_still(problem, pose_std)
    except UsageError as error:
        cause = cause_of_refusal(problem) if recorded or isinstance(error, AstrayError) else ""
        raise UsageError(f"{error}{cause}") from None
    doubts = doubts_about(solution)
    cause = likely_cause(solution, doubts) if doubts else ""
    return concluded(solution, tuple(doubt.clause for doubt in doubts), cause)


def _recordings(
    frames: FilteredFrames | Sequence[FilteredFrames], poses: KnownPoses | Sequence[KnownPoses], moving: bool
) -> list[tuple[FilteredFrames, KnownPoses]]:
    """Return the frames of each recording with its poses; refuse what does not go together."""
    measured = [frames] if isinstance(frames, FilteredFrames) else list(frames)
    known = [poses] if isinstance(poses, KnownPoses) else list(poses)
    if len(measured) != len(known) or not measured:
        raise UsageError(f"there are {len(measured)} recordings, but poses of {len(known)}: each needs its own")
    if len(measured) > 1 and not moving:
        raise UsageError("several recordings are of a moving camera: give moving=True, or the poses as one file")
    for k, one in enumerate(measured[1:], 2):
        if one.sensor != measured[0].sensor:
            raise UsageError(f"recording {k} is of another sensor than the first")
    return [(own, _tilted(poses, own, moving)) for own, poses in zip(measured, known, strict=True)]


def _refuse_twice(recordings: Sequence[FilteredFrames]) -> None:
    """Refuse recordings that share frames: their errors are not independent."""
    chance = 0.1  # share of the frames of the shorter one that may be equal by chance
    each = [{own.tobytes() for own in one.range_m if np.isfinite(own).sum() >= MIN_RETURNS} for one in recordings]
    for (j, one), (k, other) in itertools.combinations(enumerate(each, 1), 2):
        if len(one & other) > chance * min(len(one), len(other)):
            raise UsageError(f"recordings {j} and {k} have {len(one & other)} frames in common: give each frame once")


def _tilted(poses: KnownPoses, frames: FilteredFrames, moving: bool) -> KnownPoses:
    """Return poses that state no tilt with that of their frames, if these state one."""
    tilt_rad = frames.tilt_rad
    if tilt_rad is None or poses.are_tilted:
        return poses
    if moving and frames.time_s is not None and poses.time_s is not None:
        known, first = np.unique(frames.time_s, return_index=True)
        tilt_rad = np.stack([np.interp(poses.time_s, known, own[first]) for own in tilt_rad.T], axis=1)
    if len(tilt_rad) != len(poses):  # refused elsewhere
        return poses
    return replace(poses, pitch_rad=tilt_rad[:, 0].copy(), roll_rad=tilt_rad[:, 1].copy())


def _quantity(frames: FilteredFrames, on: Explained, recorded: bool) -> ResidualKind:
    """Return the quantity that is compared; refuse phasors where only ranges can be."""
    if on not in get_args(Explained):
        raise UsageError(f"'on' must be {', '.join(get_args(Explained)[:-1])} or phasors, got {on!r}")
    several = len(frames.sensor.frequencies_hz) > 1
    if several and on == "phasors":
        raise UsageError(
            "a calibration with several modulation frequencies takes 'on' = ranges: phasors of the frequencies wrap"
            " apart, and one range offset turns each by another angle"
        )
    if recorded and on == "phasors":
        raise UsageError("'on' must be auto or ranges for a moving camera or offsets of zones, got 'phasors'")
    has_light = frames.amplitude_e is not None and frames.intensity_e is not None and frames.sensor.kind == "phase"
    if on == "auto":
        return "phasors" if has_light and not recorded and not several else "ranges"
    return "phasors" if on == "phasors" else "ranges"


def _names(
    free: Sequence[str] | None,
    fixed: Sequence[str],
    sensor: Sensor,
    lit: bool,
    moving: bool,
    recorded: bool,
    background: Background | None,
) -> tuple[str, ...]:
    """Return the names of the free parameters; refuse those that these frames cannot tell."""
    lens = sensor.lens
    floor = background is not None and background.estimates_floor_albedo
    told = {"delay": moving, "floor_albedo": floor}
    usual = tuple(name for name in MOUNTING_NAMES if told.get(name, True))
    names = usual if free is None else check_names(free, "'free'", lens)
    if "delay" in names and not moving:
        raise UsageError("the delay takes a moving camera: give moving=True, and time stamps of frames and poses")
    if "floor_albedo" in names and not floor:
        raise UsageError("the albedo of the floor takes bounces and a positive floor_albedo_std of the background")
    if recorded and free is not None and "albedo" in names:
        raise UsageError("the albedo cannot be free for a moving camera or with offsets of zones: give fixed=albedo")
    left = {*check_names(fixed, "'fixed'", lens), *(() if lens is None else HALF_ANGLES)}
    if recorded or (free is None and not lit):
        left.add("albedo")
    names = tuple(name for name in names if name not in left)
    if not names:
        raise UsageError("nothing is free: there is nothing to calibrate")
    if "albedo" in names and not lit:
        raise UsageError(
            "the albedo takes amplitudes, or a wall or floor behind off which no light bounces: ranges alone do not"
            " tell it"
        )
    return names


def _assumed(start: Mounting | None, sensor: Sensor, albedo: float, background: Background | None) -> Mounting:
    """Return the initial guess of the mounting, with the lens of the sensor unless it states its own.

    The albedo of the floor is that of the background.

    Raises
    ------
    UsageError
        Its lens is of another kind than that of the sensor, or not for this image.
    """
    if start is None:
        start = Mounting.of_sensor(sensor, albedo)
    if background is not None:
        start = replace(start, floor_albedo=background.floor_albedo)
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
