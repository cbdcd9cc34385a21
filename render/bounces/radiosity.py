"""Radiosity with phasors: how much light arrives at patches by way of others, at any number of bounces (PHYSICS 12)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.background import Bounces
from phasemark.render.bounces.transport import Operator

_MOST = 1000
"""Bounces after which light that still goes on is given up."""
_REST = 0.1
"""Share of the tolerance that the light left out may come to: a bounce costs little beside the patches."""
_SMALL = 1e-2
"""Powers of a free albedo whose coefficients are below this share of the tolerance are left out."""


def arriving(
    lamp: NDArray[np.complex128],
    operator: Operator,
    albedo: NDArray[np.float64],
    bounces: Bounces,
    tolerance: float,
    free: NDArray[np.bool_] | None = None,
) -> NDArray[np.complex128]:
    """Return the light that arrives at patches after one bounce or more.

    The light of each bounce follows from that of the one before; their sum solves
    E = K ρ (H + E), with H the light of the lamp and K the transport between patches.

    Parameters
    ----------
    lamp : (n, v) complex128
        What arrives from the lamp directly, mean over each patch, in v views: cos θ / r² · e^{iκr}.
    operator : Operator
        From :meth:`~phasemark.render.bounces.transport.Transport.operator`.
    albedo : (n,) float64
    bounces : int or "all"
        "all": until what is left is well below `tolerance`.
    tolerance : float
        Share of the light that has bounced once.
    free : (n,) bool, optional
        Patches of one unknown albedo, which `albedo` does not matter for.

    Returns
    -------
    (n, v, d) complex128
        Coefficients of the powers 0 to d − 1 of the free albedo; d = 1 where none is free.

    Raises
    ------
    UsageError
        The light does not die out.
    """
    free = np.zeros(len(albedo), np.bool_) if free is None else free
    fixed = np.where(free, 0.0, albedo)
    term = lamp[:, :, None].astype(np.complex128)
    found = np.zeros_like(term)
    first = size = 0.0
    for k in range(_MOST if bounces == "all" else int(bounces)):
        leaving = fixed[:, None, None] * term
        if free.any():
            leaving = np.pad(leaving, ((0, 0), (0, 0), (0, 1)))
            leaving[:, :, 1:] += free[:, None, None] * term
            while leaving.shape[2] > 1 and np.abs(leaving[:, :, -1]).max() <= _SMALL * tolerance * np.abs(lamp).max():
                leaving = leaving[:, :, :-1]
            found = np.pad(found, ((0, 0), (0, 0), (0, leaving.shape[2] - found.shape[2])))
        term = (operator @ leaving.reshape(len(albedo), -1)).reshape(leaving.shape)
        found = found + term
        before, size = size, float(np.abs(term).max(initial=0.0))
        first = first or size
        # what is left is at most a geometric series
        if size == 0 or (k and size < before and size * size / (before - size) <= _REST * tolerance * first):
            return found
    if bounces == "all":
        raise UsageError(
            f"after {_MOST} bounces {size / first:.0%} of the light is left: in a closed scene albedos must be below 1"
        )
    return found
