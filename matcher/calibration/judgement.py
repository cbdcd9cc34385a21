"""Trust in a calibration: held-out residuals, ranges in which the model holds, and the likely cause of a misfit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.calibration.mounting import ALL_NAMES, PARAMETERS, clipped, prior_std
from phasemark.matcher.calibration.mounting_model import natural_units
from phasemark.matcher.calibration.notes import pose_std_text
from phasemark.matcher.calibration.problem import Problem, Solution
from phasemark.matcher.calibration.recording_effects import TURN, own_text
from phasemark.matcher.calibration.recording_fit import RecordingFit
from phasemark.render.frames import MOST_TILT_DEG

_Change = Callable[[Problem], Problem]
_Changes = list[tuple[_Change, str]]
TRUSTED = 3.0
"""Prior standard deviations beyond which a result is not trusted."""
_MOST_FRAMES_OUT = 0.15
"""Share of the frames of a recording of which most pixels may disagree."""
_DELAY_NOTED_S, _DELAY_GAIN = 0.015, 0.8
"""A stated delay is doubted if one farther away lowers the mean square residual to that share."""
_BETTER = 0.5
"""Mean square of the residuals of an alternative, over that of what was assumed, from which it is the likely cause."""
_FITS_M = 0.02
"""Root mean square residual below which an alternative fits at all."""
_QUANTITY = "the numbers are likely {right}: give quantity={right}"
_CLOCKS = "frames likely show the pose {delay_ms:+.0f} ms from their stamp: are both in one clock? state the delay"
_HALVES = "first", "second"
_MOST_APART = {
    "range_offset": 0.025, **dict.fromkeys(("bearing", "pitch", "roll"), math.radians(5.0)), "delay": 1.0,
    TURN: math.radians(8.0),
}  # fmt: skip
"""By how much one of several recordings may differ from what they share, metres, radians, seconds: six times the usual
and more. A delay is found up to a second."""
_HARDLY_MOVES = (
    "the camera hardly moves: turn and approach faster, or state the delay with Mounting(delay_s=…) and give"
    " fixed=delay"
)
_TURNED = (
    "the landmark is turned against the axes of these poses, or their y has the other sign: state its heading by"
    " landmark_yaw_rad=…"
)
_UNEXPLAINED = (
    "no change of delay, quantity or order explains it: are the landmark and its size right, do the poses refer to the"
    " lens and the landmark's axis, and are all of one recording?"
)


class Doubt(NamedTuple):
    """Reason why a calibration cannot be trusted.

    Parameters
    ----------
    clause : str
    cause : str
        What is likely wrong where there is no other doubt; nothing where the doubt does not tell.
    sure : bool
        Whether that holds beside other doubts, too.
    """

    clause: str
    cause: str = ""
    sure: bool = False


def doubts_about(solution: Solution) -> list[Doubt]:
    """List the reasons why a calibration cannot be trusted; none for one that can be."""
    doubts = [*_doubts_of_fit(solution), *_doubts_of_recordings(solution)]
    # χ² a degree of freedom, or share of pixels that disagree, which mirrored frames or poses leave at least
    noisier, disagreeing = 1.5, 0.1
    suspicious = solution.chi2 > noisier * solution.dof or solution.left_out > disagreeing
    if not doubts and (suspicious or solution.pose_std is not None):
        stated = _asked(solution.problem)
        if _cause(stated, solution.edges, range(len(stated.recordings)), _mirrored):
            doubts.append(Doubt("frames or poses that are mirrored or turned over fit each other much better"))
    return doubts


def _doubts_of_fit(solution: Solution) -> Iterator[Doubt]:
    """Doubt numbers far from what was assumed, and fits that leave too much."""
    theta, problem = solution.theta, solution.problem
    assumed, scale = problem.assumed.vector, natural_units(problem.sensor)
    for name in problem.common:
        if name == "albedo":
            continue
        k, one = ALL_NAMES.index(name), PARAMETERS[name]
        most = TRUSTED * prior_std(name, assumed, scale)
        beyond = theta + 1e-9 * np.sign(theta[k] - assumed[k])
        if abs(theta[k] - assumed[k]) > most or clipped(beyond)[k] != beyond[k]:
            clause = (
                f"the {one.title} ran to {one.text(theta[k])}, more than {one.text(most)} from the assumed"
                f" {one.text(assumed[k])}"
            )
            yield Doubt(clause, _CLOCKS.format(delay_ms=1e3 * theta[k]) if name == "delay" else "")
    before, after = solution.held_out_m
    grew = 1.02  # factor by which held-out residuals may grow: what counting other pixels may do
    if after > grew * before:
        yield Doubt(f"the residuals of held-out frames grew from {1e3 * before:.3g} to {1e3 * after:.3g} mm (r.m.s.)")
    most_left_out = 0.5  # share of the pixels on the landmark that may disagree with the model
    if solution.left_out > most_left_out:
        yield Doubt(f"{100 * solution.left_out:.0f} % of the pixels that should see the landmark disagree with it")
    out = solution.frames_left_out
    for k, share in enumerate(out, 1):
        if share > _MOST_FRAMES_OUT:
            whose = f" of recording {k}" if len(out) > 1 else ""
            yield Doubt(f"most pixels of {100 * share:.0f} % of the frames{whose} disagree with their poses")
    no_model = 20.0  # χ² a degree of freedom beyond which a covariance that is scaled by it means nothing
    if solution.chi2 > no_model * solution.dof:
        yield Doubt(f"χ² is {solution.chi2 / solution.dof:.3g} times what noise leaves")
    # δ is left out: bodies that are nearly round hardly tell it, and its errors run to their bound
    astray_m, astray_rad, errors = 0.05, math.radians(5.0), solution.pose_std
    if errors is not None and (errors.position_m > astray_m or errors.heading_rad > astray_rad):
        yield Doubt(f"the poses would have to be off by {pose_std_text(errors)}")


def _doubts_of_recordings(solution: Solution) -> Iterator[Doubt]:
    """Doubt the delays of recordings, their poses, and whether their numbers are z or ranges."""
    problem = solution.problem
    if not problem.moving:
        return
    delays = [own["delay"][1] for own in solution.own if "delay" in own]
    if "delay" in problem.common:
        k = problem.common.index("delay")
        delays = [math.sqrt(float(solution.covariance[k, k]))]
    unknown_s = 0.05
    for k, std in enumerate(delays, 1):
        if std > unknown_s:
            which = f"recording {k}" if len(delays) > 1 else "this recording"
            clause = f"the delay cannot be determined from {which} (± {1e3 * std:.0f} ms)"
            yield Doubt(clause, _HARDLY_MOVES)
    for k, own in enumerate(solution.own, 1):
        if apart := [own_text(name, own[name][0]) for name in _apart(own)]:
            which = f"recording {k}" if problem.others else "this recording"
            clause = f"{which} differs from what is known of the camera and the poses by {', '.join(apart)}"
            yield Doubt(clause, _cause_apart(own))
    wander_m, wander_rad = 0.02, math.radians(3.0)
    distance, delta = (math.sqrt(float((solution.pose_shift[:, k] ** 2).mean())) for k in (0, 1))
    if distance > wander_m or delta > wander_rad:
        apart_by = f"{1e3 * distance:.2g} mm in distance and {math.degrees(delta):.2g}° in δ (r.m.s.)"
        yield Doubt(f"frames and poses disagree by {apart_by}")
    if (solution.tilt_std_rad > wander_rad).any():
        pitch, roll = np.degrees(solution.tilt_std_rad)
        yield Doubt(f"frames and the tilts of their poses disagree by {pitch:.2g}° in pitch and {roll:.2g}° in roll")
    if "delay" not in problem.names:
        fixed = RecordingFit(problem, edges=solution.edges)
        freed = RecordingFit(problem.changed(_with_delay), edges=solution.edges)
        with_it, without = freed.approach(), fixed.approach()
        stated = problem.assumed.delay_s
        moved = freed.delay_s(with_it) - stated
        if abs(moved) >= _DELAY_NOTED_S and freed.misfit(with_it)[0] <= _DELAY_GAIN * fixed.misfit(without)[0]:
            yield Doubt(f"frames fit much better {1e3 * moved:+.0f} ms from the delay stated, {1e3 * stated:.0f} ms")
    if problem.sensor.kind == "direct" and "range_offset" in problem.common:
        yield from _doubt_of_quantity(solution)


def _cause_apart(own: Mapping[str, tuple[float, float]]) -> str:
    """Return the likely cause of what a recording differs by alone, or nothing."""
    apart = _apart(own)
    if apart == ["delay"]:
        return _CLOCKS.format(delay_ms=1e3 * own["delay"][0])
    return _TURNED if apart == [TURN] else ""


def _doubt_of_quantity(solution: Solution) -> Iterator[Doubt]:
    """Doubt that the numbers are z, or ranges, where the other fits much better, or as well with a smaller offset."""
    stated = _asked(solution.problem)
    own = _tried(stated, solution.edges)
    large_m, as_well = 0.015, 1.5  # range offset that is suspicious, and mean square residual over that of the other
    offset = abs(own.range_offset_m)
    for change, right in _other_quantities(stated):
        other = _tried(stated.changed(change), solution.edges)
        left = abs(other.range_offset_m)
        if other.mean_square < min(_BETTER * own.mean_square, _FITS_M**2):
            misfits = [1e3 * math.sqrt(one.mean_square) for one in (other, own)]
            how = f"better, with residuals of {misfits[0]:.2g} and not {misfits[1]:.2g} mm"
        elif offset > large_m and other.mean_square < as_well * own.mean_square and left < offset / 2:
            how = f"as well, with a range offset of {1e3 * left:.0f} mm in place of {1e3 * offset:.0f} mm"
        else:
            continue
        yield Doubt(f"taken as {right} the numbers fit {how}", _QUANTITY.format(right=right), sure=True)
        return


def likely_cause(solution: Solution, doubts: Sequence[Doubt]) -> str:
    """Return the likely cause of doubts: the change of a stated value that fits best, if it fits much better."""
    cause = _cause(_asked(solution.problem), solution.edges, _suspects(solution), _alternatives)
    told = [doubt.cause for doubt in doubts if doubt.cause and (doubt.sure or len(doubts) == 1)]
    return cause or next(iter(told), _UNEXPLAINED)


def cause_of_refusal(problem: Problem) -> str:
    """Return the likely cause of frames that do not fit at all, or nothing: as a part of a sentence."""
    if problem.moving and any(one.frames.time_s is None or one.poses.time_s is None for one in problem.recordings):
        return ""
    cause = _cause(_asked(problem), None, range(len(problem.recordings)), _alternatives)
    return f"; likely cause: {cause}" if cause else ""


def _apart(own: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return which of a recording's own numbers, with their standard deviations, differ too much."""
    return [name for name, (value, _) in own.items() if abs(value) > _MOST_APART[name]]


