"""Full searches beside the tracking: in a process of their own, in line, or as a log has them."""

from __future__ import annotations

import functools
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO, Protocol

from phasemark.data import BankPlan, build_bank
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.match import Match
from phasemark.matcher.matcher import Matcher

_NICENESS = 5


@dataclass(frozen=True, eq=False)
class Searched:
    """Answer of a full search, and the number of the frame that was searched."""

    frame: int
    match: Match


class Searches(Protocol):
    """Interface of what searches frames in turn."""

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Offer a frame; it is searched if a search is due and none runs, at once where that is urgent."""

    def answer(self, frame: int) -> Searched | None:
        """Return an answer that is to be used with a frame."""

    def close(self) -> None:
        """End."""


class SearchesInLine:
    """Searches every n-th frame at once: the answers depend on the frames alone."""

    def __init__(self, matcher: Matcher, every: int) -> None:
        self._matcher, self._every = matcher, every
        self._found: Searched | None = None

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Search the frame if its turn has come, or if that is urgent."""
        if urgent or frame % self._every == self._every - 1:
            self._found = Searched(frame, self._matcher.match(filtered)[0])

    def answer(self, frame: int) -> Searched | None:
        """Return the answer, once."""
        found, self._found = self._found, None
        return found

    def close(self) -> None:
        """Nothing is open."""


class SearchesAsLogged:
    """Searches the frames that a log has as searched, and uses each answer where it was used then.

    Parameters
    ----------
    matcher : Matcher
    used_with : mapping of int to int
        Frame that was searched, by the frame with which the answer was used.
    """

    def __init__(self, matcher: Matcher, used_with: Mapping[int, int]) -> None:
        self._matcher, self._used_with = matcher, used_with
        self._wanted = set(used_with.values())
        self._found: dict[int, Match] = {}

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Search the frame if it was searched then."""
        if frame in self._wanted:
            self._found[frame] = self._matcher.match(filtered)[0]

    def answer(self, frame: int) -> Searched | None:
        """Return the answer that was used with this frame."""
        searched = self._used_with.get(frame)
        return None if searched is None else Searched(searched, self._found.pop(searched))

    def close(self) -> None:
        """Nothing is open."""


class SearchesBeside:
    """Searches in a process of low priority, one frame at a time: the newest when the one before is done."""

    def __init__(self, matcher: Matcher) -> None:
        program = "from phasemark.matcher.live.search_beside import serve; serve()"
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment,
            start_new_session=True,
        )  # fmt: skip
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._to, self._from = self._process.stdin, self._process.stdout
        self._found: list[Searched] = []
        self._matcher = matcher
        self._is_busy, self._is_ready = True, threading.Event()
        self._send(_portable(matcher))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _send(self, thing: Any) -> None:
        try:
            pickle.dump(thing, self._to, pickle.HIGHEST_PROTOCOL)
            self._to.flush()
        except OSError:  # the process has ended: tracking goes on without it
            self._is_busy = True

    def _read(self) -> None:
        while True:
            try:
                found = pickle.load(self._from)
            except (EOFError, OSError, ValueError, pickle.UnpicklingError):
                return
            if isinstance(found, Searched):
                self._found.append(found)
            self._is_busy = False
            self._is_ready.set()

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Search the frame unless a search runs; until the process is there, urgent ones here and now."""
        if urgent and not self._is_ready.is_set():
            self._found.append(Searched(frame, self._matcher.match(filtered)[0]))
        elif not self._is_busy:
            self._is_busy = True
            self._send((frame, filtered))

    def answer(self, frame: int) -> Searched | None:
        """Return an answer that has come, once."""
        return self._found.pop(0) if self._found else None

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        self._reader.join(1.0)
        self._to.close()
        self._from.close()


def _portable(matcher: Matcher) -> Any:
    """Return what makes a matcher in another process: a bank without a file is built again there."""
    if matcher.bank.path.exists():
        return matcher
    made = matcher.__reduce__()[0]
    return functools.partial(_built, matcher.bank.plan, matcher.method, dict(made.keywords))


def _built(plan: BankPlan, method: str, arguments: dict[str, Any]) -> Matcher:
    """Return a matcher with a bank that is built for it."""
    return Matcher(build_bank(plan, workers=1), method, **arguments)


def serve() -> None:
    """Match frames that come on standard input, with the matcher that comes first; answers go to standard output."""
    source, sink = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not come between the answers
    given = pickle.load(source)
    matcher = given if isinstance(given, Matcher) else given()
    _answer(sink, None)
    os.nice(_NICENESS)
    while True:
        try:
            frame, filtered = pickle.load(source)
        except EOFError:
            return
        _answer(sink, Searched(frame, matcher.match(filtered)[0]))


def _answer(sink: BinaryIO, thing: Searched | None) -> None:
    pickle.dump(thing, sink, pickle.HIGHEST_PROTOCOL)
    sink.flush()
