"""A user's own matcher in a sweep, ``module:callable``: imported, called, and its answers checked."""

from __future__ import annotations

import numbers
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from phasemark import UsageError
from phasemark.inputs.own_program import called_program
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match, Matches

MatchFrames = Callable[[FilteredFrames], Sequence[Match]]


def own_matches(
    match: Callable[[FilteredFrames], Any], text: str, frames: FilteredFrames, where: str, names: Sequence[str]
) -> Matches:
    """Call a user's matcher, and refuse what is not a Match for each frame."""
    due = f"{where}: the matcher '{text}' must return a Match for each of the {len(frames)} frames"
    try:
        found = match(frames)
        matches = list(found) if isinstance(found, Iterable) else None
    except (Exception, SystemExit) as error:
        raise called_program(f"the matcher '{text}'", error, where) from None
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
