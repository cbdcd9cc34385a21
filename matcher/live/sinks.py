"""Sinks of poses; here lines of JSON."""

from __future__ import annotations

import json
import os
import sys
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from phasemark import OutputExistsError, StorageError
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update

UNKNOWN_VARIANCE = 1e6
"""Variance of what is not estimated, m² or rad², as consumers of covariances have it."""


class Sink(ABC):
    """Sink of poses.

    Parameters
    ----------
    name : str
        As the user gave it.
    """

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def update(self, update: Update) -> None:
        """Take the outcome of a frame; a pose is published only if its `reason` is empty."""

    def status(self, status: Status) -> None:  # noqa: B027  a sink may do without
        """Take the status, some times a second."""

    def close(self) -> None:  # noqa: B027
        """Finish files, and leave what was joined."""


class JsonLines(Sink):
    """A line of JSON for each frame, into a file or standard output; degrees, as all of the program's JSON."""

    def __init__(self, name: str, file: TextIO) -> None:
        super().__init__(name)
        self._file = file

    def update(self, update: Update) -> None:
        """Write what is known."""
        self._file.write(json.dumps(update.as_dict(), ensure_ascii=False, allow_nan=False) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not sys.stdout:
            self._file.close()


def planar_covariance(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of (x, y, z, roll, pitch, yaw), (6, 6), of a pose in the plane."""
    whole = np.eye(6) * UNKNOWN_VARIANCE
    own = [0, 1, 5]
    whole[np.ix_(own, own)] = covariance
    return whole


def open_output(path: Path, *, force: bool, mode: str = "w") -> Any:
    """Open a file for writing that grows while a session runs.

    Raises
    ------
    OutputExistsError, StorageError
        It exists without `force`, or cannot be opened.
    """
    if path.exists() and not force and not path.is_fifo():
        raise OutputExistsError(f"{path} exists: give force=True to replace it, or another name")
    try:
        return open(path, mode, encoding=None if "b" in mode else "utf-8")
    except OSError as error:
        raise StorageError(f"{path}: cannot be written ({error.strerror or os.strerror(error.errno or 0)})") from None
