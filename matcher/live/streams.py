"""Streams of bytes that frames arrive on: serial port, standard input, TCP and UDP."""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from collections.abc import Callable
from typing import Any
from urllib.parse import parse_qs, urlsplit

from phasemark import UsageError
from phasemark.inputs.extras import needed

_CHUNK = 1 << 16
_WAIT_S = 0.05
"""How long a read waits at most: a source is stopped within that."""


class Stream:
    """Stream of bytes that may break and come back: a port, a socket, or standard input.

    Parameters
    ----------
    name : str
        As the user gave it.
    opened : callable
        Opens it and returns what has a `fileno()` and a `close()`; an OSError tells why it cannot be opened.
    ends : bool
        Whether its end is the end of the work, not a fault.
    datagrams : bool
        Whether what arrives at once is whole lines.
    """

    def __init__(self, name: str, opened: Callable[[], Any], *, ends: bool = False, datagrams: bool = False) -> None:
        self.name, self.ends = name, ends
        self._opened, self._datagrams = opened, datagrams

    def open(self) -> None:
        """Open it."""
        self._file = self._opened()

    def read(self) -> bytes | None:
        """Return what has arrived, None where nothing did for a moment; b"" at the end."""
        ready, _, _ = select.select([self._file.fileno()], [], [], _WAIT_S)
        if not ready:
            return None
        found = os.read(self._file.fileno(), _CHUNK)
        return found + b"\n" if self._datagrams and not found.endswith(b"\n") else found

    def close(self) -> None:
        """Close it; standard input is not ours."""
        if self._file is not sys.stdin:
            self._file.close()


class Lines:
    """Lines of a stream, as a file that boards' parsers read; it ends where the stream breaks, stalls or is stopped.

    Parameters
    ----------
    stream : Stream
        Open.
    stalls_after_s : float
    """

    def __init__(self, stream: Stream, stalls_after_s: float) -> None:
        self._stream, self._stalls_after_s = stream, stalls_after_s
        self._held = bytearray()
        self._since = time.monotonic()
        self.is_stopped = False
        self.received_s = self._since
        """When the last byte of the last line arrived, on the monotonic clock."""
        self.fault = ""
        """Why there are no more lines."""

    def unread(self, lines: bytes) -> None:
        """Put lines back, to be read again."""
        self._held[:0] = lines

    def readline(self, limit: int) -> bytes:
        """Return the next line, at most `limit` bytes of it; b"" where there are no more."""
        while not self.is_stopped:
            end = self._held.find(b"\n", 0, limit)
            if end >= 0 or len(self._held) >= limit:
                end = end + 1 if end >= 0 else limit
                line = bytes(self._held[:end])
                del self._held[:end]
                return line
            found = self._stream.read()
            now = time.monotonic()
            if found:
                self._held += found
                self._since = self.received_s = now
            elif found is not None and self._held and self._stream.ends:  # a last line without an end
                line = bytes(self._held)
                self._held.clear()
                return line
            elif found is not None:
                self.fault = "has ended"
                return b""
            elif now - self._since > self._stalls_after_s:
                self.fault = f"has sent nothing for {now - self._since:.1f} s"
                self._since = now
                return b""
        return b""


def open_stream(name: str) -> Stream | None:
    """Return the stream that a name stands for, None if it is of another kind.

    Raises
    ------
    UsageError
        The address is wrong, or a package is missing.
    """
    if name == "-":
        return Stream(name, lambda: sys.stdin, ends=True)
    if "://" not in name:
        return _serial(name, name, 115200) if name.startswith("/dev/") else None
    parts = urlsplit(name)
    if parts.scheme == "serial":
        query = parse_qs(parts.query)
        try:
            baud = int(query.get("baud", ["115200"])[0])
        except ValueError:
            raise UsageError(
                f"{name}: 'baud' must be a whole number, as in serial:///dev/ttyUSB0?baud=921600"
            ) from None
        return _serial(name, parts.netloc + parts.path, baud)
    if parts.scheme in ("tcp", "udp"):
        host, port = address_of(name)
        if parts.scheme == "udp":
            return Stream(name, lambda: _bound(host or "0.0.0.0", port), datagrams=True)
        return Stream(name, lambda: socket.create_connection((host or "0.0.0.0", port), timeout=1.0))
    return None


def _serial(name: str, path: str, baud: int) -> Stream:
    """Return a serial port, or a pseudo-terminal."""
    serial = needed("serial", f"the serial port {path}", "live")

    def opened() -> Any:
        port = serial.Serial(path, baud, timeout=0)
        port.reset_input_buffer()  # what came before is old
        return port

    return Stream(name, opened)


def _bound(host: str, port: int) -> socket.socket:
    """Return a socket to which datagrams of whole lines are sent."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.bind((host, port))
    return bound


def address_of(name: str) -> tuple[str, int]:
    """Return host and port of an address such as ``tcp://robot:5000``.

    Raises
    ------
    UsageError
        It has no port.
    """
    try:
        parts = urlsplit(name)
        port = parts.port
    except ValueError:
        port = None
    if port is None:
        raise UsageError(f"{name}: must have a port, as in {name.partition(':')[0]}://127.0.0.1:5000")
    return parts.hostname or "", port