def _suspects(solution: Solution) -> Sequence[int]:
    """Return which recordings differ much from the others, or have frames that disagree; all if none does."""
    apart = {k for k, own in enumerate(solution.own) if _apart(own)}
    apart |= {k for k, share in enumerate(solution.frames_left_out) if share > _MOST_FRAMES_OUT}
    return sorted(apart) or range(len(solution.problem.recordings))


def _cause(stated: Problem, edges: bool | None, suspects: Sequence[int], changes: Callable[[Problem], _Changes]) -> str:
    """Return the change that fits best: of several recordings of one that is suspect, and otherwise of all."""
    recordings = stated.recordings
    if len(recordings) > 1:
        each = {k: _better(recordings[k], edges, changes) for k in suspects}
        alike = len(each) == len(recordings) and len(set(each.values())) == 1
        if any(each.values()) and not alike:
            return "; ".join(f"of recording {k + 1}, {cause}" for k, cause in each.items() if cause)
    return _better(stated, edges, changes)


def _better(stated: Problem, edges: bool | None, changes: Callable[[Problem], _Changes]) -> str:
    """Return the sentence of the change that fits best and much better than what was stated; nothing if none does."""
    own = _tried(stated, edges)
    tried = [(_tried(stated.changed(change), edges), sentence) for change, sentence in changes(stated)]
    enough = 0.6 * max([own.pixels, *(found.pixels for found, _ in tried)])  # what few pixels fit is no better
    own_square = own.mean_square if own.pixels >= enough else math.inf
    good = [(found.mean_square, found, text) for found, text in tried if found.pixels >= enough]
    least = min([square for square, _, _ in good], default=math.inf)
    if stated.moving:
        alone, part = min((_tried(stated.changed(partial(_half, part=part)), edges), part) for part in _HALVES)
        much_better = 0.25  # mean square residual over that of the whole, and over that of any change of the whole
        if alone.pixels > own.pixels / 4 and alone.mean_square < min(
            much_better * min(own.mean_square, least), _FITS_M**2
        ):
            return f"the frames of the {part} half fit their poses, the others do not: are all poses of this recording?"
    if least > min(_BETTER * own_square, _FITS_M**2):
        return ""
    as_good = 2.0  # mean square residual over the least, up to which alternatives are named together
    alike = [text.format(delay_ms=1e3 * found.delay_s) for square, found, text in good if square <= as_good * least]
    return "; or ".join(dict.fromkeys(alike))


