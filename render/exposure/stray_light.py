"""Stray light: what lens and housing spread from every pixel over the others (PHYSICS section 4)."""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from phasemark.render.sensor.sensor import Sensor

_Number = TypeVar("_Number", np.float64, np.complex128)


def spread_light(light: NDArray[_Number], sensor: Sensor) -> NDArray[_Number]:
    """Spread light by the camera's point-spread kernel: what stays, a near blur and a far veil.

    out = (1 − s_n − s_f) · in + s_n · G(σ_n) in + s_f · G(σ_f) in, with Gaussians of `blur_px` and `veil_px`. The light
    that leaves a pixel is shared among the pixels of the image, so Σ out = Σ in: nothing is lost over the border. It is
    linear, and acts on intensity and on the phasor of every harmonic alike.

    Parameters
    ----------
    light : (..., rows, cols)
        Intensity or phasors.
    sensor : Sensor

    Returns
    -------
    ndarray
        In the shape of `light`; `light` itself if nothing strays.
    """
    stray = sensor.blur_share + sensor.veil_share
    if stray == 0:
        return light
    out = (1 - stray) * light
    for share, sigma_px in ((sensor.blur_share, sensor.blur_px), (sensor.veil_share, sensor.veil_px)):
        if share > 0:
            down, across = _gaussian(sensor.rows, sigma_px), _gaussian(sensor.cols, sigma_px)
            out = out + share * (down @ light @ across.T)
    return out


def _gaussian(n: int, sigma_px: float) -> NDArray[np.float64]:
    """Return the share (n, n) of a pixel's light, columns, that each pixel of a line receives, rows; columns add to 1.

    A Gaussian in two dimensions is the product of two in one, and so are its sums over an image.
    """
    offset = np.subtract.outer(np.arange(n), np.arange(n))
    weight = np.exp(-0.5 * (offset / sigma_px) ** 2)
    return np.asarray(weight / weight.sum(axis=0))
