"""Full searches beside the tracking: in a process of their own, in line, or as a log has them."""

from __future__ import annotations

import functools
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Mapping
from concurrent.futures import Future
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
    """Searches every n-th frame at once, or the frames that a log has as searched: answers depend on frames alone.

    Parameters
    ----------
    matcher : Matcher
    every : int
    logged : mapping of int to int, optional
        Frame that was searched, by the frame with which the answer was used: that is repeated.
    """

    def __init__(self, matcher: Matcher, every: int = 30, logged: Mapping[int, int] | None = None) -> None:
        self._matcher, self._every, self._logged = matcher, every, logged
        self._wanted = None if logged is None else set(logged.values())
        self._found: dict[int, Match] = {}

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Search the frame if its turn has come or that is urgent, or if it was searched then."""
        is_due = urgent or frame % self._every == self._every - 1
        if is_due if self._wanted is None else frame in self._wanted:
            self._found[frame] = self._matcher.match(filtered)[0]

    def answer(self, frame: int) -> Searched | None:
        """Return the answer that is to be used with this frame, once."""
        searched = frame if self._logged is None else self._logged.get(frame)
        if searched is None or searched not in self._found:
            return None
        return Searched(searched, self._found.pop(searched))

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
        self._matcher, self._found = matcher, list[Searched]()
        self._ask(_portable(matcher))
        self._is_ready = False

    def _ask(self, thing: Any) -> None:
        """Let the process answer, in a thread that waits for it: a Searched, None, or why it has ended."""
        self._running: Future[Searched | None] = Future()
        threading.Thread(target=self._wait, args=(thing, self._running), daemon=True).start()

    def _wait(self, thing: Any, running: Future[Searched | None]) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        try:
            pickle.dump(thing, self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
            running.set_result(pickle.load(self._process.stdout))
        except Exception as error:  # whatever an end of the process makes pipes and pickle say
            running.set_exception(error)

    def offer(self, frame: int, filtered: FilteredFrames, *, urgent: bool) -> None:
        """Search the frame unless a search runs; until the process is there, urgent ones here and now."""
        if not self._running.done():
            if urgent and not self._is_ready:
                self._found.append(Searched(frame, self._matcher.match(filtered)[0]))
        elif self._running.exception() is None:  # else the process has ended: tracking goes on without it
            self._is_ready = True
            if (found := self._running.result()) is not None:
                self._found.append(found)
            self._ask((frame, filtered))

    def answer(self, frame: int) -> Searched | None:
        """Return an answer that has come, once."""
        return self._found.pop(0) if self._found else None

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._running.exception(1.0)
        self._process.communicate()


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
