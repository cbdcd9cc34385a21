"""Programs of a user, ``module:name``: imported, and what their code raises told in one line with its traceback."""

from __future__ import annotations

import importlib
import signal
import traceback
from collections.abc import Callable
from typing import Any

from phasemark import UsageError

_TERMINATED = 128 + signal.SIGTERM
"""The exit status with which the command line ends on SIGTERM: no error of a user's module."""


def imported_program(text: str, what: str) -> Callable[..., Any]:
    """Return the callable that ``module:name`` names.

    Parameters
    ----------
    text : str
        The module, a colon, and the name in it.
    what : str
        What the callable is, for messages: ``the matcher``.

    Raises
    ------
    UsageError
        It cannot be imported: with the reason; if the module's own code failed, its traceback is a note of the error
        (:pep:`678`).
    """
    module, _, name = text.partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:
        _pass_termination(error)
        failed = UsageError(f"{what} '{text}' cannot be imported ({named(error)})")
        if own := own_traceback(error):
            failed.add_note(own)
        raise failed from None
    if not callable(found):
        raise UsageError(f"{what} '{text}' must be callable, got {type(found).__name__}")
    program: Callable[..., Any] = found
    return program


def called_program(text: str, error: BaseException, where: str) -> UsageError:
    """Return the error of a user's program that raised another, whose traceback is a note of it.

    Parameters
    ----------
    text : str
        What the program is, and its name.
    error : BaseException
        What it raised.
    where : str
        The call, and how it is repeated.
    """
    _pass_termination(error)
    failed = UsageError(f"{where}: {text} raised {named(error)}")
    failed.add_note(own_traceback(error) or named(error))
    return failed


def _pass_termination(error: BaseException) -> None:
    """Raise an exception again if SIGTERM made it, and not the user's program."""
    if isinstance(error, SystemExit) and error.code == _TERMINATED:
        raise error


def named(error: BaseException) -> str:
    """Return type and message of an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).rstrip(":")


def own_traceback(error: BaseException) -> str:
    """Return the traceback of a user's code, without our calls and those that import it; empty if nothing is left."""
    own = error.__traceback__
    while own is not None and _is_ours_or_import(own.tb_frame):
        own = own.tb_next
    return "" if own is None else "".join(traceback.format_exception(type(error), error, own)).rstrip()


def _is_ours_or_import(frame: Any) -> bool:
    filename = frame.f_code.co_filename
    ours = str(frame.f_globals.get("__name__", "")).startswith("phasemark.")
    return ours or filename == importlib.__file__ or filename.startswith("<frozen importlib")
