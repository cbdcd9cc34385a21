"""Measured frames of boards, reduced to the moments of every pixel, beside the light that each board sends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from phasemark import UsageError
from phasemark.render.bench.fit.fitted_sensor import Floats
from phasemark.render.bench.flat_field import board_image
from phasemark.render.frames import Frames
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.sensor.sensor import Sensor

PIXEL_STD_ERROR = 0.25
FEWEST_FRAMES = math.ceil(1 + 1 / (2 * PIXEL_STD_ERROR**2))
"""Frames at each distance that a fit needs: they tell the noise of one pixel to 25 %."""
DEAD_SHARE = 0.5  # a pixel that is valid in fewer frames, at every distance, is called dead
DISTANCE_STD_M = 1e-3
"""Assumed standard deviation of a board's distance: that of a laser distance meter or a steel tape, read with care."""


class Moments(NamedTuple):
    """Mean and variance of one quantity over the valid frames of a pixel, and each frame less that mean."""

    mean: Floats
    variance: Floats
    residual: Floats

    @classmethod
    def of(cls, values: Floats, valid: NDArray[np.bool_]) -> Moments:
        """Reduce (frames, rows, cols)."""
        n = valid.sum(axis=0)
        mean = np.where(valid, values, 0.0).sum(axis=0) / np.maximum(n, 1)
        residual = np.where(valid, values - mean, np.nan)
        return cls(mean, np.nansum(residual**2, axis=0) / np.maximum(n - 1, 1), residual)


@dataclass(frozen=True, eq=False)
class BoardData:
    """Measured frames reduced to moments, beside what the board sends; (boards, rows, cols) of the boards used."""

    sensor: Sensor
    distance_m: Floats  # (boards,)
    distance_std_m: Floats  # (boards,)
    n: Floats  # valid frames
    light: Floats  # |S| of the board
    truth_m: Floats
    error_m: tuple[Moments, ...]  # of each board: range less true range
    amplitude: tuple[Moments, ...]  # none unless all boards have it
    intensity: tuple[Moments, ...]
    dead: NDArray[np.bool_]  # (rows, cols), pixels that answer at no distance, those left out included
    good: NDArray[np.bool_]  # (rows, cols), pixels that every number is made of

    @classmethod
    def of(
        cls,
        frames: Sequence[Frames],
        distance_m: Sequence[float] | NDArray[np.floating],
        distance_std_m: Sequence[float],
        albedo: Sequence[float],
        base: Sensor,
        notes: list[str],
    ) -> BoardData:
        """Reduce the frames, without distances at which few pixels measure, and pixels that fail at one of the others.

        Raises
        ------
        UsageError
            No pixel is left.
        """
        images = [board_image(base, d, rho) for d, rho in zip(distance_m, albedo, strict=True)]
        share = np.array([one.valid[0].mean(axis=0) for one in frames])
        used_share = 0.9  # a pixel that drops out more often is a selection of its own noise, and left out
        usable = share >= used_share
        alive = usable.any(axis=0)
        if not alive.any():
            raise UsageError(
                f"no pixel is valid in {100 * used_share:.0f} % of the frames at any distance: there is nothing to fit"
            )
        of_board = usable[:, alive].mean(axis=1)
        board_share = 0.75  # a distance at which fewer of the living pixels can be used is left out
        kept = (of_board >= board_share) | (np.arange(len(frames)) == of_board.argmax())
        notes += [
            f"The frames at {distance:g} m were left out: {100 * answers:.0f} % of the pixels answer there."
            for distance, answers, used in zip(distance_m, of_board, kept, strict=True)
            if not used
        ]
        dead = np.asarray((share < DEAD_SHARE).all(axis=0))
        if dead.sum() > 0.1 * dead.size:
            notes.append(
                f"{dead.sum()} of {dead.size} pixels never answer and are called dead: does the board fill the image, "
                "and is it bright enough?"
            )
        boards: list[int] = np.flatnonzero(kept).tolist()

        def moments(name: str) -> tuple[Moments, ...]:
            values = [getattr(one, name) for one in frames]
            if any(one is None for one in values):
                return ()
            return tuple(Moments.of(values[k][0], frames[k].valid[0]) for k in boards)

        return cls(
            base,
            np.array(distance_m, np.float64)[boards],
            np.array(distance_std_m, np.float64)[boards],
            np.array([frames[k].valid[0].sum(axis=0) for k in boards], np.float64),
            np.array([images[k].amplitude[0] for k in boards]),
            np.array([images[k].range_m[0] for k in boards]),
            tuple(_range_errors(frames[k], images[k].range_m[0], base) for k in boards),
            moments("amplitude_e"),
            moments("intensity_e"),
            dead,
            usable[kept].all(axis=0),
        )

    def without(self, odd: NDArray[np.bool_]) -> BoardData:
        """Return the boards without some pixels."""
        return replace(self, good=self.good & ~odd)

    def used(self, values: Sequence[Floats] | Floats) -> Floats:
        """Return images of all boards at the pixels used, (boards, pixels used)."""
        return np.asarray(values)[:, self.good]

    @property
    def variance_m2(self) -> Floats:
        """Variance of the range in one frame, NaN where too few frames are valid, (boards, rows, cols)."""
        return np.where(self.n >= FEWEST_FRAMES / 2, np.array([one.variance for one in self.error_m]), np.nan)

    @property
    def mean_variance_m2(self) -> Floats:
        """Variance of the mean range of all frames, (boards, pixels used)."""
        return self.used(self.variance_m2) / self.used(self.n) * self.widening

    @property
    def widening(self) -> float:
        """What the correlation of frames does to the variance of a mean; never less than 1."""
        correlation = self.frame_correlation()[0]
        return max((1 + correlation) / (1 - correlation), 1.0) if abs(correlation) < 1 else 1.0

    def frame_correlation(self) -> tuple[float, float]:
        """Return the correlation of a pixel's noise with that of the frame before, all pixels together.

        Subtracting a mean of n values leaves a correlation of −1 / n, which is added again.
        """
        product, square, pairs, shift = 0.0, 0.0, 0, 0.0
        for one in self.error_m:
            values = one.residual[:, self.good]
            both = np.isfinite(values[1:]) & np.isfinite(values[:-1])
            product += float(np.where(both, values[1:] * values[:-1], 0.0).sum())
            square += float(np.where(both, 0.5 * (values[1:] ** 2 + values[:-1] ** 2), 0.0).sum())
            pairs += int(both.sum())
            shift += both.sum() / len(values)
        if square == 0:
            return 0.0, math.inf
        return product / square + shift / pairs, 1 / math.sqrt(pairs)


