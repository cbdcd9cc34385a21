"""Streams of bytes that frames arrive on: serial port, standard input, TCP and UDP."""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from abc import ABC, abstractmethod
from urllib.parse import parse_qs, urlsplit

from phasemark import UsageError
from phasemark.matcher.live.extras import needed

_CHUNK = 1 << 16
_WAIT_S = 0.05
"""How long a read waits at most: a source is stopped within that."""


class Stream(ABC):
    """Stream of bytes that may break and come back.

    Parameters
    ----------
    name : str
        As the user gave it.
    """

    ends = False
    """Whether its end is the end of the work, not a fault."""

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def open(self) -> None:
        """Open it; an OSError tells why it cannot be opened."""

    @abstractmethod
    def read(self) -> bytes | None:
        """Return what has arrived, None where nothing did for a moment; b"" at the end."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""


class SerialStream(Stream):
    """Serial port, or a pseudo-terminal."""

    def __init__(self, name: str, path: str, baud: int) -> None:
        super().__init__(name)
        self._serial = needed("serial", f"the serial port {path}", "live")
        self._path, self._baud = path, baud

    def open(self) -> None:
        """Open the port."""
        self._port = self._serial.Serial(self._path, self._baud, timeout=_WAIT_S)
        self._port.reset_input_buffer()  # what came before is old

    def read(self) -> bytes | None:
        """Return what has arrived."""
        try:
            found = self._port.read(max(1, self._port.in_waiting))
        except TypeError:  # pyserial's own, where the port was closed meanwhile
            return b""
        return bytes(found) or None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class StandardInput(Stream):
    """Standard input, line by line as a pipe delivers it."""

    ends = True

    def open(self) -> None:
        """Take the file descriptor."""
        self._file = sys.stdin.fileno()

    def read(self) -> bytes | None:
        """Return what has arrived."""
        ready, _, _ = select.select([self._file], [], [], _WAIT_S)
        return os.read(self._file, _CHUNK) if ready else None

    def close(self) -> None:
        """Leave it open: it is not ours."""


class SocketStream(Stream):
    """TCP connection to a server, or datagrams of UDP that are sent to a port of ours, each with whole lines."""

    def __init__(self, name: str, host: str, port: int, *, datagrams: bool) -> None:
        super().__init__(name)
        self._address, self._datagrams = (host, port), datagrams

    def open(self) -> None:
        """Connect, or take the port."""
        if self._datagrams:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.bind(self._address)
        else:
            self._socket = socket.create_connection(self._address, timeout=1.0)
        self._socket.settimeout(_WAIT_S)

    def read(self) -> bytes | None:
        """Return what has arrived."""
        try:
            found = self._socket.recv(_CHUNK)
        except TimeoutError:
            return None
        return found if not self._datagrams or found.endswith(b"\n") else found + b"\n"

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


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
        return StandardInput(name)
    if "://" not in name:
        return SerialStream(name, name, 115200) if name.startswith("/dev/") else None
    parts = urlsplit(name)
    if parts.scheme == "serial":
        query = parse_qs(parts.query)
        try:
            baud = int(query.get("baud", ["115200"])[0])
        except ValueError:
            raise UsageError(
                f"{name}: 'baud' must be a whole number, as in serial:///dev/ttyUSB0?baud=921600"
            ) from None
        return SerialStream(name, parts.netloc + parts.path, baud)
    if parts.scheme in ("tcp", "udp"):
        host, port = address_of(name)
        return SocketStream(name, host or "0.0.0.0", port, datagrams=parts.scheme == "udp")
    return None


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
