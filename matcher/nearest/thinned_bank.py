"""The images of a bank at every few of its distances and angles, which a search compares first."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.data.plans.arrays import GroupName, group_rows
from phasemark.matcher.frequencies import layers_of, phases_wrap
from phasemark.matcher.nearest.grid import closing_period
from phasemark.matcher.nearest.templates import Templates
from phasemark.render import PhasorImages

__all__ = ["ThinnedBank"]


class _Images(NamedTuple):
    """Some images of a group of a bank, (views, row, col)."""

    name: GroupName
    phasor: NDArray[np.complex64]
    coverage: NDArray[np.float32]


class ThinnedBank:
    """Some images of a bank, read while the bank is open, some at a time.

    Parameters
    ----------
    bank : Bank
    stride : (distance, delta)
        Every how many steps of the bank's grid an image is taken.

    Attributes
    ----------
    sensor : Sensor
    layers : OneFrequency or None
        How the images of several frequencies lie above one another; None where there is one image.
    n_class : int
    distance_m, delta_rad : float64
        The thinned grid.
    closes : bool
        Whether the last angle is next to the first.
    """

    def __init__(self, bank: Bank, stride: tuple[int, int]) -> None:
        self.sensor = bank.sensor
        self.layers = layers_of(bank)
        self.n_class = len(bank.classes)
        self.distance_m = bank.distance_m[:: stride[0]]
        self.delta_rad = bank.delta_rad[:: stride[1]]
        self.closes = closing_period(bank.delta_rad) is not None
        self._wraps = phases_wrap(bank)
        groups = ((bank.full, (1, *stride)), (bank.lower, stride), (bank.upper, (1, stride[0])))
        self._images = [_thinned(group, strides) for group, strides in groups if group is not None]

    def templates(self, behind: PhasorImages | None) -> list[tuple[Templates, tuple[int, int], bool]]:
        """Return the images as templates before a background, with their rows, and whether they are upper parts."""
        return [
            (
                Templates.build(own.phasor, own.coverage, self.sensor, behind, rows, wraps=self._wraps),
                rows,
                own.name == "upper",
            )
            for own in self._images
            for rows in [group_rows(own.name, self.sensor)]
        ]


def _thinned(group: BankGroup, strides: tuple[int, ...]) -> _Images:
    """Return the images of a group at every few steps along each axis of its views."""
    phasor, coverage = [], []
    for which, some in group.parts():
        first = -which[-1].start % strides[-2]
        taken = (..., slice(first, None, strides[-2]), slice(None, None, strides[-1]), slice(None), slice(None))
        phasor.append(some.phasor[taken].copy())
        coverage.append(some.coverage[taken].copy())
    shape = [-(-n // step) for n, step in zip(group.n_views, strides, strict=True)]
    images = (np.concatenate([part.reshape(-1, *part.shape[-2:]) for part in parts]) for parts in (phasor, coverage))
    return _Images(group.name, *(values.reshape(*shape, *values.shape[-2:]) for values in images))
