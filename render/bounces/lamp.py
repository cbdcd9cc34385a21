"""The lamp: where its light first meets the patches of a scene."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.render.sensor.sensor import Sensor

_RAYS = 1 << 16
_GOLDEN = (math.sqrt(5) - 1) / 2


def lamp_rays(sensor: Sensor, n: int = _RAYS) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays that fill the lamp's cone evenly, and the light that goes along each.

    Parameters
    ----------
    sensor : Sensor
    n : int

    Returns
    -------
    directions : (n, 3) float64
        Unit vectors, frame of the tilted camera.
    light : (n,) float64
        Solid angle times the lamp's relative intensity.

    Raises
    ------
    UsageError
        The sensor does not say how wide its lamp is.
    """
    if sensor.lamp_half_angle_deg is None:
        raise UsageError("light that bounces needs the sensor's 'lamp_half_angle_deg': how far off the axis it shines")
    height = 1.0 - math.cos(math.radians(sensor.lamp_half_angle_deg))
    k = np.arange(n) + 0.5
    cosine = 1.0 - height * k / n
    sine, turn = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)), 2 * math.pi * _GOLDEN * k
    directions = np.column_stack([cosine, sine * np.cos(turn), sine * np.sin(turn)])
    return directions, 2 * math.pi * height / n * sensor.lamp_intensity(cosine)


def check_can_bounce(sensor: Sensor) -> None:
    """Refuse a sensor for which light that bounces is not computed.

    Raises
    ------
    UsageError
    """
    if sensor.histogram is not None:
        raise UsageError("histograms of light that bounces are not computed: 'bounces' must be 0 for this sensor")
    lamp_rays(sensor, 1)
