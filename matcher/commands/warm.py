"""The command ``phasemark warm``: compile beforehand what the first image and the first match would wait for."""

# Imports of what computes stand inside the functions: phasemark --help imports this module, and answers at once.

from __future__ import annotations

import time
from enum import StrEnum
from typing import Annotated

from phasemark.data.commands.command import Shown
from phasemark.data.commands.console import LongWork, duration, echo_table


class Work(StrEnum):
    """Work to compile for."""

    render = "render"
    match = "match"
    histograms = "histograms"


def warm_kernels(
    *, works: Annotated[list[Work] | None, Shown("--for", metavar="WORK", show_default=False)] = None
) -> None:
    """Compile what the first image and the first match would wait for, and keep it.

    Compiled code is kept beside the package or in the user's cache folder, until phasemark changes.

    Parameters
    ----------
    works
        What to compile for: render, match or histograms; may be repeated. Without it, for all.
    """
    from phasemark.matcher.warm import warm

    wanted, rows = list(Work) if works is None else works, []
    with LongWork("compiling") as progress:
        for k, work in enumerate(wanted):
            begun = time.monotonic()
            warm(work.value)
            rows.append((work.value, duration(time.monotonic() - begun)))
            progress(k + 1, len(wanted))
    echo_table(("ready for", "took"), rows)
