"""Numbers with their uncertainty as text: the error to two significant digits, the value to the digits of its error."""

from __future__ import annotations

import math

_EXACT = 1e-12  # an error below this share of the value is the computer's, not the measurement's
_PLAIN = ".6g"  # of a value without an error


def value_and_error(value: float, std: float | None) -> tuple[str, str]:
    """Return a value and its standard deviation as text, rounded alike.

    Parameters
    ----------
    value : float
    std : float or None
        Standard deviation in the unit of `value`; None, 0 or not finite where there is none.

    Returns
    -------
    tuple of str
        The value to the decimal place of its error, and the error to two significant digits; without an error the
        value to six significant digits, and an empty text.

    Examples
    --------
    >>> value_and_error(1.23412, 0.000204)
    ('1.23412', '0.00020')
    >>> value_and_error(35571.3, 1234.0)
    ('35600', '1200')
    """
    if std is None or not (math.isfinite(std) and math.isfinite(value)) or std <= _EXACT * abs(value):
        return f"{value:{_PLAIN}}", ""
    places = _decimal_places(std)
    return _fixed(value, places), _fixed(std, places)


def error_text(std: float) -> str:
    """Return a standard deviation as text, to two significant digits.

    Examples
    --------
    >>> error_text(0.0002)
    '0.00020'
    """
    return value_and_error(std, std)[1] or f"{std:{_PLAIN}}"


def with_error(value: float, std: float | None) -> str:
    """Return a value with its standard deviation as one text; the value alone where there is none.

    Parameters
    ----------
    value : float
    std : float or None
        In the unit of `value`.

    Examples
    --------
    >>> with_error(1.234, 0.0002)
    '1.23400 ± 0.00020'
    >>> with_error(-0.0004, 0.0996)
    '0.00 ± 0.10'
    """
    text, error = value_and_error(value, std)
    return f"{text} ± {error}" if error else text


def with_interval(value: float, low: float, high: float) -> str:
    """Return a value with its interval, all to the second significant digit of half the interval's width.

    Parameters
    ----------
    value, low, high : float
        In one unit. Without a finite interval the value stands alone, to three significant digits.

    Examples
    --------
    >>> with_interval(3.0, 2.88, 3.12)
    '3.00 [2.88, 3.12]'
    """
    half = (high - low) / 2
    if not (math.isfinite(half) and math.isfinite(value)):
        return f"{value:.3g}"
    if half <= _EXACT * abs(value):
        return f"{value:{_PLAIN}} [{low:{_PLAIN}}, {high:{_PLAIN}}]"
    places = _decimal_places(half)
    return f"{_fixed(value, places)} [{_fixed(low, places)}, {_fixed(high, places)}]"


def _decimal_places(error: float) -> int:
    """Return the decimal place of an error's last significant digit, negative before the point."""
    error_digits = 2
    exponent = int(f"{error:.{error_digits - 1}e}".split("e")[1])  # of the rounded error: 0.0996 is 0.10
    return error_digits - 1 - exponent


def _fixed(value: float, places: int) -> str:
    return f"{round(value, places) + 0.0:.{max(places, 0)}f}"  # + 0.0: no "-0.00"
