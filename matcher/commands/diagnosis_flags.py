"""A diagnosis of a refused frame in the words of the command line."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from phasemark.data.commands.options import FrameReading

if TYPE_CHECKING:
    from phasemark.matcher.diagnosis.diagnose import Change, Diagnosis


_IN_FLAGS = {
    "on": "{refine}--on {0}",
    "quantity": "--quantity {0}",
    "invalid_means": "--invalid-means {0}",
    "half_angle_deg": "a bank of a sensor file with half_angle_h_deg = {0[0]:.4g}, half_angle_v_deg = {0[1]:.4g}"
    " (phasemark calibrate makes one)",
    "bearing_offset_deg": "a bank of a sensor file with bearing_offset_deg = {0:.3g}, or the camera turned",
    "distance_m": "phasemark bank build --distance with a grid that has {0:.2f} m",
}
"""Options that make a change, which depend on its value alone."""


def diagnosis_text(diagnosis: Diagnosis, reading: FrameReading, nearest: bool, bearing_fixed: bool) -> str:
    """Return a diagnosis in one line that names options, given those of a command that it depends on."""
    return diagnosis.message(lambda change: _flags(change, reading, nearest, bearing_fixed))


def _flags(change: Change, reading: FrameReading, nearest: bool, bearing_fixed: bool) -> str:
    """Return the options that make one change."""
    from phasemark.data.measured.recording import METRES_PER_UNIT

    value = change.value
    refine = "--method refine " if nearest else ""
    turned = reading.rotate in (90, 270)  # mirrored before it is turned: left and right become top and bottom
    if change.parameter == "method":
        return refine.strip()
    if change.parameter == "free":
        names = [name.removesuffix("_rad").removesuffix("_m") for name in value[2:]]
        instead = " instead of --fix bearing" if bearing_fixed and "bearing" in names else ""
        return refine + " ".join(f"--free {name}" for name in names) + instead
    if change.parameter == "background":
        if isinstance(value, str):
            return f"{refine}--{value}-background"
        if value is None:
            return f"{refine}without --wall and --floor".strip()
        planes = ((f"--{name}", getattr(value, f"{name}_m")) for name in ("wall", "floor"))
        return refine + " ".join(f"{option} {metres:.4f}" for option, metres in planes if metres is not None)
    if change.parameter in ("flip_h", "flip_v"):
        return _flip((change.parameter == "flip_h") != turned, reading)
    if change.parameter == "rotate":
        angle = (reading.rotate + value) % 360
        return f"--rotate {angle}" if angle else "without --rotate"
    if change.parameter == "invalid_means" and reading.invalid_means == value:
        return "frames that flag them so"
    if change.parameter == "unit_factor":
        scale = None if reading.unit is None else METRES_PER_UNIT[reading.unit] * value
        right = next((name for name, metres in METRES_PER_UNIT.items() if scale and math.isclose(metres, scale)), None)
        return f"a unit {value:g} times as large as the file states" if right is None else f"--unit {right}"
    return _IN_FLAGS[change.parameter].format(value, refine=refine)


def _flip(horizontal: bool, reading: FrameReading) -> str:
    """Return the option that mirrors the frames once more."""
    option = "--flip-h" if horizontal else "--flip-v"
    return f"without {option}" if (reading.flip_h if horizontal else reading.flip_v) else option
