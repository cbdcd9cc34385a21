"""Information matrices: their inverse, what nuisances leave of them, and the direction known worst.

A direction is weak where the eigenvalue of the information there is not above a share of the largest one, 1e-12 unless
stated, in natural units (a centimetre, a degree): less than that is rounding. What becomes of it is stated by who asks:

| ``weak`` | covariance |
|---|---|
| ``"nan"`` | NaN altogether: a frame that does not tell one parameter has no covariance to report |
| ``"wide"`` | a standard deviation of 1e8, where the diagonal of the information is 1: the others can be used |
| ``"none"`` | nothing along the direction, the pseudo-inverse: what is not observed carries no other error |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Weak = Literal["nan", "wide", "none"]
"""What becomes of a weak direction; see the table above."""

NATURAL_UNITS: dict[str, float] = {
    "distance_m": 0.01,
    "delta_rad": math.radians(1),
    "bearing_rad": math.radians(1),
    "height_m": 0.01,
    "pitch_rad": math.radians(1),
    "roll_rad": math.radians(1),
}
"""Lengths in centimetres and angles in degrees make a condition number that means something."""

_WEAK_SHARE = 1e-12


def covariance_of(
    information: NDArray[np.float64],
    scale: NDArray[np.float64] | None = None,
    *,
    weak: Weak = "nan",
    weak_share: float = _WEAK_SHARE,
) -> NDArray[np.float64]:
    """Return the covariance that information matrices mean: their inverse, with a stated rule for weak directions.

    Parameters
    ----------
    information : (n, p, p) or (p, p) float64
        Symmetric.
    scale : (p,) float64, optional
        Natural units of the parameters, in which eigenvalues are compared; None: they are natural already.
    weak : {"nan", "wide", "none"}
        What becomes of directions that are not observed, see the table of this module. "none" decides on what is weak
        as :func:`numpy.linalg.pinv` does.
    weak_share : float
        Share of the largest eigenvalue that a direction must exceed.

    Returns
    -------
    float64, of the same shape

    Examples
    --------
    >>> covariance_of(np.diag([4.0, 0.25])).tolist()
    [[0.25, 0.0], [0.0, 4.0]]
    >>> covariance_of(np.diag([4.0, 0.0])).tolist()
    [[nan, nan], [nan, nan]]
    >>> covariance_of(np.diag([4.0, 0.0]), weak="none").tolist()
    [[0.25, 0.0], [0.0, 0.0]]
    """
    unit = None if scale is None else np.outer(scale, scale)
    matrix = information if unit is None else information * unit
    if weak == "none":
        found = np.asarray(np.linalg.pinv(matrix, hermitian=True), np.float64)
    elif weak == "wide":
        found = _wide(matrix, weak_share)
    else:
        found = _or_nan(matrix, weak_share)
    return found if unit is None else found * unit


def _or_nan(matrix: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Return the inverses of (…, p, p) matrices, NaN where a direction is weak."""
    stacked = matrix.reshape(-1, *matrix.shape[-2:])
    out = np.full(stacked.shape, np.nan)
    finite = np.asarray(np.isfinite(stacked).all(axis=(1, 2)))
    values, vectors = np.linalg.eigh(np.where(finite[:, None, None], stacked, 0.0))
    good = finite & (values[:, 0] > share * values[:, -1]) & (values[:, 0] > 0)
    v, w = vectors[good], values[good]
    out[good] = np.einsum("mij,mj,mkj->mik", v, 1 / w, v)
    return out.reshape(matrix.shape)


def _wide(matrix: NDArray[np.float64], share: float) -> NDArray[np.float64]:
    """Return the inverse of a (p, p) matrix scaled to a diagonal of 1, with 1e8 units along weak directions."""
    root = np.sqrt(np.maximum(np.diag(matrix), 1e-20))
    values, vectors = np.linalg.eigh(matrix / np.outer(root, root))
    unit = vectors / np.where(values > share, np.sqrt(np.maximum(values, 1e-300)), 1e-8)
    return np.asarray((unit @ unit.T) / np.outer(root, root))


def eliminated(information: NDArray[np.float64], p: int) -> NDArray[np.float64]:
    """Return the information in the first p parameters when the others are unknown (Schur complement).

    Parameters
    ----------
    information : (n, q, q) float64
    p : int
    """
    if information.shape[-1] == p:
        return information
    a, b, c = information[:, :p, :p], information[:, :p, p:], information[:, p:, p:]
    return np.asarray(a - b @ np.linalg.pinv(c) @ b.transpose(0, 2, 1))


def weak_direction(
    parameters: Sequence[str],
    *,
    information: NDArray[np.float64] | None = None,
    covariance: NDArray[np.float64] | None = None,
) -> tuple[float, dict[str, float]]:
    """Return the condition number of an information matrix or of a covariance, and the direction known worst.

    Parameters
    ----------
    parameters : sequence of str
        Those of the view that the matrix is in; lengths count in centimetres, angles in degrees.
    information, covariance : (p, p) float64
        One of them.

    Returns
    -------
    condition : float
        Infinite where a direction is not observed, or the information is not finite; NaN for a covariance that is not.
    direction : dict of str to float
        The standard deviation along the worst direction, by parameter, metres and radians; its largest part, in the
        units of the condition number, is positive. Empty where the condition is not finite.
    """
    scale = np.array([NATURAL_UNITS[name] for name in parameters])
    if information is not None:
        if not np.isfinite(information).all():
            return math.inf, {}
        values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    else:
        assert covariance is not None
        if not np.isfinite(covariance).all():
            return math.nan, {}
        values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    if values[0] <= 0:
        return math.inf, {}
    worst = vectors[:, 0 if information is not None else -1]
    sign = np.sign(worst[np.abs(worst).argmax()])  # one sign for one direction
    if information is not None:
        along = worst * sign / math.sqrt(values[0]) * scale
    else:
        along = worst * math.sqrt(values[-1]) * scale * sign
    return float(values[-1] / values[0]), dict(zip(parameters, along.tolist(), strict=True))
