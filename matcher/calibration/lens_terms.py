"""The numbers of a lens as parameters of a calibration: their order, their natural units, and which lenses there are.

A lens has as many of :data:`~phasemark.render.sensor.lens_fields.TERMS` as it states. What one of them is worth depends
on the image: the natural unit of a term moves the image point that it moves most by 1°, so that a unit of k1 means the
same before 16 and before 640 columns, and a standard deviation in units is one of the image at its farthest.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render import Sensor
from phasemark.render.sensor.lens_fields import TERMS, Lens
from phasemark.render.sensor.lens_map import distort
from phasemark.render.sensor.lens_rates import lens_rates

_UNIT = math.tan(math.radians(1.0))
"""By how much, as a tangent, a natural unit moves the image where it moves it most."""
_POINTS = 9
"""Along each side of the image."""
_LEAST_STRETCH = 0.01
"""A lens that leaves a smaller share of its area to a part of the image is about to fold there: no step leads to it."""
_HALVINGS = 12
"""How often a step that leads to no lens is halved before it is not taken."""


def numbers_of(lens: Lens | None) -> NDArray[np.float64]:
    """Return the terms of a lens in the order of `TERMS`, (12,); 0 for those that it does not state."""
    terms = {} if lens is None else lens.terms
    return np.array([terms.get(name, 0.0) for name in TERMS])


def lens_of(template: Lens, numbers: NDArray[np.float64]) -> Lens:
    """Return the lens that has these numbers, with the model and as many coefficients as another one.

    Parameters
    ----------
    template : Lens
    numbers : (12,) float64
        In the order of `TERMS`.

    Raises
    ------
    UsageError
        A number is out of range.
    """
    found = dict(zip(TERMS, numbers.tolist(), strict=True))
    return template.with_terms(**{name: found[name] for name in template.terms})


def natural_units(sensor: Sensor) -> NDArray[np.float64]:
    """Return the natural units of the terms of a sensor's lens, in the order of `TERMS`, (12,); 1 for those without.

    Parameters
    ----------
    sensor : Sensor
    """
    if sensor.lens is None:
        return np.ones(len(TERMS))
    rates = lens_rates(sensor.lens, sensor.rows, sensor.cols)
    return np.array([_UNIT / rates[name] if name in rates else 1.0 for name in TERMS])


def stretch_of(sensor: Sensor, numbers: NDArray[np.float64]) -> float:
    """Return the least share of its area at the axis that a lens leaves to any part of an image; 0 if it is no lens.

    A lens that folds inside the image, or is out of range, is none. Where the share is 0 it is about to fold.

    Parameters
    ----------
    sensor : Sensor
        With a lens, whose model and number of coefficients are kept.
    numbers : (12,) float64
        In the order of `TERMS`.
    """
    assert sensor.lens is not None
    try:
        lens = lens_of(sensor.lens, numbers)
        sensor.with_(lens=lens)
    except UsageError:
        return 0.0
    before = lens.before(sensor.rows, sensor.cols)
    u, v = np.meshgrid(np.linspace(0, sensor.cols, _POINTS), np.linspace(0, sensor.rows, _POINTS))
    y, z = before.rays(u, v)
    _, _, xx, xy, yy = distort(before.model, before.k, -y, -z)
    return float(np.nan_to_num(xx * yy - xy * xy).min())


def farthest_lens(sensor: Sensor, before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the numbers of a lens on the way from one to another: the whole way, a half, a quarter … or none of it.

    Parameters
    ----------
    sensor : Sensor
    before, after : (12,) float64
        In the order of `TERMS`; the first make a lens.
    """
    if sensor.lens is None or (before == after).all():
        return after
    least = min(_LEAST_STRETCH, stretch_of(sensor, before))
    for halvings in range(_HALVINGS):
        there = before + 0.5**halvings * (after - before) if halvings else after
        if stretch_of(sensor, there) > least:
            return there
    return before
