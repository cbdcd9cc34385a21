"""The size of banks and frame sets, from arithmetic alone: known before anything is built."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np

from phasemark import UsageError
from phasemark.data.plans.arrays import (
    LAYOUT_GROUPS,
    VIEW_DIMS,
    bank_frequencies_hz,
    dimension_sizes,
    frame_set_fields,
    group_rows,
    sizes_of_scenes,
)
from phasemark.data.plans.bank_plan import BankPlan
from phasemark.data.plans.frame_plan import FramePlan
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
    numbers = (
        2 * len(bank_frequencies_hz(sensor, plan.harmonics)) + 2
    )  # real and imaginary parts; intensity and coverage
    images = size = 0
    for group in LAYOUT_GROUPS[plan.layout]:
        n = math.prod(counts[dim] for dim in VIEW_DIMS[group])
        first, stop = group_rows(group, sensor)
        images += n
        size += n * (stop - first) * sensor.cols * numbers * 4
    return {"images": images, "bytes": size}


def _frames_size(plan: FramePlan | SceneFramesPlan, sensor: Sensor) -> dict[str, int]:
    counts = {
        "frame": plan.views * plan.frames_per_view, "view": plan.views, **dimension_sizes(sensor),
    }  # fmt: skip
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
