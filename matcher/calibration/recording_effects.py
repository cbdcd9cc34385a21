"""Differences between recordings of one camera.

The camera is put on again, is warmer, and the poses are told in another frame: range offset, bearing, pitch, roll and
delay of a recording are those of the camera plus an error of its own, and a landmark may be turned against the axes of
the poses. Each error is normal with a variance that all recordings share. With n recordings the variance has an inverse
gamma prior that is worth three recordings of the usual size, and is found by expectation maximisation of the restricted
likelihood (Dempster, Laird & Rubin 1977): the expected squares of the errors given the frames, averaged with the prior.
As so few recordings leave the variance uncertain, what is stated for another recording is its posterior mean, the
variance of Student's t in place of a normal law.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.calibration.mounting import PARAMETERS
from phasemark.matcher.likelihood.systematic import RECORDING_FIELDS
from phasemark.render import Sensor

_Float = NDArray[np.float64]

TURN = "turn"
"""By how much the landmark is turned against the axes of the poses, counter-clockwise: no number of the camera."""
_BETWEEN = {"range_offset": 0.005, "bearing": math.radians(0.8), "pitch": math.radians(0.8), "roll": math.radians(0.8)}
"""Standard deviation of the difference of two recordings, where there is but one, metres and radians: about that of
recordings of a VL53L5CX on a drone, calibrated one by one; two had range offsets of −6 and −15 mm, pitches of −0.5° and
−2.4°."""
_USUAL = {**{name: 0.8 * std for name, std in _BETWEEN.items()}, "delay": 0.2, TURN: math.radians(0.5)}
"""Usual standard deviations of the errors of a recording, metres, radians, seconds. Of those above they are a little
more than the 1/√2 that two alike make, for an error that is stated too small is worse than one too large."""
_WORTH = 3.0
"""Recordings that the usual sizes are worth."""


def stated_apart(sensor: Sensor, free: Collection[str]) -> dict[str, float]:
    """Return by how much a recording differs in each number that a calibration left and that is not free.

    Parameters
    ----------
    sensor : Sensor
        With `recording_range_m` and its neighbours, or without: then nothing is stated.
    free : collection of str

    Returns
    -------
    dict of str to float
        Standard deviations, metres and radians, with those of the calibration.
    """
    calibrated = dict(zip(sensor.calibration_fields, np.diag(sensor.calibration_matrix).tolist(), strict=True))
    found = {}
    for one in PARAMETERS.values():
        if one.field in RECORDING_FIELDS and one.name not in free:
            apart = float(getattr(sensor, RECORDING_FIELDS[one.field]))
            if apart:
                found[one.name] = math.hypot(apart, math.sqrt(calibrated.get(one.field, 0.0))) / one.in_file
    return found


@dataclass(frozen=True)
class RecordingSizes:
    """Standard deviations of what recordings have of their own.

    Parameters
    ----------
    names : tuple of str
    recordings : int
    std, usual : (q,) float64
        Now, and before a frame is seen; metres, radians, seconds.
    """

    names: tuple[str, ...]
    recordings: int
    std: _Float
    usual: _Float

    @classmethod
    def of(cls, free: Collection[str], recordings: int, *, moving: bool, stated: Mapping[str, float]) -> RecordingSizes:
        """Return the sizes before a frame is seen, of all that each recording may have of its own.

        Parameters
        ----------
        free : collection of str
            Names of what is estimated: several recordings have errors of their own in these, a single one has none.
        recordings : int
        moving : bool
            Whether the landmark may be turned against the poses.
        stated : mapping of str to float
            From :func:`stated_apart`.
        """
        own = {name: _USUAL[name] for name in _USUAL if recordings > 1 and name in free} | dict(stated)
        if moving:
            own[TURN] = _USUAL[TURN]
        usual = np.array(list(own.values()))
        return cls(tuple(own), recordings, usual, usual)

    def most_likely(
        self, information: _Float, gradient: _Float, prior: _Float, own: _Float, first: int
    ) -> RecordingSizes:
        """Return the sizes after the frames of all recordings.

        Parameters
        ----------
        information, gradient : (P, P), (P,) float64
            Of all parameters, of which the errors of the recordings stand together, without their prior.
        prior : (P,) float64
            Precision of the others; what it says of the errors is not read.
        own : (R, q) float64
            Errors of the recordings where the gradient was taken.
        first : int
            Where they begin among the parameters, whose unit they have.
        """
        std, count = self.std, own.size
        rounds = 50  # of expectation and maximisation: far more than it takes
        for _ in range(rounds):
            precision = prior.copy()
            precision[first : first + count] = np.tile(std**-2.0, self.recordings)
            pull = gradient.copy()
            pull[first : first + count] -= precision[first : first + count] * own.ravel()
            covariance = np.linalg.inv(information + np.diag(precision))
            there = own.ravel() + (covariance @ pull)[first : first + count]
            square = (there**2 + np.diag(covariance)[first : first + count]).reshape(own.shape).sum(axis=0)
            std = np.sqrt((_WORTH * self.usual**2 + square) / (_WORTH + self.recordings))
        known = _WORTH + self.recordings - 1
        return replace(self, std=std * math.sqrt(known / (known - 2)))

    def of_another(self, name: str) -> float:
        """Return by how much another recording differs from the calibrated number, standard deviation.

        Of a single recording that is the difference of two; of several the camera's number is the one between them,
        and its own error is in its covariance.
        """
        if self.recordings == 1:
            return _BETWEEN[name]
        return float(self.std[self.names.index(name)]) if name in self.names else 0.0


def own_title(name: str) -> tuple[str, float, str]:
    """Return the title of a recording's own number, its factor for people, and its unit."""
    if name == TURN:
        return "turn of the landmark", math.degrees(1), "°"
    one = PARAMETERS[name]
    return one.title, one.shown, one.unit


def own_text(name: str, value: float) -> str:
    """Return a recording's own number for people: its title and value with its unit."""
    title, shown, unit = own_title(name)
    return f"{value * shown:+.3g}{'' if unit == '°' else ' '}{unit} of {title}"
