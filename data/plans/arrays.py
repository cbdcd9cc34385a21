"""Arrays of a bank and of a frame set: dimensions, types, units and sizes, known before any file is made."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from phasemark import UsageError
from phasemark.data.plans.bank_plan import BankPlan
from phasemark.data.plans.frame_plan import FramePlan
from phasemark.data.plans.generated_scene import LABEL_BYTES
from phasemark.data.plans.scene_frames_plan import SceneFramesPlan
from phasemark.render import Sensor

AnyPlan = BankPlan | FramePlan | SceneFramesPlan
"""Of what is built in shards."""
MOST_IMAGES = 20_000_000
"""Of a bank: their views are kept in memory while it is built, 32 bytes each."""
MOST_VIEWS = 5_000_000
"""Of a frame set: its truth is drawn and written at once, some 200 bytes a view."""
MOST_FRAMES = 50_000_000
"""Of a frame set: their numbers are written at once, 16 bytes each."""
_UNITS = {"": 1, "B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "TB": 10**12}


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
    kinds = {"number": "<f8", "text": f"|S{LABEL_BYTES}"}
    stated = (plan.scenes.labels or {}).items()
    labels = {f"label_{name}": Array(("view",), kinds[kind], "1", f"label '{name}'") for name, kind in stated}
    return {name: FIELDS[name] for name in names} | labels


def sizes_of_scenes(plan: SceneFramesPlan) -> dict[str, int]:
    """Return the lengths of those dimensions of a frame set of scenes that its plan decides."""
    return {"body_class": len(plan.scenes.classes), "body": plan.scenes.bodies, "pose_row": 4, "pose_col": 4}


def planned_size(plan: AnyPlan) -> dict[str, int]:
    """Return how large a bank or frame set would be, from its plan alone: nothing is rendered, no mesh is read.

    Parameters
    ----------
    plan : BankPlan, FramePlan or SceneFramesPlan
        Plan of the bank or frame set.

    Returns
    -------
    dict of str to int
        ``images``, or ``views`` and ``frames``; and ``bytes`` without header and meshes, some 2 MB for the whole
        catalogue.

    Raises
    ------
    UsageError
        A class or sensor is unknown, or two landmarks have one name.
    InputFileError
        The sensor file cannot be read.

    Examples
    --------
    >>> from phasemark.data import BankPlan
    >>> planned_size(BankPlan(classes=["cone"], distance_m="1:2:0.5", delta_deg="0:170:10", layout="full"))
    {'images': 54, 'bytes': 221184}
    """
    plan = plan.resolve()
    if isinstance(plan, BankPlan):
        return _bank_size(plan, plan.image_sensor())
    return _frames_size(plan, plan.build_sensor())


def too_many(counts: Mapping[str, int]) -> str | None:
    """Return why a bank or frame set of this size cannot be one file, or None.

    Parameters
    ----------
    counts : mapping of str to int
        As :func:`planned_size` returns them.

    Examples
    --------
    >>> too_many({"images": 30_000_000, "bytes": 123})
    'a bank can have at most 20000000 images, and this would have 30000000'
    """
    limits = {"images": ("bank", MOST_IMAGES), "views": ("frame set", MOST_VIEWS), "frames": ("frame set", MOST_FRAMES)}
    for name, (what, most) in limits.items():
        if counts.get(name, 0) > most:
            return f"a {what} can have at most {most} {name}, and this would have {counts[name]}"
    return None


def refuse_too_many(plan: AnyPlan) -> None:
    """Refuse a plan whose bank or frame set cannot be one file.

    Parameters
    ----------
    plan : BankPlan, FramePlan or SceneFramesPlan

    Raises
    ------
    UsageError
        It has too many images, views or frames; and whatever :func:`planned_size` raises.
    """
    many = too_many(planned_size(plan))
    if many is None:
        return
    if isinstance(plan, BankPlan):
        raise UsageError(f"{many}: thin 'distance_m' or 'delta_deg', or make several of it")
    raise UsageError(f"{many}: take fewer, or make several sets with seeds of their own")


def _bank_size(plan: BankPlan, sensor: Sensor) -> dict[str, int]:
    counts = {
        "landmark_class": len(plan.landmarks) + len(plan.meshes),
        "distance": len(plan.distance_m),
        "delta": len(plan.delta_rad),
    }
    numbers = 2 * len(bank_frequencies_hz(sensor, plan.harmonics)) + 2  # real and imaginary, intensity and coverage
    images = size = 0
    for group in LAYOUT_GROUPS[plan.layout]:
        n = math.prod(counts[dim] for dim in VIEW_DIMS[group])
        first, stop = group_rows(group, sensor)
        images += n
        size += n * (stop - first) * sensor.cols * numbers * 4
    return {"images": images, "bytes": size}


def _frames_size(plan: FramePlan | SceneFramesPlan, sensor: Sensor) -> dict[str, int]:
    counts = {"frame": plan.views * plan.frames_per_view, "view": plan.views} | dimension_sizes(sensor)
    bytes_of_a_frame = 24  # its number, its view and its seed
    bytes_of_a_view = 67  # its number, class, split and truth
    if isinstance(plan, SceneFramesPlan):
        counts |= sizes_of_scenes(plan)
        bytes_of_a_view = 21  # its number, sequence, step and split
    size = bytes_of_a_frame * counts["frame"] + bytes_of_a_view * counts["view"]
    for array in frame_set_fields(plan, sensor).values():
        size += math.prod(counts[dim] for dim in array.dims) * np.dtype(array.kind).itemsize
    return {"views": plan.views, "frames": counts["frame"], "bytes": size}


def parse_size(text: str, name: str) -> int:
    """Return the bytes of a size such as ``20GB`` or ``500 MB``; a number alone is in bytes.

    Parameters
    ----------
    text : str
    name : str
        The option or key that holds it, for the error.

    Returns
    -------
    int

    Raises
    ------
    UsageError
        It is something else.

    Examples
    --------
    >>> parse_size("1.5 GB", "--max-size")
    1500000000
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?([kMGT]?B|)", text.strip())
    size = math.nan if found is None else float(found[1]) * _UNITS[found[2]]
    if not math.isfinite(size):
        raise UsageError(f"{name} must be a number with B, kB, MB, GB or TB, such as 20GB, got '{text[:40]}'")
    return round(size)


def format_size(size: int) -> str:
    """Return a number of bytes with three digits and a unit.

    Examples
    --------
    >>> format_size(15_234_000_000)
    '15.2 GB'
    """
    unit = next((unit for unit in ("TB", "GB", "MB", "kB") if size >= _UNITS[unit]), "B")
    return f"{float(f'{size / _UNITS[unit]:.3g}'):g} {unit}"
