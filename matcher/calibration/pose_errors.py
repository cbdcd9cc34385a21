"""Errors of stated poses, estimated from the residuals of a calibration as variance components.

Errors of the poses are independent from pose to pose, normal, and of three sizes: places of the lens, headings, sides
δ. With the residuals r linear in the mounting (slopes A) and in those errors (slopes B, sizes s), r is normal with the
covariance V = 1 + Bᵀ diag(s²) B, and the sizes are those of the greatest restricted likelihood (Patterson & Thompson
1971),

    −2 log L = rᵀ V⁻¹ r − gᵀ H⁻¹ g + log det V + log det H ,   H = A V⁻¹ Aᵀ ,  g = A V⁻¹ r ,

which allows for the mounting having been fitted to the same residuals. V falls apart into poses.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from phasemark.matcher.calibration.known_poses import PoseStd
from phasemark.matcher.calibration.mounting_fit import Blocks

_START = (2e-4, math.radians(0.02), math.radians(0.02))
"""Where one of three descents begins; the others from 7 and 55 times as much."""
_LEAST, _MOST = (1e-6, 1e-6, 1e-6), (0.1, math.radians(10.0), math.radians(10.0))
"""Metres and radians: nothing is measured better, and nobody would call worse a known pose."""


def estimate_pose_std(blocks: Blocks) -> PoseStd:
    """Return the sizes of the poses' errors that are most likely.

    Parameters
    ----------
    blocks : Blocks
        Residuals without any errors of the poses, and slopes by errors of unit size (PoseStd(1, 1, 1)).

    Returns
    -------
    PoseStd
    """
    a, b, r = blocks.mounting, blocks.pose, blocks.residual
    aa = a @ a.transpose(0, 2, 1)
    ab = a @ b.transpose(0, 2, 1)
    bb = b @ b.transpose(0, 2, 1)
    ar, br = np.einsum("kar,kr->ka", a, r), np.einsum("kbr,kr->kb", b, r)
    natural = np.sqrt(np.maximum(np.einsum("kaa->a", aa), 1e-300))

    def minus_two_log(log_size: NDArray[np.float64]) -> float:
        s = np.exp(log_size)[[0, 0, 1, 2]]
        middle = np.eye(4) + s[:, None] * bb * s
        half = ab * s
        sbr = br * s
        solved = np.linalg.solve(middle, np.concatenate([half.transpose(0, 2, 1), sbr[:, :, None]], axis=2))
        h = (aa - half @ solved[:, :, :-1]).sum(axis=0)
        g = (ar - np.einsum("kaq,kq->ka", half, solved[:, :, -1])).sum(axis=0)
        h_unit, g_unit = h / np.outer(natural, natural), g / natural
        explained = (
            np.einsum("kq,kq->", sbr, solved[:, :, -1]) + g_unit @ np.linalg.lstsq(h_unit, g_unit, rcond=None)[0]
        )
        return float(np.linalg.slogdet(middle)[1].sum() + np.linalg.slogdet(h_unit)[1] - explained)

    bounds = list(zip(np.log(_LEAST), np.log(_MOST), strict=True))
    found = [
        optimize.minimize(
            minus_two_log,
            np.log(_START) + side,
            method="Nelder-Mead",
            bounds=bounds,
            options={"xatol": 0.02, "fatol": 0.02},
        )
        for side in (0.0, 2.0, 4.0)
    ]
    best = min(found, key=lambda one: float(one.fun))
    return PoseStd(*np.exp(best.x).tolist())
