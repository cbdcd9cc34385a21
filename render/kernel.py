"""Compiler settings of the renderer's loops.

A kernel borrows the arrays it is given and allocates none. numba is told so (`_nrt`), for it would count references to
every array at every call and every use of a field of a tuple: atomic operations that took two fifths of the time, and
more where threads share a mesh. A function that makes an array must not be a kernel: numba refuses to compile it.
The option is not documented by numba; a version without it compiles the same functions, slower.

To numba a literal has a type of its own. What it is passed to is compiled for it, and again for other numbers, so a
counter that is passed on starts from ``np.int64(0)``.
"""

from __future__ import annotations

from typing import Any

from numba import njit
from numba.core.cpu import CPUTargetOptions

_BORROWING: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "forceinline": True}
if hasattr(CPUTargetOptions, "_nrt"):
    _BORROWING["_nrt"] = False
_NO_WAY_IN: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}

kernel = njit(**_BORROWING)
"""Compile a function that allocates nothing; floats divide as numpy's do."""

inner = njit(**_BORROWING, **_NO_WAY_IN)
"""Compile a function that compiled ones call and Python never does, which would end the process.

A way in from Python takes about a fifth of the time to compile, most of it for tuples of arrays.
"""

inlined = njit(**_BORROWING, inline="always")
"""Compile a function as a part of its one caller: numba optimises what is called again in every caller."""
