"""Sentences about a calibration: what its poses do not tell, what trades for what, and what to add."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.calibration.known_poses import KnownPoses, PoseStd
from phasemark.matcher.calibration.mounting import PARAMETERS, named
from phasemark.render.integral.rounding import error_text
from phasemark.render.sensor.lens_fields import TERMS

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]

_WELL = 0.05
"""And below which what it trades with does not matter: 3 arc minutes, half a millimetre."""
_TRADES = 0.95
"""Correlation from which two numbers are said to trade."""
_ALIKE = 1.3
"""Largest over smallest distance, below which poses stand at one distance."""
_BEARINGS_RAD = math.radians(3.0)
_MOST_NAMED = 3
_ALIKE_AT_ONE_DISTANCE = (("pitch", "height"), ("range_offset", "half_angle_h", "half_angle_v", "fx", "fy"))
"""What looks the same at one distance but for what landmark and light are known to be."""
_BY_DISTANCE = {"pitch", "height", "range_offset", "half_angle_h", "half_angle_v", "fx", "fy"}
_BY_BEARING = {"roll", "bearing", "half_angle_h", "fx"}


def advice(names: Sequence[str], poses: KnownPoses) -> str:
    """Suggest poses that would make some parameters observable."""
    hints = []
    near, far = float(poses.distance_m.min()), float(poses.distance_m.max())
    if set(names) & _BY_DISTANCE and far < _ALIKE * near:
        where = f"{near:.3g} m" if far - near < 5e-3 else f"{near:.3g} to {far:.3g} m"
        hints.append(f"all are at one distance ({where}): add some 1.5 times as far or more")
    if set(names) & _BY_BEARING and np.ptp(poses.bearing_rad) < _BEARINGS_RAD:
        hints.append(
            "all have the landmark at one place between left and right: add some with a bearing of a few degrees"
        )
    if set(names) & set(TERMS):
        hints.append(
            "a lens shows where the image is far from its middle: add some with the landmark near the corners of the"
            " image, with bearings to both sides and heights above and below"
        )
    if not hints:
        hints.append("add poses at other distances and sides, and with the landmark off the image's middle")
    fixed = " or ".join(f"fixed={name}" for name in names[:2])
    return f"{'; '.join(hints)}; or state what is known and give {fixed}"


def observability_notes(free: Sequence[str], covariance: _Float, scale: _Float, poses: KnownPoses) -> list[str]:
    """Note which numbers are poorly known, and which pairs are correlated.

    Parameters
    ----------
    free : sequence of str
    covariance : (p, p) float64
    scale : (p,) float64
        Natural units.
    poses : KnownPoses
    """
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    notes = []
    poorly = 0.5  # natural units (1°, 1 cm, 0.1): a standard deviation from which a number is called poorly known
    poor = [name for name, s in zip(free, std / scale, strict=True) if s > poorly]
    pairs = [
        (free[i], free[j], float(correlation[i, j]))
        for i in range(len(free))
        for j in range(i + 1, len(free))
        if abs(correlation[i, j]) > _TRADES
    ]
    for name in poor:
        parameter = PARAMETERS[name]
        error = error_text(parameter.shown * float(std[free.index(name)]))
        value = f"± {error}{' ' if parameter.unit in ('mm', 'px') else ''}{parameter.unit}"
        others = [b if a == name else a for a, b, _ in pairs if name in (a, b)]
        trades = f", for it trades with the {named(others)}" if others else ""
        notes.append(f"The {parameter.title} is poorly known, {value}{trades}: {advice([name, *others], poses)}.")
    told = {name for pair in pairs for name in pair[:2]} | set(poor)
    alike = poses.distance_m.max() < _ALIKE * poses.distance_m.min()
    if alike:
        for group in _ALIKE_AT_ONE_DISTANCE:
            names = [name for name in group if name in free]
            if len(names) > 1 and group[0] in names and not told & set(names):
                notes.append(
                    f"The {named(names)} are distinguished only because the landmark's shape and brightness are assumed"
                    f" to be exact: {advice(names, poses)}."
                )
    well = {name for name, s in zip(free, std / scale, strict=True) if s < _WELL}
    for a, b, rho in pairs:
        if a not in poor and b not in poor and (alike or not {a, b} <= well):
            notes.append(
                f"The {PARAMETERS[a].title} and the {PARAMETERS[b].title} trade for one another (correlation"
                f" {rho:.3f}): {advice([a, b], poses)}."
            )
    return notes


def pose_std_text(errors: PoseStd) -> str:
    """Return the errors of poses with their units."""
    heading, delta = np.degrees([errors.heading_rad, errors.delta_rad])
    return f"{1e3 * errors.position_m:.3g} mm in place, {heading:.2g}° in heading, {delta:.2g}° in δ"


def pose_std_note(estimated: PoseStd) -> str:
    """Say which errors of the poses were found from the residuals."""
    return (
        "With exact poses the residuals are more than noise. The poses were taken to be uncertain, by what the"
        f" residuals say: {pose_std_text(estimated)} (state yours with pose_std=…)."
    )


def misfit_notes(excess: float, p_value: float, poses: KnownPoses, chi2_share: _Float) -> list[str]:
    """Say that the model does not fit, and name the poses that fit far worse than the others.

    Parameters
    ----------
    excess : float
        χ² over what noise leaves.
    p_value : float
    poses : KnownPoses
    chi2_share : (K,) float64
        χ² of each over its residuals; 0 where it has none.
    """
    notes = [
        f"The model does not fit: χ² is {excess:.3g} times what noise leaves (p = {p_value:.2g}): are landmark,"
        " background and units right, and are the poses as exact as stated?"
    ]
    told = chi2_share[chi2_share > 0]
    wrong_pose = 4.0  # χ² of a pose's residuals over the median of all poses, from which it is named
    limit = wrong_pose * max(float(np.median(told)), 1.0) if told.size else math.inf
    odd = [int(k) for k in np.argsort(-chi2_share) if chi2_share[k] > limit]
    if odd and len(odd) <= len(poses) / 2:
        shown = "; ".join(f"{poses.where(k)} (χ² a residual: {chi2_share[k]:.3g})" for k in odd[:_MOST_NAMED])
        more = f" and {len(odd) - _MOST_NAMED} more" if len(odd) > _MOST_NAMED else ""
        notes.append(f"Some poses fit far worse than the others; were they measured and recorded right? {shown}{more}.")
    return notes


def unused_notes(edges: bool, poses: KnownPoses, count: NDArray[np.int64]) -> list[str]:
    """Note that edges of the landmark were left out, and poses of which no pixel counts.

    Parameters
    ----------
    edges : bool
        Whether they count.
    poses : KnownPoses
    count : (K,) int64
        Residuals of each pose.
    """
    notes = []
    if not edges:
        notes.append(
            "Something returns beside the landmark and no background=… or wall_m says what: pixels at the landmark's"
            " edges were left out, which tell most."
        )
    unseen = np.flatnonzero(count == 0)
    if unseen.size:
        where = poses.where(int(unseen[0]))
        notes.append(f"{unseen.size} of {len(poses)} poses tell nothing: no pixel counts, first at {where}.")
    return notes


def untold_notes(untold: Sequence[str]) -> list[str]:
    """Note which parameters a recording leaves as they were assumed."""
    if not untold:
        return []
    return [
        f"The {named(untold)} {'are' if len(untold) > 1 else 'is'} not told by these frames and as assumed, within"
        " the standard deviations shown."
    ]


def recording_notes(use: _Bool, left_out: float, systematic: _Float, *, in_file: bool) -> list[str]:
    """Note how many pixels disagreed, and which errors noise does not explain.

    Parameters
    ----------
    use : (K, pixels) bool
    left_out : float
        Share of the pixels that disagreed.
    systematic : (5,) or (7,) float64
        Standard deviations of pose errors: distance, δ, bearing, height, time; pitch and roll of poses that state them.
    in_file : bool
        Whether they become those of the sensor file.
    """
    notes = [
        f"{int(use.sum())} pixels of {int(use.any(axis=1).sum())} frames counted; {100 * left_out:.1f} % of those that"
        " should see the landmark disagreed with it and were left out."
    ]
    few = 8  # pixels of a frame, of which tilt, bearing and distance take three
    median = int(np.median(use.sum(axis=1)[use.any(axis=1)]))
    if median <= few:
        notes.append(f"Half of the frames count by {median} pixels or fewer: their errors are those of the result.")
    texts = ("{:.2g} mm in distance", "{:.2g}° in δ", "{:.2g}° in bearing", "{:.2g} mm in height", "{:.2g} ms in time")
    level, tilt = np.split(systematic, [len(texts)])
    shown = level * [1e3, math.degrees(1), math.degrees(1), 1e3, 1e3]
    parts = [text.format(size) for text, size in zip(texts, shown, strict=True) if size > 0]
    if parts:
        notes.append(
            f"Beyond noise, poses and ranges disagree by {', '.join(parts)} (standard deviations)"
            f"{': systematic errors of the sensor file' if in_file else ''}."
        )
    if tilt.any():
        pitch, roll = np.degrees(tilt)
        notes.append(
            f"The tilts stated are off by {pitch:.2g}° in pitch and {roll:.2g}° in roll (standard deviations)."
        )
    return notes
