"""A page on localhost with zones, residuals, pose and status, which server-sent events update."""

from __future__ import annotations

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.live.picture import Pictures
from phasemark.matcher.live.sinks import Sink
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update

_EVERY_S = 0.1


class PageView(Sink):
    """Serves the page; who looks at it costs a rendering of the landmark ten times a second.

    Parameters
    ----------
    port : int
        Of 127.0.0.1; 0 takes a free one.
    bank : Bank or None
        Landmarks that are rendered; None of a rig among walls.

    Attributes
    ----------
    port : int

    Raises
    ------
    UsageError
        The port is taken.
    """

    def __init__(self, port: int, bank: Bank | None) -> None:
        super().__init__("page")
        self._pictures = Pictures(bank)
        self._changed, self._event, self._watchers = threading.Condition(), "", 0
        self._facts: dict[str, Any] = {}
        self._next_s, self._is_over = 0.0, False
        try:
            self._server = ThreadingHTTPServer(("127.0.0.1", port), self._handler())
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise UsageError(f"the page's port {port} cannot be used ({reason}): give another one") from None
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True).start()

    def update(self, update: Update) -> None:
        """Send a picture to those who look, unless that was done a moment ago."""
        if self._watchers and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _EVERY_S
            self._send({**self._pictures.of(update), "status": self._facts})

    def status(self, status: Status) -> None:
        """Send the status, also where no frames come."""
        self._facts = status.as_dict()
        if self._watchers:
            self._send({"status": self._facts})

    def _send(self, facts: dict[str, Any]) -> None:
        with self._changed:
            self._event = json.dumps(facts, allow_nan=False)
            self._changed.notify_all()

    def close(self) -> None:
        """Stop serving."""
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        self._server.shutdown()
        self._server.server_close()

    def _handler(self) -> type[BaseHTTPRequestHandler]:
        view = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                if self.path == "/":
                    self._begin("text/html; charset=utf-8")
                    self.wfile.write(files("phasemark.matcher.live").joinpath("page.html").read_bytes())
                elif self.path == "/events":
                    self._begin("text/event-stream")
                    view._serve_events(self)
                else:
                    self.send_error(404)

            def _begin(self, kind: str) -> None:
                self.send_response(200)
                self.send_header("Content-Type", kind)
                self.send_header("Cache-Control", "no-store")
                self.end_headers()

            def log_message(self, format: str, *args: object) -> None:
                """Write no log."""

        return Handler

    def _serve_events(self, handler: BaseHTTPRequestHandler) -> None:
        """Send events to one who looks, until they leave."""
        with self._changed:
            self._watchers += 1
        try:
            while True:
                with self._changed:
                    self._changed.wait(1.0)
                    event, is_over = self._event, self._is_over
                if is_over:
                    return
                handler.wfile.write(f"data: {event}\n\n".encode() if event else b": waiting\n\n")
                handler.wfile.flush()
        except OSError:
            pass
        finally:
            with self._changed:
                self._watchers -= 1
