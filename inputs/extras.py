"""Packages of the optional extras, imported where they are needed."""

from __future__ import annotations

import importlib
from typing import Any

from phasemark import UsageError


def needed(module: str, purpose: str, extra: str, *, verb: str = "needs") -> Any:
    """Return a module of an optional package; a message begins with the purpose and its verb.

    Raises
    ------
    UsageError
        It is not installed; says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError:
        package = module.partition(".")[0]
        raise UsageError(
            f"{purpose} {verb} the package {package}: pip install -e '.[{extra}]' in the clone of phasemark"
        ) from None
