"""Public names of a package that are imported when they are first used, so that the package itself costs nothing.

The command line needs this: its commands stand beside what they run, and ``phasemark --help`` imports all of them.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec

__all__ = ["imported_on_use"]


def imported_on_use(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return ``__getattr__`` and ``__dir__`` of a package for the names that it imports under ``if TYPE_CHECKING:``.

    Type checkers, editors and readers see ordinary imports, and each name is stated once.

    Parameters
    ----------
    package : str
        The package's ``__name__``.

    Returns
    -------
    tuple of callable
        The first imports a name where it is asked for, and raises `AttributeError` if the package has none of that
        name. The second lists the names.
    """

    def attribute(name: str) -> object:
        if name.startswith("__") or name not in _homes(package):
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(_homes(package)[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *_homes(package)})

    return attribute, names


@cache
def _homes(package: str) -> dict[str, str]:
    """Return the module of each name that a package imports for type checkers."""
    spec = find_spec(package)
    assert spec is not None
    source = spec.loader.get_source(package)  # type: ignore[union-attr]  # every loader of source files has it
    blocks = [node for node in ast.parse(source).body if isinstance(node, ast.If)]
    imports = [node for block in blocks for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.name: node.module or "" for node in imports for alias in node.names}
