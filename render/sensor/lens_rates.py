"""Image motion by each number of a lens."""

from __future__ import annotations

import numpy as np

from phasemark.render.sensor.lens_fields import Lens
from phasemark.render.sensor.lens_map import distort

_POINTS = 9  # along each side of the image
_STEP = 1e-30  # of a complex derivative


def lens_rates(lens: Lens, rows: int, cols: int) -> dict[str, float]:
    """Return by how much a unit of each term moves the image point that it moves most, as a tangent.

    The derivative of the distorted coordinates, by complex steps; that of a focal length is x_d / fx, that of the
    principal point 1 / fx.

    Parameters
    ----------
    lens : Lens
    rows, cols : int
        Of the image.

    Examples
    --------
    >>> lens_rates(Lens(fx=10, fy=20, cx=7.5, cy=7.5), 16, 16)
    {'fx': 0.08, 'fy': 0.02, 'cx': 0.1, 'cy': 0.05}
    """
    before = lens.before(rows, cols)
    u, v = np.meshgrid(np.linspace(0, cols, _POINTS), np.linspace(0, rows, _POINTS))
    y, z = before.rays(u, v)
    x_d, y_d = distort(before.model, before.k, -y, -z)[:2]
    rates = {
        "fx": float(np.abs(x_d).max()) / lens.fx,
        "fy": float(np.abs(y_d).max()) / lens.fy,
        "cx": 1 / lens.fx,
        "cy": 1 / lens.fy,
    }
    for k, name in enumerate(list(lens.terms)[len(rates) :]):
        coefficients = before.k.astype(complex)
        coefficients[k] += 1j * _STEP
        a, b = distort(before.model, coefficients, -y, -z)[:2]
        rates[name] = float(np.hypot(a.imag, b.imag).max()) / _STEP
    return rates
