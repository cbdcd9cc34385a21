"""A user's own matcher in a sweep, ``module:callable``: imported, called, and its answers checked."""

from __future__ import annotations

import importlib
import numbers
import signal
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from phasemark import UsageError
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match, Matches

MatchFrames = Callable[[FilteredFrames], Sequence[Match]]
_TERMINATED = 128 + signal.SIGTERM
"""The exit status with which the command line ends on SIGTERM: no error of a user's module."""


def imported_matcher(text: str) -> MatchFrames:
    """Return the matcher that ``module:callable`` names.

    Raises
    ------
    UsageError
        It cannot be imported: with the reason; if the module's own code failed, its traceback is a note of the error
        (:pep:`678`).
    """
    module, _, name = text.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        if isinstance(error, SystemExit) and error.code == _TERMINATED:
            raise
        failed = UsageError(f"the matcher '{text}' cannot be imported ({_named(error)})")
        if own := _own_traceback(error):
            failed.add_note(own)
        raise failed from None
    if not callable(found):
        raise UsageError(f"the matcher '{text}' must be callable, got {type(found).__name__}")
    match: MatchFrames = found
    return match


def own_matches(
    match: Callable[[FilteredFrames], Any], text: str, frames: FilteredFrames, where: str, names: Sequence[str]
) -> Matches:
    """Call a user's matcher, and refuse what is not a Match for each frame."""
    due = f"{where}: the matcher '{text}' must return a Match for each of the {len(frames)} frames"
    try:
        found = match(frames)
        matches = list(found) if isinstance(found, Iterable) else None
    except (Exception, SystemExit) as error:
        failed = UsageError(f"{where}: the matcher '{text}' raised {_named(error)}")
        failed.add_note(_own_traceback(error) or _named(error))
        raise failed from None
    if matches is None:
        raise UsageError(f"{due}, got {'None' if found is None else f'an object of type {type(found).__name__}'}")
    for k, one in enumerate(matches):
        if not isinstance(one, Match):
            raise UsageError(f"{due}, got an object of type {type(one).__name__} for frame {k}")
        if (wrong := _wrong_field(one, names)) is not None:
            raise UsageError(f"{due}, but the Match for frame {k} has {wrong}")
    if len(matches) != len(frames):
        raise UsageError(f"{due}, got {len(matches)}")
    return Matches(matches)


def _wrong_field(match: Match, names: Sequence[str]) -> str | None:
    """Return the fault in the types of a user's match, or None."""
    if not isinstance(match.class_name, str | None):
        return f"'class_name' {match.class_name!r}: it must be a str or None"
    for name in (*names, "chi2", "p_value"):
        value = getattr(match, name)
        if not isinstance(value, numbers.Real):
            return f"'{name}' of type {type(value).__name__}: it must be a number"
    if not isinstance(match.dof, numbers.Integral):
        return f"'dof' of type {type(match.dof).__name__}: it must be a whole number"
    if not isinstance(match.class_probability, Mapping):
        return f"'class_probability' of type {type(match.class_probability).__name__}: it must be a mapping"
    if match.covariance is not None:
        n = len(match.free)
        if not set(match.free) <= set(names):
            return f"'free' {match.free!r}: it must name some of {', '.join(names)}"
        if np.shape(match.covariance) != (n, n):
            return f"'covariance' of shape {np.shape(match.covariance)}: it must be {(n, n)}, as 'free' has {n} names"
    return None


def _named(error: BaseException) -> str:
    """Return type and message of an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(":")


def _own_traceback(error: BaseException) -> str:
    """Return the traceback of a user's code, without our calls and those that import it; empty if nothing is left."""
    own = error.__traceback__
    while own is not None and _is_ours_or_import(own.tb_frame.f_code.co_filename):
        own = own.tb_next
    return "" if own is None else "".join(traceback.format_exception(type(error), error, own)).rstrip()


def _is_ours_or_import(filename: str) -> bool:
    return filename in (__file__, importlib.__file__) or filename.startswith("<frozen importlib")
