"""A board for tests: prints given lines at a rate into a pseudo-terminal, a TCP port, or as datagrams."""

from __future__ import annotations

import os
import pty
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterable


class FakeBoard:
    """Prints lines in a thread of its own.

    Parameters
    ----------
    lines : iterable of bytes
        Each with its end.
    rate_hz : float
        Lines a second.
    """

    def __init__(self, lines: Iterable[bytes], rate_hz: float) -> None:
        self._lines, self._rate_hz = lines, rate_hz
        self._stop, self.is_done = threading.Event(), threading.Event()
        self.n_sent = 0
        self._closers: list[Callable[[], None]] = []

    def on_terminal(self) -> str:
        """Print into a pseudo-terminal, and return its name."""
        own, other = pty.openpty()
        tty.setraw(own)
        tty.setraw(other)
        self._start(lambda line: os.write(own, line))
        self._closers += [lambda: os.close(own), lambda: os.close(other)]
        return os.ttyname(other)

    def on_port(self, port: int = 0) -> int:
        """Serve one connection after another, and return the port."""
        server = socket.create_server(("127.0.0.1", port))
        server.settimeout(0.05)
        self._connection: socket.socket | None = None

        def send(line: bytes) -> None:
            if self._connection is None:
                try:
                    self._connection, _ = server.accept()
                except TimeoutError:
                    return
            try:
                self._connection.sendall(line)
            except OSError:  # the reader is gone; another may come
                self._connection.close()
                self._connection = None

        self._start(send)
        self._closers += [server.close, lambda: self._connection.close() if self._connection else None]
        return int(server.getsockname()[1])

    def to_port(self, port: int) -> None:
        """Send each line as a datagram."""
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._start(lambda line: out.sendto(line, ("127.0.0.1", port)))
        self._closers.append(out.close)

    def _start(self, send: Callable[[bytes], object]) -> None:
        def run() -> None:
            began = time.monotonic()
            for k, line in enumerate(self._lines):
                while not self._stop.is_set() and time.monotonic() < began + k / self._rate_hz:
                    time.sleep(0.0005)
                if self._stop.is_set():
                    return
                send(line)
                self.n_sent += 1
            self.is_done.set()

        self._thread = threading.Thread(target=run, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Stop, and close what was printed into."""
        self._stop.set()
        self._thread.join(2.0)
        for close in self._closers:
            close()
        self._closers = []
