"""Frame sets for other programs: npz, PNG, CSV, JSON lines, point clouds, BOP, ROS 2 bags, WebDataset, LeRobot."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

from phasemark import UsageError
from phasemark.data.export.bop import write_bop
from phasemark.data.export.images import write_ply, write_png16
from phasemark.data.export.lerobot import write_lerobot
from phasemark.data.export.rosbag import write_rosbag
from phasemark.data.export.tables import write_csv, write_jsonl, write_npz, write_targets_csv
from phasemark.data.export.webdataset import write_webdataset
from phasemark.data.files.atomic_write import refuse_unwritable, replacing
from phasemark.data.files.replaced_folder import replacing_folder
from phasemark.data.files.same_file import refuse_inputs
from phasemark.data.frames.frame_set_file import FrameSet, SceneFrameSet
from phasemark.data.measured.reading import RangeOrZ

__all__ = ["EXPORTS", "export_frames"]

Content = Literal["range", "targets", "histogram"]
Writer = Callable[[FrameSet, Path, RangeOrZ], None]

EXPORTS: dict[str, tuple[Writer, bool, tuple[RangeOrZ, ...]]] = {
    "npz": (write_npz, False, ("range", "z")),
    "csv": (write_csv, False, ("range", "z")),
    "jsonl": (write_jsonl, False, ("range",)),
    "png16": (write_png16, True, ("range", "z")),
    "ply": (write_ply, True, ("range",)),
    "bop": (write_bop, True, ("z",)),
    "rosbag": (write_rosbag, True, ("z",)),
    "webdataset": (write_webdataset, True, ("range",)),
    "lerobot": (write_lerobot, True, ("range",)),
}
"""For each format: who writes it, whether it is a folder, and which quantities it can hold, the usual one first."""

OF_LANDMARKS = ("bop", "rosbag")
"""Formats that hold poses of landmarks."""
CONTENTS: dict[str, tuple[Content, ...]] = {
    "npz": ("range", "targets", "histogram"),
    "csv": ("range", "targets"),
    "jsonl": ("histogram",),
    "webdataset": (),
    "lerobot": (),
}
"""What formats can hold one of alone; those that are not named hold ranges, and those without any hold all there is."""
_RANGE_ALONE: tuple[Content, ...] = ("range",)


def export_frames(
    frames: FrameSet,
    path: str | os.PathLike[str],
    to: str,
    *,
    quantity: RangeOrZ | None = None,
    content: Content | None = None,
    force: bool = False,
) -> Path:
    """Write a frame set in a format of other programs.

    Radial range and z, the distance along the optical axis, are never mixed up: every format says which it holds.

    Parameters
    ----------
    frames : FrameSet
        The frame set.
    path : path-like
        The file, or for ``png16`` and the formats after it the folder, to write.
    to : {"npz", "csv", "jsonl", "png16", "ply", "bop", "rosbag", "webdataset", "lerobot"}
        docs/formats.md says what each holds.
    quantity : {"range", "z"}, optional
        What ``npz``, ``csv`` and ``png16`` hold; range if left out. BOP and ROS prescribe z.
    content : {"range", "targets", "histogram"}, optional
        What is wanted of a frame set with histograms. If left out, ``npz`` holds all three, ``jsonl`` histograms, and
        every other format ranges, which are those of the nearest target.
    force : bool
        Whether an existing file may be replaced, or a folder that an earlier export wrote. Another folder, or one that
        holds a file of somebody else, never is.

    Returns
    -------
    Path
        `path`.

    Raises
    ------
    UsageError
        The format is unknown or cannot hold the quantity or the content, the frame set has no histograms, what it
        needs is not installed, or the file is the frame set itself.
    OutputExistsError, StorageError
        As :func:`phasemark.data.files.write_atomically`.
    """
    if not isinstance(frames, FrameSet | SceneFrameSet):
        raise UsageError(f"'frames' must be a frame set, got {type(frames).__name__}: open_frames opens a file")
    if to not in EXPORTS:
        raise UsageError(f"to=… must be one of {', '.join(EXPORTS)}, got '{to}'")
    write, is_folder, quantities = EXPORTS[to]
    if quantity is not None and quantity not in quantities:
        raise UsageError(f"quantity=… must be {' or '.join(quantities)} for {to}, got '{quantity}'")
    if to in OF_LANDMARKS and isinstance(frames, SceneFrameSet):
        able = [name for name in EXPORTS if name not in OF_LANDMARKS]
        raise UsageError(f"to=… must be one of {', '.join(able)} for a set of scenes, got '{to}': it holds landmarks")
    if to == "jsonl" and content is None:
        content = "histogram"
    if content is not None and content not in CONTENTS.get(to, _RANGE_ALONE):
        able = [name for name in EXPORTS if content in CONTENTS.get(name, _RANGE_ALONE)]
        raise UsageError(f"content={content} must go to {' or '.join(able)}, which can hold it, got '{to}'")
    if content in ("targets", "histogram"):
        quantities = (frames.reported_quantity(),)
        if quantity not in (None, *quantities):
            why = f"the chip reports {quantities[0]}" if content == "targets" else "counts are neither range nor z"
            raise UsageError(f"quantity=… must be left out of {content}: {why}, got '{quantity}'")
    if to == "npz":
        write = partial(write_npz, content=content)
    elif content == "targets":
        write = write_targets_csv
    path = Path(path)
    refuse_inputs([path], [frames.path])
    if is_folder:
        with replacing_folder(path, f"frames export --to {to}", force=force) as temporary:
            write(frames, temporary, quantity or quantities[0])
    else:
        refuse_unwritable(path, force=force)  # a link too, which the writer would follow
        with replacing(path, force=force) as temporary:
            write(frames, temporary, quantity or quantities[0])
    return path
