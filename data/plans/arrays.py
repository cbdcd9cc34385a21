"""Arrays of a bank and of a frame set: dimensions, types and units, known before any file is made."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.generated_scene import LABEL_BYTES
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.render import Sensor


class Array(NamedTuple):
    """Array of a file: its dimensions, the type of its values, their unit, and its long name."""

    dims: tuple[str, ...]
    kind: str
    units: str
    long_name: str


GroupName = Literal["lower", "upper", "full"]
VIEW_DIMS: dict[GroupName, tuple[str, ...]] = {
    "lower": ("distance", "delta"),
    "upper": ("landmark_class", "distance"),
    "full": ("landmark_class", "distance", "delta"),
}
PHASOR_DIMS = ("frequency", "row", "col", "iq")
IMAGE_ARRAYS = {
    "phasor": Array(PHASOR_DIMS, "<f4", "1", "phasor S_k of the landmark alone"),
    "intensity": Array(("row", "col"), "<f4", "1", "mean amplitude of the landmark alone"),
    "coverage": Array(("row", "col"), "<f4", "1", "share of the pixel that sees the landmark"),
}
"""Arrays of a bank, by one image."""
LAYOUT_GROUPS: dict[str, tuple[GroupName, ...]] = {"factored": ("lower", "upper"), "full": ("full",)}


def group_rows(group: GroupName, sensor: Sensor) -> tuple[int, int]:
    """Return first and stop of the image rows that a group holds."""
    return {"lower": sensor.lower_rows, "upper": sensor.upper_rows, "full": (0, sensor.rows)}[group]


_OF_FREQUENCY = ("frame", "frequency", "row", "col")
FREQUENCY_FIELDS = ("frequency_range", "frequency_amplitude", "frequency_intensity", "frequency_flags")
"""What a frame set of several modulation frequencies holds of each; `range` is then unwrapped, and `amplitude` and
`intensity` are those at the first."""
_OF_TARGET = ("frame", "row", "col", "target")
TARGET_FIELDS = ("target_distance", "target_sigma", "target_signal", "target_status")
HISTOGRAM_FIELDS = ("histogram", *TARGET_FIELDS)
"""What a frame set holds of a direct sensor's histograms; `range` is then that of the nearest target."""
FRAME_FIELDS: dict[str, Array] = {
    "range": Array(("frame", "row", "col"), "<f4", "m", "range along the ray, NaN where invalid"),
    "amplitude": Array(("frame", "row", "col"), "<f4", "e-", "amplitude per phase image"),
    "intensity": Array(("frame", "row", "col"), "<f4", "e-", "intensity per phase image"),
    "flags": Array(("frame", "row", "col"), "|u1", "1", "why a pixel is not valid, 0 where it is"),
    "taps": Array(("frame", "phase", "tap", "row", "col"), "<f4", "e-", "what each tap reported"),
    "range_shot": Array(("frame", "row", "col"), "<f4", "m", "range with shot noise alone, NaN where invalid"),
    "frequency_range": Array(_OF_FREQUENCY, "<f4", "m", "range at each frequency, wrapped, NaN where invalid"),
    "frequency_amplitude": Array(_OF_FREQUENCY, "<f4", "e-", "amplitude per phase image at each frequency"),
    "frequency_intensity": Array(_OF_FREQUENCY, "<f4", "e-", "intensity per phase image at each frequency"),
    "frequency_flags": Array(_OF_FREQUENCY, "|u1", "1", "why a frequency's range is not valid, 0 where it is"),
    "histogram": Array(("frame", "row", "col", "bin"), "<u4", "1", "photons counted in each bin of a zone"),
    "target_distance": Array(_OF_TARGET, "<f4", "m", "what the chip reports, nearest first, NaN without a target"),
    "target_sigma": Array(_OF_TARGET, "<f4", "m", "standard deviation that the counts of the peak leave"),
    "target_signal": Array(_OF_TARGET, "<f4", "1", "counts of the peak above ambient light"),
    "target_status": Array(_OF_TARGET, "|u1", "1", "whether there is a target"),
}
VIEW_FIELDS: dict[str, Array] = {
    "coverage": Array(("view", "row", "col"), "<f4", "1", "share of the pixel that sees the landmark"),
    "range_hard": Array(("view", "row", "col"), "<f4", "m", "range that the centre ray sees, without noise"),
    "range_mixed": Array(("view", "row", "col"), "<f4", "m", "range mixed over the pixel, without noise"),
}
_POSE = ("pose_row", "pose_col")
POSE_FIELDS = ("camera2world", "bodies2world", "class_of_body")
SCENE_FIELDS: dict[str, Array] = {
    "shares": Array(("view", "row", "col", "body_class"), "<f4", "1", "share of the pixel that bodies of a class fill"),
    "camera2world": Array(("view", *_POSE), "<f8", "1", "camera's mount to world, metres; x forward, z up"),
    "bodies2world": Array(("view", "body", *_POSE), "<f8", "1", "bodies to world, metres; NaN where there is none"),
    "class_of_body": Array(("view", "body"), "<i2", "1", "number of each body's class, -1 where there is none"),
}
"""Of the views of scenes, beside :data:`VIEW_FIELDS` and labels."""
FIELDS = {**FRAME_FIELDS, **VIEW_FIELDS, **SCENE_FIELDS}
SEQUENCE = {
    "sequence": Array(("view",), "<i8", "1", "number of the scene"),
    "step": Array(("view",), "<i4", "1", "step of the scene"),
}
"""True quantities of a view of a scene that its number alone tells."""
TRUTH = {
    "distance": Array(("view",), "<f8", "m", "horizontal distance from the lens to the landmark's axis"),
    "delta": Array(("view",), "<f8", "degree", "angle from which the landmark is seen"),
    "bearing": Array(("view",), "<f8", "degree", "azimuth of the landmark's axis in the camera frame"),
    "height": Array(("view",), "<f8", "m", "height of the landmark's origin above the optical axis"),
    "pitch": Array(("view",), "<f8", "degree", "pitch of the camera, positive looking down"),
    "roll": Array(("view",), "<f8", "degree", "roll of the camera"),
    "albedo": Array(("view",), "<f8", "1", "share of light that the landmark returns"),
    "wall": Array(("view",), "<f8", "m", "distance of the wall behind, NaN if there is none"),
    "floor": Array(("view",), "<f8", "m", "how far the floor lies below the lens, NaN if there is none"),
}
"""True quantities of a view; those of a tilt are absent from files of a level camera."""
TRUTH_KEYS = {name: name + {"m": "_m", "degree": "_deg", "1": ""}[array.units] for name, array in TRUTH.items()}
"""Keys of the true quantities in plans and exports."""


