"""Logs of direct sensors as positions to be matched: histograms and targets, from their files."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data.frames.frame_set_file import is_frame_set, open_frames
from phasemark.data.measured.histogram_logs import read_histograms, read_targets
from phasemark.render import Sensor
from phasemark.render.direct.footprints import histogram_of
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.targets import Targets


@dataclass(frozen=True, eq=False)
class DirectPositions:
    """Positions of a direct sensor.

    Parameters
    ----------
    frames : HistogramFrames or Targets
    time_s : (n,) float64, optional
    """

    frames: HistogramFrames | Targets
    time_s: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return len(self.frames.counts if isinstance(self.frames, HistogramFrames) else self.frames.distance_m)

    def __getitem__(self, positions: slice) -> Self:
        """Return some positions."""
        frames = self.frames
        if isinstance(frames, HistogramFrames):
            some: HistogramFrames | Targets = frames[positions]
        else:
            some = _each(frames, lambda values: values[positions])
        return type(self)(some, None if self.time_s is None else self.time_s[positions])


def read_positions(
    path: Path, sensor: Sensor, on: str, *, moving: bool, valid_status: Collection[int] | None = None
) -> DirectPositions:
    """Read a log of histograms or of targets.

    Parameters
    ----------
    path : Path
        NPZ or lines of JSON with histograms, CSV with targets, or a frame set with histograms.
    sensor : Sensor
        The bank's, with a [histogram] table.
    on : {"histograms", "targets"}
        On targets histograms serve too: the chip's estimator makes targets of them.
    moving : bool
        Whether every frame is a position of its own; otherwise all of a log are frames of one, and those of each view
        of a frame set.
    valid_status : collection of int, optional
        Which codes of a CSV file's status columns mark a target; None: 5 and 9.

    Raises
    ------
    InputFileError
        The file cannot be read, or holds something else.
    UsageError
        Histograms are asked of a CSV file or of a frame set without them, a status of a file that has none, or the
        frame set is that of another sensor.
    """
    if path.suffix.lower() == ".csv":
        if on == "histograms":
            raise UsageError(f"{path}: CSV holds targets, not histograms: match it on targets")
        targets = read_targets(path, sensor=sensor, **({"valid_status": valid_status} if valid_status else {}))
        return DirectPositions(_each(targets, lambda values: np.swapaxes(values, 0, 1)) if moving else targets)
    if valid_status is not None:
        raise UsageError(f"{path}: has histograms, and a valid status goes with targets from CSV")
    if is_frame_set(path):
        return _of_frame_set(path, sensor, moving=moving)
    log = read_histograms(path, sensor=sensor).frames
    if moving:
        return DirectPositions(log, None if log.time_s is None else log.time_s[:, 0])
    return DirectPositions(_added(log), None if log.time_s is None else np.array([log.time_s.mean()]))


def _of_frame_set(path: Path, sensor: Sensor, *, moving: bool) -> DirectPositions:
    """Return the histograms of a frame set, a position each view, or each frame."""
    with open_frames(path, untrusted=True) as opened:
        of_view = np.argsort(opened.view_index, kind="stable")
        frames, n_views = opened.histograms()[of_view], len(np.unique(opened.view_index))
    found, wanted = frames.counts.shape[2:], (sensor.rows, sensor.cols, histogram_of(sensor).bins)
    if found != wanted:
        raise UsageError(
            f"{path}: has {found[0]} × {found[1]} zones of {found[2]} bins, and the bank's sensor"
            f" {wanted[0]} × {wanted[1]} of {wanted[2]}"
        )
    if not moving:
        frames = HistogramFrames(frames.counts.reshape(n_views, -1, *found), sensor=frames.sensor)
    return DirectPositions(frames)


def _each(targets: Targets, change: Callable[[NDArray[Any]], NDArray[Any]]) -> Targets:
    """Return targets whose arrays were all changed."""
    return Targets(change(targets.distance_m), change(targets.sigma_m), change(targets.signal), change(targets.status))


def _added(log: HistogramFrames) -> HistogramFrames:
    """Return all frames of a log as those of one position."""
    return HistogramFrames(
        np.swapaxes(log.counts, 0, 1),
        sensor=log.sensor,
        reference=None if log.reference is None else np.swapaxes(log.reference, 0, 1),
        time_s=None if log.time_s is None else log.time_s.T,
    )
