"""Banks of several modulation frequencies as matchers see them: as banks of a camera of one frequency."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray

from phasemark.data import Bank
from phasemark.data.bank.bank_file import BankGroup
from phasemark.matcher.one_frequency import OneFrequency, OneFrequencyRenderer, Way
from phasemark.matcher.pixel_agreement import pixel_mask
from phasemark.render import Background, PhasorImages, Renderer, Views


class _OneFrequencyGroup(BankGroup):
    """A group of a bank as the camera of one frequency has it."""

    def __init__(self, group: BankGroup, one: OneFrequency) -> None:
        self.__dict__.update({name: value for name, value in vars(group).items() if name not in _IMAGES})
        self._group, self._one = group, one

    def part(self, *which: slice) -> BankGroup:
        """Return the group with some of its views alone."""
        return _OneFrequencyGroup(self._group.part(*which), self._one)

    @cached_property
    def intensity(self) -> NDArray[np.float32]:
        """Mean amplitude, (views, row, col)."""
        return self._one.same_for_all(self._group.intensity)

    @cached_property
    def coverage(self) -> NDArray[np.float32]:
        """Share of the pixel that sees the landmark, (views, row, col)."""
        return self._one.same_for_all(self._group.coverage)

    @cached_property
    def phasor(self) -> NDArray[np.complex64]:
        """S, (views, row, col)."""
        hz = self._one.camera.frequencies_hz
        if self._one.stacked:
            return self._one.stack(np.stack([self._group.at_frequency(own) for own in hz], axis=-3))
        by_hz = {own: self._group.at_frequency(own).reshape(-1, *self._group.phasor.shape[-2:]) for own in hz}
        out = np.empty(by_hz[hz[0]].shape, np.complex64)
        images_at_once = 4096
        for start in range(0, len(out), images_at_once):
            part = slice(start, start + images_at_once)
            own = {f: values[part].astype(np.complex128) for f, values in by_hz.items()}
            nothing = np.zeros(own[hz[0]].shape)
            views = Views.broadcast(np.ones(len(nothing)))
            seen = PhasorImages(own.pop(hz[0]), nothing, nothing, self._one.camera, views, by_hz=own)
            out[part] = self._one.images(seen).phasor
        return out.reshape(self._group.phasor.shape)


_IMAGES = ("phasor", "intensity", "coverage")


class OneFrequencyBank(Bank):
    """A bank of a camera of several frequencies as a camera of one frequency has it.

    See :class:`~phasemark.matcher.one_frequency.OneFrequency`.

    Parameters
    ----------
    bank : Bank
        Open or closed; its file stays its own.
    way : {"stacked", "combined"}
    """

    def __init__(self, bank: Bank, way: Way) -> None:
        self.__dict__.update(vars(bank))
        self.one = OneFrequency(bank.sensor, way)
        self.sensor = self.one.sensor
        self.lower, self.upper, self.full = (
            None if group is None else _OneFrequencyGroup(group, self.one)
            for group in (bank.lower, bank.upper, bank.full)
        )


def renderer_of(bank: Bank, mesh: trimesh.Trimesh | None, albedo: float = 0.8) -> Renderer:
    """Return a renderer whose images have the form of a bank's.

    Parameters
    ----------
    bank : Bank
        Or what stands for one.
    mesh : trimesh.Trimesh or None
    albedo : float
    """
    if not isinstance(bank, OneFrequencyBank):
        return Renderer(mesh, bank.sensor, albedo=albedo)
    return OneFrequencyRenderer(Renderer(mesh, bank.one.camera, albedo=albedo, harmonics=()), bank.one)


def background_of(bank: Bank, *backgrounds: Background) -> PhasorImages:
    """Return images of backgrounds alone in direct light, straight ahead, in the form of a bank's images."""
    direct = [replace(own, bounces=0) for own in backgrounds]
    return renderer_of(bank, None).render(distance_m=np.ones(len(direct)), background=direct)


def pixels_of(bank: Bank, pixels: str) -> NDArray[np.bool_]:
    """Return which pixels of a bank's images may count by their place; see ``pixel_mask``."""
    if not isinstance(bank, OneFrequencyBank):
        return pixel_mask(pixels, bank.sensor)
    return bank.one.same_for_all(pixel_mask(pixels, bank.one.camera))


def layers_of(bank: Bank) -> OneFrequency | None:
    """Return how a bank's images of several frequencies lie above one another; None where they do not."""
    return bank.one if isinstance(bank, OneFrequencyBank) and bank.one.stacked else None


def phases_wrap(bank: Bank) -> bool:
    """Return whether phases of one pixel may differ by more than half a turn from view to view of a bank."""
    return layers_of(bank) is not None
