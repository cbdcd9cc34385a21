"""Numbers: as messages write them, and as arrays whose values are all there."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from phasemark import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray


def in_words(numbers: Iterable[float]) -> str:
    """Return numbers as a sentence lists them.

    Parameters
    ----------
    numbers : iterable of float

    Returns
    -------
    str

    Examples
    --------
    >>> in_words([20e6]), in_words([20e6, 60e6])
    ('20000000', '20000000 and 60000000')
    """
    shown = [f"{number:.12g}" for number in numbers]
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def real_array(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return numbers as an array of their own, whose values are all there.

    Parameters
    ----------
    name : str
        Name of the argument, for the message.
    value : array_like

    Raises
    ------
    UsageError
        Values are complex, and would lose a part, or masked, and would lose the mask.
    """
    import numpy as np  # not above: the commands, which import this module, answer --help at once

    if np.iscomplexobj(value):
        raise UsageError(f"'{name}' must be real numbers, got complex ones")
    if np.ma.is_masked(value):
        raise UsageError(f"'{name}' must not have masked values")
    return np.array(value, dtype=np.float64)