def _range_errors(frames: Frames, truth_m: Floats, base: Sensor) -> Moments:
    """Reduce ranges less true ranges about each pixel's own circular mean, so that no cut lies among its values."""
    valid = frames.valid[0]
    # a true range beyond c / 2f comes back inside it, as the measured one does
    difference = wrap_difference_m(frames.range_m[0] - truth_m, base)
    turn = np.where(valid, np.exp(1j * np.nan_to_num(difference) / base.metres_per_radian), 0).sum(axis=0)
    centre = np.angle(turn) * base.metres_per_radian
    about = Moments.of(wrap_difference_m(difference - centre, base), valid)
    return about._replace(mean=wrap_difference_m(centre + about.mean, base))


def one_for_each(values: ArrayLike, distance_m: Sequence[float] | NDArray[np.floating], what: str) -> list[float]:
    """Return a number for each distance, of which one may be given for all."""
    numbers: list[float] = np.atleast_1d(np.asarray(values, np.float64)).ravel().tolist()
    if len(numbers) == 1:
        numbers *= len(distance_m)
    if len(numbers) != len(distance_m):
        raise UsageError(f"give one {what}, or one for each of the {len(distance_m)} distances, got {len(numbers)}")
    return numbers


def known_distance_std(
    distance_m: Sequence[float] | NDArray[np.floating], stated: float | Sequence[float] | None, notes: list[str]
) -> list[float]:
    """Return the standard deviation of each distance, and describe it in a note."""
    std = one_for_each(DISTANCE_STD_M if stated is None else stated, distance_m, "'distance_std_m'")
    most_distance_std = 0.1  # of the distance: the propagation is linear
    if stated is None:  # of a board a few millimetres away it would be no small error
        std = [min(one, most_distance_std * d) for one, d in zip(std, distance_m, strict=True)]
    for one, distance in zip(std, distance_m, strict=True):
        if distance > 0 and not 0 <= one <= most_distance_std * distance:
            raise UsageError(
                f"'distance_std_m' must be a number of metres from 0 to a tenth of the distance, "
                f"{most_distance_std * distance:g} at {distance:g} m, got {one:g}"
            )
    if not any(std):
        notes.append("The distances were taken to be exact; standard errors hold only as far as they are.")
        return std
    shown = dict.fromkeys(f"{1e3 * one:.3g}" for one in std)
    notes.append(
        f"The distances were {'assumed' if stated is None else 'stated'} to have a standard deviation of "
        f"{', '.join(shown)} mm, independent of one another; the standard errors allow for it."
    )
    return std
