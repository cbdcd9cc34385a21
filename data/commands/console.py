"""Output of commands: tables, JSON and facts to standard output; notes, errors and progress to standard error."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

import typer

from phasemark.data.commands.flag_wording import in_flags

if TYPE_CHECKING:
    from rich.progress import Progress


PROGRESS_SECONDS = 10.0
"""Time between two lines of progress where stderr is no terminal; work that takes less writes none."""


class LongWork:
    """Progress on stderr, reported by a call with (done, total): a bar on a terminal, a line now and then elsewhere.

    The lines come from a thread of their own, so that work which reports nothing for long is heard of all the same.
    """

    def __init__(self, what: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._what, self._clock = what, clock
        self._bar: Progress | None = None
        self._reported: tuple[int, int] | None = None
        self._ended = threading.Event()
        self._lines: threading.Thread | None = None

    def __enter__(self) -> Callable[[int, int], None]:
        if not sys.stderr.isatty():
            self._begun = self._clock()
            self._lines = threading.Thread(target=self._write_lines, daemon=True)
            self._lines.start()
            return self._note
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        # results printed meanwhile go above the bar, but not where standard output is no terminal
        redirect = sys.stdout.isatty()
        self._bar = Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=redirect)
        self._bar.start()
        task = self._bar.add_task(self._what, total=None)
        bar = self._bar
        return lambda done, total: bar.update(task, completed=done, total=total)

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.stop()
        self._ended.set()
        if self._lines is not None:
            self._lines.join()

    def _note(self, done: int, total: int) -> None:
        self._reported = done, total

    def _write_lines(self) -> None:
        while not self._ended.wait(PROGRESS_SECONDS):
            tell(self._line())

    def _line(self) -> str:
        done = "" if self._reported is None else f" {self._reported[0]}/{self._reported[1]},"
        return f"{self._what}:{done} {duration(self._clock() - self._begun)} elapsed"


def duration(seconds: float) -> str:
    """Write a time in whole seconds, minutes and hours."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"


def echo(*lines: object) -> None:
    """Print one thing a line."""
    for line in lines:
        typer.echo(line)


def echo_facts(facts: Mapping[str, Any], *, as_json: bool = False) -> None:
    """Print one fact a line, names aligned; or all of them as JSON."""
    if as_json:
        return echo_json(facts)
    rows = []
    for key, value in facts.items():
        if isinstance(value, Mapping):
            value = ", ".join(f"{k} {v}" for k, v in value.items())
        elif isinstance(value, list | tuple):
            value = ", ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in value)
        elif isinstance(value, float):
            value = f"{value:.6g}"
        rows.append((key.replace("_", " "), str(value)))
    Table().echo(rows)


@contextmanager
def warnings_as_notes() -> Iterator[None]:
    """Write each thing the library warns of as one line, ``note: …``, to stderr, and once."""
    said = set[str]()

    def show(message: Warning | str, *where: object, **more: object) -> None:
        note = f"note: {in_flags(one_line(str(message)))}"
        if note not in said:
            said.add(note)
            tell(note)

    with warnings.catch_warnings():
        warnings.simplefilter("always", UserWarning)
        warnings.showwarning = show
        yield


def echo_json(value: object) -> None:
    """Print a result for machines; NaN and infinity are no JSON and must have become null before."""
    typer.echo(json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False))


def echo_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print aligned columns."""
    Table(header).echo(rows)


class Table:
    """Aligned columns that are printed in pieces: the header with the first, and later ones as wide at least.

    Parameters
    ----------
    header : sequence of str, optional
        Without it rows are printed alone.
    """

    def __init__(self, header: Sequence[str] | None = None) -> None:
        self._header = header
        self._widths: list[int] = []

    def echo(self, rows: Iterable[Sequence[str]]) -> None:
        """Print some rows; on a terminal that is too narrow for them, long cells are folded."""
        from rich.cells import cell_len
        from rich.console import Console
        from rich.table import Column
        from rich.table import Table as Grid
        from rich.text import Text

        pieces = [list(row) for row in rows]
        if self._header is not None:
            pieces.insert(0, list(self._header))
            self._header = None
        if not pieces:
            return
        known = self._widths or [0] * len(pieces[0])
        self._widths = [
            max(width, *map(cell_len, column)) for width, column in zip(known, zip(*pieces, strict=True), strict=True)
        ]
        gap = 2  # spaces between two columns
        full = sum(self._widths) + gap * len(self._widths)
        console = Console(width=None if sys.stdout.isatty() else full, highlight=False)
        fits = full <= console.width
        grid = Grid.grid(*(Column(min_width=width if fits else None) for width in self._widths), padding=(0, gap, 0, 0))
        for piece in pieces:
            grid.add_row(*map(Text, piece))
        with console.capture() as printed:
            console.print(grid)
        for line in printed.get().splitlines():
            typer.echo(line.rstrip())


def report_error(message: str) -> None:
    """Write one line, ``error: …``, to stderr; red where stderr is a terminal."""
    from rich.console import Console
    from rich.text import Text

    with _messages_may_be_lost():
        Console(stderr=True).print(Text.assemble(("error: ", "bold red"), in_flags(one_line(message))), soft_wrap=True)


def tell(message: str) -> None:
    """Write a line to stderr."""
    with _messages_may_be_lost():
        typer.echo(message, err=True)


@contextmanager
def _messages_may_be_lost() -> Iterator[None]:
    """Ignore errors of writing messages to a closed stderr: they change neither the work nor its exit code."""
    try:
        yield
    except (OSError, ValueError):
        with suppress(OSError, ValueError):  # what is left in the buffer must not fail at exit
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def one_line(message: str) -> str:
    r"""Return a message without line breaks and control characters; bytes of a name that are not UTF-8 as ``\xNN``."""
    return "".join(char if char.isprintable() else " " for char in readable(message))


def readable(name: str) -> str:
    r"""Return text that can be written as UTF-8: bytes of a file's name that are not become ``\xNN``."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")
