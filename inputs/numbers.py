"""Numbers as messages write them."""

from __future__ import annotations

from collections.abc import Iterable


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
