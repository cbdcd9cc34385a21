"""Trust in a calibration: held-out residuals, ranges in which the model holds, and the likely cause of a misfit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from phasemark.matcher.calibration.mounting import ALL_NAMES, PARAMETERS, clipped, prior_std
from phasemark.matcher.calibration.mounting_model import natural_units
from phasemark.matcher.calibration.problem import Problem, Solution
from phasemark.matcher.calibration.recording_fit import RecordingFit

TRUSTED = 3.0
"""Prior standard deviations beyond which a result is not trusted."""
_DELAY_NOTED_S, _DELAY_GAIN = 0.015, 0.8
"""A stated delay is doubted if one farther away lowers the mean square residual to that share."""
_BETTER = 0.5
"""Mean square of the residuals of an alternative, over that of what was assumed, from which it is the likely cause."""


def doubts_about(solution: Solution) -> tuple[str, ...]:
    """List the reasons why a calibration cannot be trusted, as clauses; none for one that can be."""
    doubts = []
    theta, problem = solution.theta, solution.problem
    assumed, scale = problem.assumed.vector, natural_units(problem.sensor)
    for name in problem.names:
        if name == "albedo":
            continue
        k, one = ALL_NAMES.index(name), PARAMETERS[name]
        most = TRUSTED * prior_std(name, assumed, scale)
        beyond = theta + 1e-9 * np.sign(theta[k] - assumed[k])
        if abs(theta[k] - assumed[k]) > most or clipped(beyond)[k] != beyond[k]:
            doubts.append(
                f"the {one.title} ran to {one.text(theta[k])}, more than {one.text(most)} from the assumed"
                f" {one.text(assumed[k])}"
            )
    before, after = solution.held_out_m
    grew = 1.02  # factor by which held-out residuals may grow: what counting other pixels may do
    if after > grew * before:
        doubts.append(f"the residuals of held-out frames grew from {1e3 * before:.3g} to {1e3 * after:.3g} mm (r.m.s.)")
    most_left_out = 0.5  # share of the pixels on the landmark that may disagree with the model
    if solution.left_out > most_left_out:
        doubts.append(f"{100 * solution.left_out:.0f} % of the pixels that should see the landmark disagree with it")
    if problem.track is not None and "delay" not in problem.names:
        fixed = RecordingFit(problem, edges=solution.edges)
        freed = RecordingFit(replace(problem, names=(*problem.names, "delay")), edges=solution.edges)
        with_it, without = freed.approach(), fixed.approach()
        stated = problem.assumed.delay_s
        moved = float(with_it[ALL_NAMES.index("delay")]) - stated
        if abs(moved) >= _DELAY_NOTED_S and freed.misfit(with_it) <= _DELAY_GAIN * fixed.misfit(without):
            doubts.append(f"frames fit much better {1e3 * moved:+.0f} ms from the delay stated, {1e3 * stated:.0f} ms")
    return tuple(doubts)


def likely_cause(solution: Solution) -> str:
    """Return the likely cause of a failure: the change of a stated value that fits best, if it fits much better."""
    stated = replace(solution.problem, names=tuple(name for name in solution.problem.names if name != "albedo"))
    best, cause = _BETTER * _misfit(stated, solution.edges)[0], ""
    for changed, sentence in _alternatives(stated):
        found, delay_s = _misfit(changed, solution.edges)
        if found < best:
            best, cause = found, sentence.format(delay_ms=1e3 * delay_s)
    return cause or (
        "no change of delay, quantity or order explains it: are the landmark and its size right, and do the poses refer"
        " to the lens and the landmark's axis?"
    )


def _alternatives(stated: Problem) -> list[tuple[Problem, str]]:
    """Return problems that differ from the stated one in one value, each with what would then be right."""
    frames, poses, track, names = stated.frames, stated.poses, stated.track, stated.names
    cosine, (right, wrong) = stated.sensor.axis_cosine(), ("range", "z") if stated.reports_z else ("z", "range")
    quantity = replace(frames, range_m=frames.range_m * cosine if stated.reports_z else frames.range_m / cosine)
    turned = replace(poses, delta_rad=-poses.delta_rad, bearing_rad=-poses.bearing_rad)
    flipped = {name: getattr(frames, name)[:, :, ::-1] for name in ("range_m", "std_m", "state", "n_effective")}
    changed = [
        (
            replace(stated, frames=quantity, reports_z=not stated.reports_z),
            f"the numbers are likely {right}, not {wrong}: give quantity={right}",
        ),
        (
            replace(stated, poses=turned, track=None if track is None else track.mirrored()),
            "angles of the poses likely have the other sign: counter-clockwise",
        ),
        (replace(stated, frames=replace(frames, **flipped)), "images are likely mirrored: give flip_h=True"),
    ]
    if track is None:
        order = np.arange(len(poses))
        changed += [
            (replace(stated, poses=poses[which]), sentence)
            for which, sentence in (
                (order[::-1], "the poses are likely in the reverse order of the frames"),
                (np.roll(order, 1), "each frame likely belongs to the pose before: check the order"),
                (np.roll(order, -1), "each frame likely belongs to the next pose: check the order"),
            )
        ]
    elif "delay" not in names:
        late = "frames likely show the pose {delay_ms:+.0f} ms from their stamp: leave the delay free"
        changed.append((replace(stated, names=(*names, "delay")), late))
    return changed


def _misfit(problem: Problem, edges: bool) -> tuple[float, float]:
    """Return the mean square residual (m²) and the delay (s) of the best mounting no farther than what can be."""
    fit = RecordingFit(problem, edges=edges)
    theta = fit.approach()
    assumed, most = fit.assumed[fit.columns], TRUSTED * fit.prior * fit.scale
    held = theta.copy()
    held[fit.columns] = np.clip(theta[fit.columns], assumed - most, assumed + most)
    return fit.misfit(held), float(theta[ALL_NAMES.index("delay")])
