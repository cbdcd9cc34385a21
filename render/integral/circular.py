"""Cosines and sines of many phases at once: plain arithmetic, which the compiler turns into vector instructions."""

from __future__ import annotations

import math

from phasemark.render.kernel import kernel

_PER_QUARTER = 2 / math.pi
# π/2 in three parts; a multiple of the first two is exact up to 2²⁰ quarters (fdlibm's reduction)
_QUARTER, _QUARTER_REST, _QUARTER_LAST = (
    1.57079632673412561417e00,
    6.07710050630396597660e-11,
    2.02226624879595063154e-21,
)
# fdlibm's polynomials on ± π/4
_S1, _S2, _S3 = -1.66666666666666324348e-01, 8.33333333332248946124e-03, -1.98412698298579493134e-04
_S4, _S5, _S6 = 2.75573137070700676789e-06, -2.50507602534068634195e-08, 1.58969099521155010221e-10
_C1, _C2, _C3 = 4.16666666666666019037e-02, -1.38888888888741095749e-03, 2.48015872894767294178e-05
_C4, _C5, _C6 = -2.75573143513906633035e-07, 2.08757232129817482790e-09, -1.13596475577881948265e-11


@kernel
def turn(n, order, phase, amplitude, real, imaginary):  # type: ignore[no-untyped-def]
    """Write amplitude · exp(i · order · phase) of the first n entries into `real` and `imaginary`; all (m,) float64.

    Good to 2e-16 of the amplitude for products below 1e6 rad.
    """
    for k in range(n):
        x = order * phase[k]
        quarters = math.floor(x * _PER_QUARTER + 0.5)
        r = ((x - quarters * _QUARTER) - quarters * _QUARTER_REST) - quarters * _QUARTER_LAST
        q = r * r
        sine = r + r * q * (_S1 + q * (_S2 + q * (_S3 + q * (_S4 + q * (_S5 + q * _S6)))))
        cosine = (1.0 - 0.5 * q) + q * q * (_C1 + q * (_C2 + q * (_C3 + q * (_C4 + q * (_C5 + q * _C6)))))
        of_four = quarters - 4.0 * math.floor(0.25 * quarters)
        odd = (of_four == 1.0) | (of_four == 3.0)
        re = sine if odd else cosine
        im = cosine if odd else sine
        real[k] = amplitude[k] * (-re if (of_four == 1.0) | (of_four == 2.0) else re)
        imaginary[k] = amplitude[k] * (-im if of_four >= 2.0 else im)
