"""Refusal of frames, poses and numbers that cannot belong together, before and after a fit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.calibration.mounting import Mounting, named
from phasemark.matcher.calibration.mounting_model import CalibrationModel
from phasemark.matcher.calibration.notes import advice
from phasemark.matcher.calibration.problem import FEWEST_POSES, Problem, returns_of
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.pixel_agreement import MIN_RETURNS
from phasemark.render.phasor_images import wrap_difference_m, wrap_range_m

_UNKNOWN = 3.0
"""Standard deviation, in natural units (1°, 1 cm, 0.1), above which a parameter is not observable."""
_OUT_OF_VIEW_RAD = math.radians(5.0)
_NEARBY_M, _FEWEST_NEARBY = 0.25, 0.1
"""Residuals from which a fit can start, and the share of pixels that must have them."""
_BELONG = "do poses, landmark and frames belong together?"


def check_poses(problem: Problem) -> None:
    """Refuse frames and poses that differ in number, too few of them, and poses without returns."""
    frames, poses, names = problem.frames, problem.poses, problem.names
    if len(frames) != len(poses):
        raise UsageError(
            f"there are {len(poses)} poses, but frames of {len(frames)} positions: each pose needs its own"
        )
    needed = min(FEWEST_POSES, len(names))
    if len(poses) < needed:
        raise UsageError(
            f"too few poses: {len(poses)}, but {named(names)} take at least {needed}; ten or more at several distances"
            " and sides are better"
        )
    returned = returns_of(frames)
    if returned.min() < MIN_RETURNS:
        k = int(returned.argmin())
        raise UsageError(f"{poses.where(k)}: {returned[k]} pixels returned: was the landmark in view?")


def check_view(model: CalibrationModel, evidence: Evidence, assumed: Mounting) -> None:
    """Refuse poses from which the landmark cannot be seen, and units that cannot be right."""
    poses, seen = model.poses, evidence.seen
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
    slack_m = 0.05  # depth to which a wall or floor may cut the landmark at the initial guess of the mounting, metres
    model.check_behind(assumed.vector, slack_m)
    inside = np.flatnonzero(model.lens_within())
    if inside.size:
        k = int(inside[0])
        raise UsageError(
            f"{poses.where(k)}: the lens would be in the landmark, {poses.distance_m[k]:g} m from its axis: distances"
            " are in metres, from lens to axis"
        )
    hit = (seen.returned & ~_elsewhere(model, evidence)).any(axis=1)
    if hit.mean() < 0.5:
        nearest = np.array(
            [np.percentile(r[m], 10) if m.any() else np.nan for r, m in zip(seen.range_m, seen.returned, strict=True)]
        )
        hint = _unit_hint(float(np.nanmedian(nearest / poses.distance_m)))
        k = int(np.flatnonzero(~hit)[0])
        raise UsageError(
            f"{poses.where(k)}: the landmark should be {poses.distance_m[k]:.3g} m away, but the nearest returns are"
            f" {nearest[k]:.3g} m away{hint}"
        )


def check_ranges(model: CalibrationModel, evidence: Evidence, residual_m: NDArray[np.float64]) -> None:
    """Refuse ranges that are nowhere near those that the model expects.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
    residual_m : (K, pixels) float64
        Measured less expected ranges; NaN where the model does not see the landmark alone.
    """
    seen = np.isfinite(residual_m)
    if not seen.any():
        raise UsageError(f"no pixel sees the landmark alone and returns something: {_BELONG}")
    measured, away = evidence.seen.range_m[seen], residual_m[seen]
    expected = measured - away
    if (np.abs(measured - expected) < _NEARBY_M).mean() >= _FEWEST_NEARBY:
        return
    hint = _unit_hint(float(np.median(measured / np.maximum(wrap_range_m(expected, model.sensor), 1e-6))))
    raise UsageError(
        f"the landmark should be {np.median(expected):.3g} m away, but the ranges are {np.median(measured):.3g} m"
        f" (medians){hint or f': {_BELONG}'}"
    )


def _unit_hint(ratio: float) -> str:
    """Return the end of a sentence if measured over expected is about a power of ten; else nothing."""
    for times in (1000, 100, 10):
        for factor, word in ((1 / times, "less"), (float(times), "more")):
            if 0.6 < ratio / factor < 1.6:
                return f", about {times} times {word}: are both in the units stated?"
    return ""


def _elsewhere(model: CalibrationModel, evidence: Evidence) -> NDArray[np.bool_]:
    """Return which pixels have a range that is not near the landmark, (K, pixels)."""
    away = np.abs(wrap_difference_m(evidence.seen.range_m - model.poses.distance_m[:, None], evidence.sensor))
    beside_m = 0.3  # A return so much farther from the landmark's axis than its own size is something else.
    return np.asarray(away > model.reach_m + beside_m)


def returns_beside(model: CalibrationModel, evidence: Evidence) -> bool:
    """Return True if many pixels see something behind the landmark although no background was given."""
    # share of pixels that may return where the model has nothing, before something is taken to stand there
    far_returns = 0.02
    return bool((evidence.seen.returned & _elsewhere(model, evidence)).mean() > far_returns)


def check_enough(pixels: int, parameters: int) -> None:
    """Refuse frames of which too few pixels agree with their poses to tell anything."""
    if pixels <= parameters:
        raise UsageError(f"only {pixels} pixels agree with the poses, for {parameters} numbers: {_BELONG}")


def check_pixels(use: NDArray[np.bool_], poses: KnownPoses) -> None:
    """Refuse evidence of which no pixel counts, or at most poses none."""
    empty = np.flatnonzero(~use.any(axis=1))
    if empty.size == len(use):
        raise UsageError(f"no pixel sees the landmark and returns something: {_BELONG}")
    if empty.size > len(poses) / 2:
        raise UsageError(
            f"{poses.where(int(empty[0]))}: no pixel sees the landmark alone and returns something, nor at"
            f" {empty.size - 1} other poses: is the landmark in view, and is a wall or floor behind it stated?"
        )


def check_observable(
    information: NDArray[np.float64], free: Sequence[str], scale: NDArray[np.float64], poses: KnownPoses
) -> None:
    """Refuse poses that leave some combination of the free parameters unknown."""
    covariance = covariance_of(information, scale, weak="wide")
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if not math.sqrt(float(values[-1])) > _UNKNOWN:
        return
    weak = np.abs(vectors[:, -1])
    names = [name for name, share in zip(free, weak, strict=True) if share > 0.3 * weak.max()]
    together = "cannot be distinguished" if len(names) > 1 else "cannot be determined"
    raise UsageError(
        f"{named(names)} {together} from these poses: {advice(names, poses)}; and do they belong to these"
        " frames (their order, angles in degrees, bearings counter-clockwise)?"
    )
