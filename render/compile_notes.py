"""Word on standard error that numba compiles, which the first use of the program waits for.

What is compiled is kept (:mod:`~phasemark.render.compile_cache`), so that this happens once.
"""

from __future__ import annotations

import os
import sys
import threading
import time

from numba.core import event

_AFTER_S = 1.0
_ABOUT_S = {"rendering": 60, "matching": 30}
"""Processor time that compiling takes altogether on a core of a server, from a third less to a third more."""
_SWITCH = "PHASEMARK_COMPILE_NOTES"
"""Environment variable that is 0 where no line is wanted."""
_OTHER = "the work of others"


class _Listener(event.Listener):
    """Tells once for each part of the program that it is compiled, after a second of that."""

    def __init__(self) -> None:
        self._spent_s = dict.fromkeys((*_ABOUT_S, _OTHER), 0.0)
        self._depth, self._begun, self._part = 0, 0.0, ""
        self._timer: threading.Timer | None = None

    def on_start(self, event: event.Event) -> None:
        """Count the time of a function that others do not wait for."""
        self._depth += 1
        if self._depth > 1:
            return
        package, _, place = event.data["dispatcher"].py_func.__module__.partition(".")
        self._part, self._begun = "matching" if place.startswith("matcher.") else "rendering", time.monotonic()
        if package != "phasemark":
            self._part = _OTHER
        elif (rest := _AFTER_S - self._spent_s[self._part]) > 0.0:
            self._timer = threading.Timer(rest, _tell, (self._part,))
            self._timer.daemon = True
            self._timer.start()

    def on_end(self, event: event.Event) -> None:
        """Stop counting."""
        self._depth -= 1
        if self._depth == 0:
            self._spent_s[self._part] += time.monotonic() - self._begun
            if self._timer is not None:
                self._timer.cancel()
                self._timer = None


def _tell(part: str) -> None:
    if sys.stderr is not None:
        sys.stderr.write(f"compiling for {part}, once, about {_ABOUT_S[part]} s\n")
        sys.stderr.flush()


def announce_compilation() -> None:
    """Write a line on standard error when a second has been spent on compiling, unless the environment forbids it."""
    if os.environ.get(_SWITCH) == "0":
        return
    event.register("numba:compile", _Listener())  # type: ignore[no-untyped-call]
