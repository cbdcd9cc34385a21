"""Whitened distance between frames and model images, over a whole bank at once (PHYSICS section 7).

A pixel of a filtered frame is a return, a no return, or missing. Where the model sees the landmark (or a background
is given) a return costs its squared range residual over its variance. A no return where the model must return
something, and a return where the model has nothing to return, cost :data:`DISAGREEMENT`. Agreement on nothing costs
nothing, and a missing pixel says nothing.

With per-pixel weights w = 1/σ², ranges y and f about a common mean, and the model's masks M (may return) and C (must
return), the sum over pixels is

    Σ w M (y − f)² + 25 (y returns)(1 − M) + 25 (y does not return) C
        = (w y² − 25 ret) · M  −  2 (w y) · (M f)  +  w · (M f²)  +  25 noret · C  +  25 Σ ret,

one matrix product over all templates. It is formed in float32, so the mean of the bank is subtracted first, and what
comes within its rounding error of the smallest is computed again in float64.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from phasemark.matcher.filters.filtered_frames import FilteredFrames, PixelState, assumed_std_m
from phasemark.matcher.pixel_agreement import (
    DISAGREEMENT,
    MAY_RETURN_COVERAGE,
    MUST_RETURN_COVERAGE,
    PERHAPS,
    SURELY,
    counts,
    disagrees,
)
from phasemark.render import PhasorImages, Sensor, phasor_to_range_m
from phasemark.render.phasor_images import wrap_difference_m

_T = TypeVar("_T", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Observation:
    """Filtered frames as the distance sees them: (n, pixels) arrays.

    Parameters
    ----------
    range_m : float64
        0 where nothing returned.
    weight : float64
        1/σ² of a return, 0 elsewhere.
    returned, not_returned : bool
    """

    range_m: NDArray[np.float64]
    weight: NDArray[np.float64]
    returned: NDArray[np.bool_]
    not_returned: NDArray[np.bool_]

    @classmethod
    def from_frames(cls, frames: FilteredFrames, rows: tuple[int, int]) -> Observation:
        """Take some rows of filtered frames.

        Where a frame does not know its own noise (a single frame without amplitudes), the noise law at the measured
        range of an albedo of 0.8 facing the camera stands in.
        """
        frames.sensor.refuse_several_frequencies("comparing frames with model images")
        picked = slice(*rows)
        shape = (len(frames), -1)
        state = frames.state[:, picked].reshape(shape)
        returned = state == PixelState.RETURN
        ranges = np.where(returned, frames.range_m[:, picked].reshape(shape), 0.0)
        std = frames.std_m[:, picked].reshape(shape)
        unknown = returned & ~(np.isfinite(std) & (std > 0))
        if unknown.any():
            law = assumed_std_m(ranges[unknown], frames.sensor)
            std = std.copy()
            std[unknown] = law / np.sqrt(np.maximum(frames.n_effective[:, picked].reshape(shape)[unknown], 1.0))
        weight = np.zeros(ranges.shape)
        weight[returned] = 1 / std[returned] ** 2
        return cls(ranges, weight, returned, state == PixelState.NO_RETURN)

    def mirrored(self, cols: int) -> Observation:
        """Return the frames mirrored left to right; their images have `cols` columns."""

        def flip(values: NDArray[_T]) -> NDArray[_T]:
            return values.reshape(len(values), values.shape[1] // cols, cols)[..., ::-1].reshape(values.shape)

        return Observation(flip(self.range_m), flip(self.weight), flip(self.returned), flip(self.not_returned))

    def __getitem__(self, index: NDArray[np.integer] | slice) -> Observation:
        return Observation(self.range_m[index], self.weight[index], self.returned[index], self.not_returned[index])


@dataclass(frozen=True, eq=False)
class Templates:
    """Model images of one part of a bank, ready to be compared.

    Parameters
    ----------
    range_m : (t, pixels) float32
        Model ranges less `mean_m`; 0 where the model may not return.
    may_return, must_return : (t, pixels) bool
    mean_m : (pixels,) float64
        Circular mean of the model ranges of each pixel.
    sensor : Sensor
    wraps : bool
        Whether model and frame may differ by more than half a period about the mean; then no cost is a matrix product.
    """

    range_m: NDArray[np.float32]
    may_return: NDArray[np.bool_]
    must_return: NDArray[np.bool_]
    mean_m: NDArray[np.float64]
    sensor: Sensor
    wraps: bool = False

    @classmethod
    def of_parts(
        cls,
        parts: Iterable[tuple[NDArray[np.complexfloating], NDArray[np.floating]]],
        sensor: Sensor,
        background: PhasorImages | None,
        rows: tuple[int, int],
        *,
        wraps: bool = False,
    ) -> Templates:
        """Turn model images that come some at a time into templates, composed with a background if there is one.

        The answer does not depend on how many come together.

        Parameters
        ----------
        parts : iterable of (phasor, coverage), (..., rows, cols) each
            What the landmark alone returns.
        sensor : Sensor
        background : PhasorImages, optional
            One image of the background without the landmark; S = S_landmark + (1 − coverage) · S_background.
        rows : (first, stop)
            Rows of the sensor that the images hold.
        wraps : bool
            As an attribute.
        """
        found = [seen_by_images(*part, sensor, background, rows) for part in parts]
        # the circular mean, so that a pixel whose ranges straddle the wrap has its mean there
        total: NDArray[np.complex128] | None = None
        for ranges, may, _ in found:
            turn = np.exp(1j * ranges / sensor.metres_per_radian) * may
            total = (turn if total is None else np.concatenate([total[None], turn])).sum(axis=0)
        assert total is not None
        mean = phasor_to_range_m(total, sensor)
        mean = np.where(np.isfinite(mean), mean, 0.0)
        may_return, must_return = (np.concatenate([part[k] for part in found]) for k in (1, 2))
        about, first = np.empty(may_return.shape, np.float32), 0
        for ranges, may, _ in found:
            about[first : first + len(ranges)] = np.where(may, wrap_difference_m(ranges - mean, sensor), 0.0)
            first += len(ranges)
        return cls(about, may_return, must_return, mean, sensor, wraps)

    def __len__(self) -> int:
        return len(self.range_m)

    def __getitem__(self, index: NDArray[np.integer]) -> Templates:
        """Return some of the templates, about the same mean."""
        return replace(
            self,
            range_m=self.range_m[index],
            may_return=self.may_return[index],
            must_return=self.must_return[index],
        )

    @cached_property
    def matrix(self) -> NDArray[np.float32]:
        """[M, −2 M f, M f², C], what the matrix product needs; (t, 4 · pixels)."""
        matrix = np.empty((len(self), 4, self.range_m.shape[1]), np.float32)
        matrix[:, 0], matrix[:, 3] = self.may_return, self.must_return
        np.multiply(self.range_m, -2, out=matrix[:, 1])
        np.square(self.range_m, out=matrix[:, 2])
        return matrix.reshape(len(self), -1)

    def costs(self, seen: Observation, subset: slice = slice(None)) -> NDArray[np.float32]:
        """Return the distances of n frames from all templates (or a slice of them), (n, t), to float32's accuracy."""
        about = self.about(seen)
        if self.wraps:
            models = self.range_m[subset], self.may_return[subset], self.must_return[subset]
            out = np.empty((len(about), len(models[0])), np.float32)
            frames = about, seen.weight, seen.returned, seen.not_returned
            _costs_on_a_circle(*models, *frames, self.sensor.unambiguous_range_m, out)
            return out
        query = np.concatenate(
            [
                seen.weight * about**2 - DISAGREEMENT * seen.returned,
                seen.weight * about,
                seen.weight,
                DISAGREEMENT * seen.not_returned,
            ],
            axis=1,
        )
        constant = DISAGREEMENT * seen.returned.sum(axis=1)
        return np.asarray(query.astype(np.float32) @ self.matrix[subset].T + constant[:, None].astype(np.float32))

    def exact_costs(self, seen: Observation, frame: int, index: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return the distances of one frame from some templates in float64, (t,)."""
        return np.asarray(self.costs_of_each(seen[frame : frame + 1], index[None])[0])

    def costs_of_each(self, seen: Observation, index: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return the distances of n frames from templates of their own, (n, t) as `index` is, in float64."""
        residual = wrap_difference_m(self.about(seen)[:, None] - self.range_m[index].astype(np.float64), self.sensor)
        fit = seen.weight[:, None] * self.may_return[index] * residual**2
        wrong = disagrees(
            seen.returned[:, None], seen.not_returned[:, None], self.may_return[index], self.must_return[index]
        )
        return np.asarray((fit + DISAGREEMENT * wrong).sum(axis=-1))

    def best(self, seen: Observation, frame: int, costs: NDArray[np.float32], offset: int = 0) -> tuple[int, float]:
        """Return the nearest template of one frame and its exact distance.

        Parameters
        ----------
        seen : Observation
        frame : int
        costs : (t,) float32
            One row of :meth:`costs`.
        offset : int
            Where the slice that `costs` covers begins.
        """
        scale = float(np.sum(seen.weight[frame] * self.about(seen[frame : frame + 1])[0] ** 2))
        scale += float(np.abs(costs).min()) + DISAGREEMENT * seen.range_m.shape[1]
        near = np.flatnonzero(costs <= costs.min() + 1e-5 * scale)
        rechecked = 64
        if len(near) > rechecked:
            near = near[np.argpartition(costs[near], rechecked)[:rechecked]]
        exact = self.exact_costs(seen, frame, near + offset)
        k = int(exact.argmin())
        return int(near[k] + offset), float(exact[k])

    def about(self, seen: Observation) -> NDArray[np.float64]:
        """Return measured ranges less the bank's mean, wrapped to ± c/4f, 0 where nothing returned."""
        return np.where(seen.returned, wrap_difference_m(seen.range_m - self.mean_m, self.sensor), 0.0)


def seen_by_images(
    phasor: NDArray[np.complexfloating],
    coverage: NDArray[np.floating],
    sensor: Sensor,
    background: PhasorImages | None,
    rows: tuple[int, int],
) -> tuple[NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return ranges of some images, 0 where they may not return, and which pixels may and must return; (n, pixels)."""
    pixels = math.prod(phasor.shape[-2:])
    s = phasor.reshape(-1, pixels)
    cover = np.asarray(coverage).reshape(-1, pixels)
    may = cover >= MAY_RETURN_COVERAGE
    if background is None:
        must = counts(s, np.abs(s), sensor, SURELY) & (cover > MUST_RETURN_COVERAGE)
    else:
        picked = slice(*rows)
        free = 1 - cover
        behind = free * background.phasor[0, picked].reshape(1, pixels)
        behind_intensity = free * background.intensity[0, picked].reshape(1, pixels)
        may |= counts(behind, behind_intensity, sensor, PERHAPS)
        intensity = np.abs(s) + behind_intensity
        s = s + behind.astype(np.complex64)
        must = counts(s, intensity, sensor, SURELY)
    may &= s != 0
    return np.where(may, phasor_to_range_m(s, sensor), 0.0), may, must


@njit(cache=True, nogil=True)
def _costs_on_a_circle(model, may, must, about, weight, returned, absent, period, out):  # type: ignore[no-untyped-def]
    """Fill the costs of every frame at every template."""
    for f in range(out.shape[0]):
        for t in range(out.shape[1]):
            total = 0.0
            for q in range(model.shape[1]):
                if returned[f, q]:
                    if may[t, q]:
                        difference = abs(about[f, q] - model[t, q])
                        difference = min(difference, abs(period - difference))
                        total += weight[f, q] * difference * difference
                    else:
                        total += DISAGREEMENT
                elif absent[f, q] and must[t, q]:
                    total += DISAGREEMENT
            out[f, t] = total