def _half(problem: Problem, part: str) -> Problem:
    which = np.array_split(np.arange(len(problem.frames)), 2)[_HALVES.index(part)]
    return replace(problem, frames=problem.frames[which])


def _asked(problem: Problem) -> Problem:
    """Return a problem as it was asked, of a moving camera with the poses as read, and the albedo not free."""
    names = tuple(name for name in problem.names if name != "albedo")
    return problem.changed(lambda one: replace(one.asked or one, names=names))


def _with_delay(problem: Problem) -> Problem:
    return replace(problem, names=(*problem.names, "delay"))


def _late(problem: Problem, delay_s: float) -> Problem:
    return replace(problem, assumed=replace(problem.assumed, delay_s=problem.assumed.delay_s + delay_s))


def _other_quantity(problem: Problem, reports_z: bool) -> Problem:
    """Return a problem whose numbers were z and were read as ranges, or the other way round."""
    frames, cosine = problem.frames, problem.sensor.axis_cosine()
    quantity = frames.range_m / cosine if reports_z else frames.range_m * cosine
    return replace(problem, frames=replace(frames, range_m=quantity), reports_z=reports_z)


def _other_quantities(problem: Problem) -> _Changes:
    """Return how the numbers may have been taken wrongly, each with what they are then.

    A camera that reports z may have them read as ranges, too.
    """
    both: _Changes = [
        (partial(_other_quantity, reports_z=True), "z"),
        (partial(_other_quantity, reports_z=False), "range"),
    ]
    return both if problem.reports_z else both[:1]


