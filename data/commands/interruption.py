"""SIGINT and SIGTERM, which end the program wherever Python passes an exception on."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType
from typing import Self

_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGALRM") if hasattr(signal, name)]
_TICK_S, _MOST_TICKS = 0.001, 3000
_DEAF = ("__del__", "_raw_object_cache_notify", "_raw_object_cache_getbuffer")
"""Functions that C code calls: Python prints what is raised in them, and goes on. The last two are llvmlite's."""


class Interruption:
    """Signals unwind the stack while this context is open, so that temporary files are removed.

    An exception within an import would leave its lock taken, or a library would read it as a missing package: the
    signal waits until imports are done, a millisecond at a time; in a module that hangs, three seconds. What
    is raised where Python discards exceptions is raised again.
    """

    def __init__(self) -> None:
        self._waiting: int | None = None
        self._ticks = 0
        self._hook = sys.unraisablehook
        self._before = {number: signal.getsignal(number) for number in _SIGNALS}

    def __enter__(self) -> Self:
        signal.signal(signal.SIGTERM, self._end)
        if self._before[signal.SIGINT] is signal.default_int_handler:  # nobody has it ignored
            signal.signal(signal.SIGINT, self._end)
        sys.unraisablehook = self._discarded
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0.0)
        for number, handler in self._before.items():
            signal.signal(number, handler)
        sys.unraisablehook = self._hook

    def raise_waiting(self) -> None:
        """Raise what a signal asked for that still waits.

        Raises
        ------
        KeyboardInterrupt
            After SIGINT.
        SystemExit
            After SIGTERM, with the exit code of a process that it ended.
        """
        number, self._waiting, self._ticks = self._waiting, None, 0
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        if number is not None:
            raise SystemExit(128 + number)

    def _end(self, number: int, frame: FrameType | None) -> None:
        self._waiting = number
        if self._ticks == _MOST_TICKS or not _is_deaf(frame) or not self._ask_again():
            self.raise_waiting()

    def _ask_again(self) -> bool:
        """Return whether the signal will come again, a tick later."""
        if not hasattr(signal, "setitimer"):
            return False
        self._ticks += 1
        signal.signal(signal.SIGALRM, self._tick)
        signal.setitimer(signal.ITIMER_REAL, _TICK_S)
        return True

    def _tick(self, _: int, frame: FrameType | None) -> None:
        if self._waiting is not None:
            self._end(self._waiting, frame)

    def _discarded(self, discarded: sys.UnraisableHookArgs) -> None:
        if not isinstance(discarded.exc_value, KeyboardInterrupt | SystemExit):
            self._hook(discarded)
            return
        self._waiting = signal.SIGINT if isinstance(discarded.exc_value, KeyboardInterrupt) else signal.SIGTERM
        self._ask_again()


def _is_deaf(frame: FrameType | None) -> bool:
    """Return True if an import or a function that swallows exceptions is on the stack."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib") or frame.f_code.co_name in _DEAF:
            return True
        frame = frame.f_back
    return False
