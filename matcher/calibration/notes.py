"""Sentences about a calibration: what its poses do not tell, what trades for what, and what to add."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.calibration.known_poses import KnownPoses
from phasemark.matcher.calibration.mounting_model import PARAMETERS
from phasemark.render.integral.rounding import error_text
from phasemark.render.sensor.lens_fields import TERMS

TITLES = {
    "pitch": "pitch",
    "roll": "roll",
    "height": "height",
    "bearing": "bearing",
    "half_angle_h": "horizontal field of view",
    "half_angle_v": "vertical field of view",
    "range_offset": "range offset",
    "albedo": "albedo",
    "delay": "delay",
    "fx": "focal length fx",
    "fy": "focal length fy",
    "cx": "principal point cx",
    "cy": "principal point cy",
    **{name: f"distortion {name}" for name in TERMS[4:]},
}
_POORLY = 0.5
"""Natural units (1°, 1 cm, 0.1): a standard deviation from which a number is called poorly known."""
_WELL = 0.05
"""And below which what it trades with does not matter: 3 arc minutes, half a millimetre."""
_TRADES = 0.95
"""Correlation from which two numbers are said to trade."""
_ALIKE = 1.3
"""Largest over smallest distance, below which poses stand at one distance."""
_BEARINGS_RAD = math.radians(3.0)
_WRONG_POSE = 4.0
"""χ² of a pose's residuals over the median of all poses, from which it is named."""
_MOST_NAMED = 3
_ALIKE_AT_ONE_DISTANCE = (("pitch", "height"), ("range_offset", "half_angle_h", "half_angle_v", "fx", "fy"))
"""What looks the same at one distance but for what landmark and light are known to be."""
_BY_DISTANCE = {"pitch", "height", "range_offset", "half_angle_h", "half_angle_v", "fx", "fy"}
_BY_BEARING = {"roll", "bearing", "half_angle_h", "fx"}


def named(names: Sequence[str]) -> str:
    """Put names of parameters into a list in words."""
    titles = [TITLES[name] for name in names]
    return titles[0] if len(titles) == 1 else f"{', '.join(titles[:-1])} and {titles[-1]}"


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


def observability_notes(
    free: Sequence[str], covariance: NDArray[np.float64], scale: NDArray[np.float64], poses: KnownPoses
) -> list[str]:
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
    poor = [name for name, s in zip(free, std / scale, strict=True) if s > _POORLY]
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
        notes.append(f"The {TITLES[name]} is poorly known, {value}{trades}: {advice([name, *others], poses)}.")
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
                f"The {TITLES[a]} and the {TITLES[b]} trade for one another (correlation {rho:.3f}):"
                f" {advice([a, b], poses)}."
            )
    return notes


def odd_pose_notes(poses: KnownPoses, chi2_share: NDArray[np.float64]) -> list[str]:
    """Name the poses that fit far worse than the others.

    Parameters
    ----------
    poses : KnownPoses
    chi2_share : (K,) float64
        χ² of each over its residuals; 0 where it has none.
    """
    told = chi2_share[chi2_share > 0]
    if not told.size:
        return []
    limit = _WRONG_POSE * max(float(np.median(told)), 1.0)
    odd = [int(k) for k in np.argsort(-chi2_share) if chi2_share[k] > limit]
    if not odd or len(odd) > len(poses) / 2:
        return []
    shown = "; ".join(f"{poses.where(k)} (χ² a residual: {chi2_share[k]:.3g})" for k in odd[:_MOST_NAMED])
    more = f" and {len(odd) - _MOST_NAMED} more" if len(odd) > _MOST_NAMED else ""
    return [f"Some poses fit far worse than the others; were they measured and recorded right? {shown}{more}."]