def _flipped(problem: Problem, axes: tuple[int, ...]) -> Problem:
    return replace(problem, frames=problem.frames.with_pixels(lambda values: np.flip(values, axes)))


def _in_order(problem: Problem, order: NDArray[np.integer]) -> Problem:
    return replace(problem, poses=problem.poses[order])


def _posed(problem: Problem, x: float = 1.0, y: float = 1.0, heading: float = 1.0) -> Problem:
    """Return a problem with coordinates and headings of its poses multiplied, in the landmark's frame."""
    poses = problem.poses
    turned = np.angle(np.exp(1j * (poses.delta_rad - poses.bearing_rad)))
    azimuth = np.arctan2(y * np.sin(poses.delta_rad), x * np.cos(poses.delta_rad))
    bearing = np.angle(np.exp(1j * (azimuth - heading * turned)))
    return replace(problem, poses=replace(poses, delta_rad=azimuth, bearing_rad=bearing))


def _multiplied(problem: Problem, **factors: float) -> Problem:
    """Return a problem with angles of its poses multiplied, by name; tilts stay within those that poses may have."""
    angles = {name: factor * getattr(problem.poses, name) for name, factor in factors.items()}
    most = math.radians(MOST_TILT_DEG)
    for name in angles.keys() & {"pitch_rad", "roll_rad"}:
        angles[name] = np.clip(angles[name], -most, most)
    return replace(problem, poses=replace(problem.poses, **angles))


