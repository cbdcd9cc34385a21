"""A live session: the newest frame of a source is located, and the pose published if it is accepted."""

from __future__ import annotations

import contextlib
import errno
import queue
import threading
import time
from collections.abc import Callable, Sequence
from operator import methodcaller

from phasemark import StorageError
from phasemark.matcher.live.sinks import Sink
from phasemark.matcher.live.sources import Arrival, Source, SourceFault
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.tracker import Locator
from phasemark.matcher.live.updates import Update

_DISK_FAILED = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
_RETRY_S = 0.2
"""Pause before a source is opened again."""
_SETTLES = 5
"""Frames whose stamps have to run forward after a jump before a pose is published: two boards on a port never do."""
_DRIFT = 1e-4
"""By how much the source's clock may run slow against ours, seconds a second."""


class Live:
    """Locates the frames of a source as they come, and publishes accepted poses.

    Parameters
    ----------
    source : Source
    locator : Locator
        Such as a :class:`~phasemark.matcher.live.Tracker`.
    sinks : sequence of Sink
        Each gets every :class:`Update`, and publishes a pose only if its `reason` is empty.
    delay_s : float
        Added to a stamp to get the time of its pose.
    say : callable, optional
        Called with a line about what happened to the source or a sink.
    """

    def __init__(
        self,
        source: Source,
        locator: Locator,
        sinks: Sequence[Sink] = (),
        *,
        delay_s: float = 0.0,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self.source, self.locator, self.sinks = source, locator, tuple(sinks)
        self.status = Status(source.name)
        self._delay_s, self._say = delay_s, say or (lambda line: None)
        self._said, self._failed = "", set[str]()
        self._stop = threading.Event()
        self._newest: queue.Queue[Arrival] = queue.Queue(1)
        self._is_over, self._error = threading.Event(), list[Exception]()
        self._number = -1
        self._offset_s: float | None = None
        self._held, self._stuck = 0, tuple[str, ...]()
        self._to_unix_s = time.time() - time.monotonic()

    def stop(self) -> None:
        """Let :meth:`run` return soon; may be called from a signal handler or another thread."""
        self._stop.set()

    def run(self, on_update: Callable[[Update], None] | None = None, every_s: float = 0.5) -> Status:
        """Run until the source ends, or :meth:`stop` is called; then close the sinks.

        Parameters
        ----------
        on_update : callable, optional
            Called with each update.
        every_s : float
            Interval at which sinks get the status, seconds.

        Raises
        ------
        UsageError
            It is not known what the source's numbers mean.
        StorageError
            A disk was full or failed, and what a sink had to write is not whole. The session goes on all the same.
        """
        reader = threading.Thread(target=self._read, daemon=True)
        reader.start()
        next_status = time.monotonic()
        try:
            while not self._stop.is_set():
                try:
                    update = self._located(self._newest.get(timeout=0.05))
                    self._for_sinks(methodcaller("update", update))
                    if on_update is not None:
                        on_update(update)
                except queue.Empty:
                    if self._is_over.is_set() and self._newest.empty():
                        break
                if time.monotonic() >= next_status:
                    next_status = time.monotonic() + every_s
                    self._report()
        finally:
            self._stop.set()
            self.source.stop()
            self._report()
            self._for_sinks(methodcaller("close"))
            self.locator.close()
            reader.join(1.0)
        if self._error:
            raise self._error[0]
        return self.status

    def _read(self) -> None:
        """Put the source's frames where they are taken; open it again after a fault."""
        while not self._stop.is_set():
            try:
                for arrival in self.source.frames():
                    self.status.fault = self._said = ""
                    self._put(arrival)
                    if self._stop.is_set():
                        return
                self._is_over.set()
                return
            except SourceFault as fault:
                self.status.fault = str(fault)
                if str(fault) != self._said:
                    self._said = str(fault)
                    self._say(f"{fault}; tried again")
                self._stop.wait(_RETRY_S)
            except Exception as error:  # what a user has to mend, or a fault of ours: told by the caller's thread
                self._error.append(error)
                self._is_over.set()
                return

    def _put(self, arrival: Arrival) -> None:
        """Put a frame in the place of one that nobody took in time, which is counted; recorded ones wait for that."""
        while not self._stop.is_set():
            try:
                self._newest.put(arrival, timeout=0.0 if self.source.is_live else 0.05)
                return
            except queue.Full:
                if self.source.is_live:
                    with contextlib.suppress(queue.Empty):
                        self._newest.get_nowait()
                        self.status.dropped += 1

    def _located(self, arrival: Arrival) -> Update:
        """Return what a frame shows."""
        self._number += 1
        stamps = arrival.frames.time_s
        received = arrival.received_s + self._to_unix_s
        stamp = received if stamps is None else float(stamps.flat[0])
        located = self.locator.locate(arrival.frames, stamp)
        if located.note:
            self._held, self._offset_s = _SETTLES, None
            self._say(f"{self.source.name}: {located.note}")
        if located.stuck != self._stuck:
            self._say(f"{self.source.name}: {', '.join(located.stuck) or 'no sensor'} is stuck and left out")
        self._stuck, reason = located.stuck, located.estimate.reason
        if self._held:
            self._held, reason = self._held - 1, reason or "clock"
        latency_s = time.monotonic() - arrival.received_s
        self.status.damaged = self.source.n_damaged
        why = located.match.reason if located.match is not None else ""
        self.status.note(f"{reason}: {why}" if reason and why else reason, latency_s, located.tracked)
        shown = stamp + self._delay_s - located.aged_s
        on_ours = shown + self._offset(stamp, received) if self.source.is_live else shown
        return Update(self._number, arrival.frames, stamp, shown, on_ours, located, reason, latency_s)

    def _offset(self, stamp_s: float, received_s: float) -> float:
        """Return what our clock shows more than the source's: the least that was seen, for frames come late alone."""
        apart = received_s - stamp_s
        if self._offset_s is None or abs(apart - self._offset_s) > 1.0:
            self._offset_s = apart
        self._offset_s = min(self._offset_s + _DRIFT / 15, apart)
        return self._offset_s

    def _report(self) -> None:
        self._for_sinks(lambda sink: sink.status(self.status))

    def _for_sinks(self, act: Callable[[Sink], None]) -> None:
        """Let each sink act; one that fails is said in a line, once, and used again with the next frame.

        The first failure of a disk is an error when the session is over.
        """
        for sink in self.sinks:
            try:
                act(sink)
            except OSError as error:
                line = f"{sink.name}: {error.strerror or error}"
                if error.errno in _DISK_FAILED and not self._error:
                    self._error.append(StorageError(f"{line}; what was to be written there is not whole"))
                if isinstance(error, BrokenPipeError) and sink.name == "-":  # nobody reads standard output any more
                    self._error.append(error)
                    self._stop.set()
                elif line not in self._failed:
                    self._failed.add(line)
                    self._say(line)