def bank_frequencies_hz(sensor: Sensor, harmonics: Sequence[int]) -> list[float]:
    """Return at which frequencies a bank holds phasors, rising: the sensor's own, and their harmonics."""
    return sorted({k * hz for hz in sensor.frequencies_hz for k in (1, *harmonics)})


def dimension_sizes(sensor: Sensor) -> dict[str, int]:
    """Return the lengths of those dimensions of a frame set that its sensor decides."""
    m = len(sensor.frequencies_hz)
    sizes = {"row": sensor.rows, "col": sensor.cols, "frequency": m, "phase": sensor.n_phase_images, "tap": 2}
    if sensor.histogram is not None:
        sizes |= {"bin": sensor.histogram.bins, "target": sensor.histogram.max_targets}
    return sizes


def frame_set_fields(plan: FramePlan | SceneFramesPlan, sensor: Sensor) -> dict[str, Array]:
    """Return the large datasets of a resolved plan's frame set, in their order in the file."""
    names = ["range", "flags"] if sensor.kind == "direct" else ["range", "amplitude", "intensity", "flags"]
    if len(sensor.frequencies_hz) > 1:
        names += FREQUENCY_FIELDS
    if isinstance(plan, FramePlan):
        names += HISTOGRAM_FIELDS if plan.histograms else ()
    else:
        names += ("histogram",) if "histograms" in plan.keep else ()
        names += TARGET_FIELDS if "targets" in plan.keep else ()
    if plan.keep_taps:
        names.append("taps")
    if "shot" in plan.variants:
        names.append("range_shot")
    names += ["coverage", *(f"range_{name}" for name in ("hard", "mixed") if name in plan.variants)]
    if isinstance(plan, FramePlan):
        return {name: FIELDS[name] for name in names}
    names += ("shares",) if "shares" in plan.keep else ()
    names += POSE_FIELDS if "poses" in plan.keep else ()
    labels = {f"label_{name}": _label(name, kind) for name, kind in (plan.scenes.labels or {}).items()}
    return {name: FIELDS[name] for name in names} | labels


def _label(name: str, kind: str) -> Array:
    return Array(("view",), "<f8" if kind == "number" else f"|S{LABEL_BYTES}", "1", f"label '{name}'")


def sizes_of_scenes(plan: SceneFramesPlan) -> dict[str, int]:
    """Return the lengths of those dimensions of a frame set of scenes that its plan decides."""
    return {"body_class": len(plan.scenes.classes), "body": plan.scenes.bodies, "pose_row": 4, "pose_col": 4}
