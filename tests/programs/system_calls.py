"""Act at the k-th call to the system: fail, kill this process, or do something of the test's own."""

import builtins
import errno
import io
import os
import signal
from collections.abc import Callable, Sequence
from typing import Any

from phasemark import PhasemarkError
from phasemark.data.files import renames

# Boolean operations on meshes start threads where there are several processors, and a fork waits for them forever.
_PROCESSORS = sorted(os.sched_getaffinity(0))
os.sched_setaffinity(0, {_PROCESSORS[os.getpid() % len(_PROCESSORS)]})

CALLS = (
    "pwrite", "write", "fsync", "replace", "rename", "posix_fallocate", "ftruncate", "mkdir", "rmdir", "unlink",
    "chmod", "chown",
)  # fmt: skip


class Trap:
    """Count calls and act at one of them.

    Parameters
    ----------
    at : int
        The number of the call, from 1.
    action : str or callable
        ``kill``, the name of an error number, or what is called before the call goes on.
    calls : sequence of str
        The functions of :mod:`os` that count.
    """

    def __init__(self, at: int, action: str | Callable[[], object], calls: Sequence[str] = CALLS) -> None:
        self.count, self.at, self.action = 0, at, action
        for name in calls:
            setattr(os, name, self.wrapped(getattr(os, name)))
        for name in ("rename_new", "exchange"):
            setattr(renames, name, self.wrapped(getattr(renames, name)))
        if "mkdir" in calls:  # files that Python's own objects write
            opened = self.wrapped(io.open)
            for module in (io, builtins):
                setattr(module, "open", opened)  # noqa: B010 (a type of its own)

    def wrapped(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def trapped(*arguments: Any, **options: Any) -> Any:
            self.count += 1
            if self.count == self.at:
                if callable(self.action):
                    self.action()
                elif self.action == "kill":
                    os.kill(os.getpid(), signal.SIGKILL)
                else:
                    raise OSError(getattr(errno, self.action), os.strerror(getattr(errno, self.action)))
            return call(*arguments, **options)

        return trapped


def ended(
    write: Callable[[], object], at: int, action: str | Callable[[], object], calls: Sequence[str] = CALLS
) -> int:
    """Write with a trap at a call; return the exit code: 0 without that call, 6 if it failed and nothing needed it."""
    trap = Trap(at, action, calls)
    try:
        write()
    except PhasemarkError as error:
        return error.exit_code
    return 0 if trap.count < at else 6


def in_fork(function: Callable[..., int], *arguments: Any) -> int:
    """Run a function in a child; return its exit code, −signal if it was killed."""
    child = os.fork()
    if child == 0:
        code = 99
        try:
            code = function(*arguments)
        finally:
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
