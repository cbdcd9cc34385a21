"""Packages that sources and sinks need beside those of phasemark."""

from __future__ import annotations

import importlib
from typing import Any

from phasemark import UsageError


def needed(module: str, purpose: str, extra: str) -> Any:
    """Return a module of an optional package.

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
            f"{purpose} needs the package {package}: pip install -e '.[{extra}]' in the clone of phasemark"
        ) from None
