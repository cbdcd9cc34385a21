"""Progress callbacks for long-running work."""

from __future__ import annotations

import threading
from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Called with how many steps are done, and of how many."""


def counter(progress: Progress | None, total: int) -> Callable[[], None]:
    """Return a function that counts one step and reports it; the total grows where it was too small.

    Parameters
    ----------
    progress : callable (done, total), optional
        None: nothing is reported.
    total : int
        Steps reckoned with.

    Returns
    -------
    callable
        Threads may call it at the same time.
    """
    done, lock = 0, threading.Lock()

    def step() -> None:
        nonlocal done
        with lock:
            done += 1
            if progress is not None:
                progress(done, max(total, done))

    return step