def _mirrored(stated: Problem) -> _Changes:
    """Return how frames or poses may be mirrored or turned over, each with what would then be right."""
    return [
        (partial(_posed, y=-1, heading=-1), "angles of the poses likely have the other sign: counter-clockwise"),
        (partial(_posed, heading=-1), "headings of the poses likely have the other sign: counter-clockwise"),
        (partial(_posed, y=-1), "y of the poses, or δ, likely has the other sign"),
        (partial(_posed, x=-1), "x of the poses likely has the other sign: x_m is that of the lens"),
        (partial(_posed, x=-1, y=-1), "x and y of the poses likely have the other sign: they are those of the lens"),
        (partial(_multiplied, delta_rad=-1), "δ of the poses likely has the other sign"),
        (partial(_multiplied, bearing_rad=-1), "bearings of the poses likely have the other sign"),
        (partial(_flipped, axes=(-1,)), "images are likely mirrored: give flip_h=True"),
        (partial(_flipped, axes=(-2,)), "images are likely upside down: give flip_v=True"),
        (partial(_flipped, axes=(-2, -1)), "images are likely turned over: give rotate=180"),
    ]


def _alternatives(stated: Problem) -> _Changes:
    """Return changes of one value that was stated, each with what would then be right."""
    changes: _Changes = [
        *((change, _QUANTITY.format(right=right)) for change, right in _other_quantities(stated)),
        *_mirrored(stated),
        (partial(_posed, heading=math.degrees(1)), "headings of the poses are likely radians: heading_deg is degrees"),
    ]
    if any(one.poses.are_tilted for one in stated.recordings):
        sign = "of the poses likely has the other sign: a positive"
        changes += [
            (partial(_multiplied, pitch_rad=-1), f"pitch {sign} one looks down"),
            (partial(_multiplied, roll_rad=-1), f"roll {sign} one lowers the right side"),
            (
                partial(_multiplied, pitch_rad=math.degrees(1), roll_rad=math.degrees(1)),
                "tilts of the poses are likely radians: pitch_deg and roll_deg are degrees",
            ),
        ]
    if not stated.moving:
        order = np.arange(len(stated.poses))
        changes += [
            (partial(_in_order, order=which), sentence)
            for which, sentence in (
                (order[::-1], "the poses are likely in the reverse order of the frames"),
                (np.roll(order, 1), "each frame likely belongs to the pose before: check the order"),
                (np.roll(order, -1), "each frame likely belongs to the next pose: check the order"),
                *_exchanged(stated),
            )
        ]
    else:
        if "delay" not in stated.names:
            late = "frames likely show the pose {delay_ms:+.0f} ms from their stamp: leave the delay free"
            changes.append((_with_delay, late))
        changes += [(partial(_late, delay_s=delay_s), _CLOCKS) for delay_s in (-0.75, -0.5, -0.25, 0.25, 0.5, 0.75)]
    return changes


def _exchanged(stated: Problem) -> list[tuple[NDArray[np.integer], str]]:
    """Return orders of still poses in which two of those that fit worst are exchanged, each with its sentence."""
    suspects = 4
    fit = RecordingFit(stated)
    try:
        residual, seen = fit.seen(fit.approach())
    except UsageError:  # a pose from which nothing can be rendered
        return []
    misfit = np.where(seen, np.minimum(np.abs(np.nan_to_num(residual)), _FITS_M), 0.0).sum(axis=1)
    found: list[tuple[NDArray[np.integer], str]] = []
    for i, j in itertools.combinations(sorted(np.argsort(-misfit)[:suspects].tolist()), 2):
        order = np.arange(len(stated.poses))
        order[[i, j]] = order[[j, i]]
        found.append((order, f"two poses are likely exchanged: {stated.poses.where(i)} and {stated.poses.where(j)}"))
    return found


class _Tried(NamedTuple):
    mean_square: float
    pixels: int
    delay_s: float
    range_offset_m: float


def _tried(problem: Problem, edges: bool | None) -> _Tried:
    """Return how the best mounting no farther than what can be fits, on fewer frames than a calibration takes."""
    frames_tried = 120
    try:
        if problem.moving:
            problem = problem.changed(lambda one: one.by_time(frames_tried // len(problem.recordings))[0])
        fit = RecordingFit(problem, edges=edges)
        found = fit.approach(central=False)
    except UsageError:
        return _Tried(math.inf, 0, math.nan, math.nan)
    assumed, most = fit.assumed[fit.columns], TRUSTED * fit.prior * fit.scale
    held = found.theta.copy()
    held[fit.columns] = np.clip(held[fit.columns], assumed - most, assumed + most)
    square, count = fit.misfit(found._replace(theta=held))
    return _Tried(square, count, fit.delay_s(found), float(held[ALL_NAMES.index("range_offset")]))
