"""The shift of an estimate by light that bounces off a floor, where the model has it not."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.accuracy.cramer_rao import image_and_slopes, whitened_slopes
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.systematic import (
    FLOOR_ALBEDO,
    SUPPOSED_ALBEDO,
    calibrated_slopes,
    carried_errors,
    supposed_floors,
)
from phasemark.matcher.match import named_in_degrees
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import Background, Renderer, Views

__all__ = ["MultipathShift", "multipath_shift"]

_SYMBOLS = dict(zip(VIEW, ("D", "δ", "bearing", "height", "pitch", "roll"), strict=True))


@dataclass(frozen=True, eq=False)
class MultipathShift:
    """The shift of an estimate by light that bounces off a floor, where the model has it not.

    Parameters
    ----------
    floor_albedo : float
    floor_m : float
        Height of the lens above the floor.
    free : tuple of str
        Parameters of the view that are estimated.
    shift : (p,) float64
        Metres and radians; what is estimated less what is true.
    """

    floor_albedo: float
    floor_m: float
    free: tuple[str, ...]
    shift: NDArray[np.float64]

    def __str__(self) -> str:
        """Say it in one line; angles and shifts that round to nothing are left out."""
        words = []
        for name, value in zip(self.free, self.shift.tolist(), strict=True):
            in_metres = name.endswith("_m")
            text = f"{1e3 * value:+.1f} mm" if in_metres else f"{math.degrees(value):+.2f}°"
            if name == "distance_m" or any(digit in text for digit in "123456789"):
                words.append(f"{_SYMBOLS[name]} by {text}")
        return (
            f"multipath is off: a floor of albedo {self.floor_albedo:g}, {self.floor_m:.2f} m below the lens, moves"
            f" {', '.join(words)}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain numbers for JSON, angles in degrees."""
        unit = [1.0 if name.endswith("_m") else math.degrees(1.0) for name in self.free]
        shift = dict(zip(map(named_in_degrees, self.free), (self.shift * unit).tolist(), strict=True))
        return {"floor_albedo": self.floor_albedo, "floor_m": self.floor_m, "shift": shift}


def multipath_shift(
    renderer: Renderer, views: Views, *, free: Sequence[str] = VIEW[:3], background: Background | None = None
) -> MultipathShift | None:
    """Return how far off an estimate is where light bounces off a floor and the model has it not, to first order.

    With ΔS what bounces add to the light, that is P Jᵀ W ΔS on ranges. A floor that is not stated is supposed to be
    where the landmark stands.

    Parameters
    ----------
    renderer : Renderer
        The landmark and the camera.
    views : Views
        n views; that at which distance moves most is told.
    free : sequence of str
        Parameters that are estimated, distance_m first.
    background : Background, optional
        Wall and floor that are modelled.

    Returns
    -------
    MultipathShift or None
        None where bounces are modelled, where the sensor does not say how wide its lamp shines, and where no floor is
        below the lens or no view is observed.
    """
    sensor = renderer.sensor
    if len(sensor.frequencies_hz) > 1 or "multipath" not in carried_errors(sensor, ("multipath",), background):
        return None
    floors = supposed_floors(renderer, views, background)
    image, slope = image_and_slopes(renderer, views, free, background, 1)
    albedo = SUPPOSED_ALBEDO
    if background is not None and background.floor_m is not None:
        albedo = background.floor_albedo
    bounced = albedo * calibrated_slopes(renderer, sensor, views, image, background, (FLOOR_ALBEDO,))
    use = (image.phasor != 0) & counts(image.phasor, image.intensity, sensor)
    rows, extra = (
        whitened_slopes(image.phasor, image.intensity, change, use, np.ones(use.shape), "ranges", sensor)
        for change in (slope, bounced)
    )
    inverse = covariance_of(rows @ rows.transpose(0, 2, 1))
    shift = (inverse @ (rows @ extra.transpose(0, 2, 1)))[:, :, 0]
    told = [
        MultipathShift(albedo, floor.floor_m, tuple(free), own)
        for floor, own in zip(floors, shift, strict=True)
        if floor is not None and floor.floor_m is not None and np.isfinite(own).all()
    ]
    return max(told, key=lambda one: abs(float(one.shift[0])), default=None)
