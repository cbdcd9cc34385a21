"""The session in a terminal: a status line, or a picture of zones, residuals and pose."""

from __future__ import annotations

import sys
import time
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.live import Live as Screen
from rich.table import Table
from rich.text import Text

from phasemark.data import Bank
from phasemark.matcher.live.picture import Pictures
from phasemark.matcher.live.sinks import Sink
from phasemark.matcher.live.status import Status
from phasemark.matcher.live.updates import Update

_EVERY_S = 0.2
"""Time between two pictures: each renders the landmark once."""
_FAR_M, _OFF_MM = 2.0, 20.0
"""Range and residual at the ends of the colours."""


class StatusLine(Sink):
    """One line on standard error that the next one replaces."""

    def __init__(self) -> None:
        super().__init__("status")

    def update(self, update: Update) -> None:
        """Wait for the status."""

    def status(self, status: Status) -> None:
        """Show the status."""
        sys.stderr.write(f"\r\x1b[2K{status.line()[:150]}")
        sys.stderr.flush()

    def close(self) -> None:
        """End the line."""
        sys.stderr.write("\n")


class TerminalView(Sink):
    """Zones, residuals and pose on standard error, some times a second.

    Parameters
    ----------
    bank : Bank or None
        Landmarks that are rendered; None of a rig among walls.
    """

    def __init__(self, bank: Bank | None) -> None:
        super().__init__("view")
        self._pictures = Pictures(bank)
        self._screen = Screen(console=Console(stderr=True), auto_refresh=False, transient=False)
        self._screen.start()
        self._next_s, self._line = 0.0, ""

    def update(self, update: Update) -> None:
        """Draw, unless that was done a moment ago."""
        if time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + _EVERY_S
            self._screen.update(drawn(self._pictures.of(update), self._line), refresh=True)

    def status(self, status: Status) -> None:
        """Take the line below the picture."""
        self._line = status.line()

    def close(self) -> None:
        """Leave the last picture."""
        self._screen.stop()


def drawn(picture: dict[str, Any], line: str) -> RenderableType:
    """Return a picture for a terminal, with a line below it."""
    table = Table.grid(padding=(0, 3))
    table.add_row("range", f"residual (± {_OFF_MM:g} mm)", "pose")
    table.add_row(
        _image(picture["range_m"], 0.0, _FAR_M), _image(picture["residual_mm"], -_OFF_MM, _OFF_MM), _pose(picture)
    )
    return Group(table, Text(line, style="dim"))


def _image(rows: list[list[float | None]] | None, low: float, high: float) -> Text:
    """Return zones as coloured blocks, two columns each; those without a value are dots."""
    text = Text()
    for row in rows or []:
        for value in row:
            if value is None:
                text.append("· ", style="grey42")
                continue
            share = min(max((value - low) / (high - low), 0.0), 1.0)
            red, blue = round(40 + 215 * share), round(255 - 215 * share)
            green = round(200 - 240 * abs(share - 0.5))
            text.append("██", style=f"rgb({red},{green},{blue})")
        text.append("\n")
    return text if rows else Text("no landmark", style="grey42")


def _pose(picture: dict[str, Any]) -> Text:
    if picture["reason"]:
        return Text(f"not published: {picture['reason']}", style="yellow")
    std = picture["std"]
    return Text(
        f"x       {picture['x_m']:8.3f} ± {std[0]:.3f} m\n"
        f"y       {picture['y_m']:8.3f} ± {std[1]:.3f} m\n"
        f"heading {picture['heading_deg']:8.2f} ± {std[2]:.2f}°",
        style="green",
    )
