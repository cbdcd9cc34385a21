"""Measured frames of boards, reduced to the moments of every pixel, beside the light that each board sends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

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
_USED_SHARE = 0.9  # a pixel that drops out more often is a selection of its own noise, and left out
_BOARD_SHARE = 0.75  # a distance at which fewer of the living pixels can be used is left out
DISTANCE_STD_M = 1e-3
"""Assumed standard deviation of a board's distance: that of a laser distance meter or a steel tape, read with care."""
_MOST_DISTANCE_STD = 0.1  # of the distance: the propagation is linear


@dataclass(frozen=True, eq=False)
class BoardData:
    """Measured frames reduced to moments, beside what the board sends; (boards, rows, cols), NaN where unused."""

    sensor: Sensor
    distance_m: Floats  # (boards,)
    distance_std_m: Floats  # (boards,)
    n: Floats  # valid frames
    error_m: Floats  # mean range less true range
    variance_m2: Floats  # of one frame
    light: Floats  # |S| of the board
    truth_m: Floats
    amplitude: Floats | None
    intensity: Floats | None
    noise_m: tuple[Floats, ...]  # (frames, rows, cols) of each board: range less its own mean
    share: Floats  # of valid frames, at all distances, those left out included
    good: NDArray[np.bool_]  # (rows, cols), pixels that every number is made of

    @classmethod
    def of(
        cls,
        frames: Sequence[Frames],
        distance_m: Sequence[float] | NDArray[np.floating],
        distance_std_m: Sequence[float],
        albedo: Sequence[float],
        base: Sensor,
    ) -> BoardData:
        """Reduce the frames; no pixel is called good yet."""
        images = [board_image(base, d, rho) for d, rho in zip(distance_m, albedo, strict=True)]
        truth = np.concatenate([image.range_m for image in images])
        error, variance, count, noise = [], [], [], []
        for one, image in zip(frames, images, strict=True):
            # a true range beyond c / 2f comes back inside it, as the measured one does
            difference = wrap_difference_m(one.range_m[0] - image.range_m[0], base)
            valid = one.valid[0]
            n = valid.sum(axis=0).astype(np.float64)
            # about each pixel's own circular mean, so that no cut lies among its values
            turn = np.where(valid, np.exp(1j * np.nan_to_num(difference) / base.metres_per_radian), 0).sum(axis=0)
            centre = np.angle(turn) * base.metres_per_radian
            about = np.where(valid, wrap_difference_m(difference - centre, base), 0.0)
            mean = about.sum(axis=0) / np.maximum(n, 1)
            residual = np.where(valid, about - mean, np.nan)
            enough = n >= max(FEWEST_FRAMES / 2, 2)
            error.append(np.where(enough, wrap_difference_m(centre + mean, base), np.nan))
            spread = np.where(valid, (about - mean) ** 2, 0.0).sum(axis=0)
            variance.append(np.where(enough, spread / np.maximum(n - 1, 1), np.nan))
            count.append(n)
            noise.append(residual)
        share = np.array([n / one.n_frames for n, one in zip(count, frames, strict=True)])
        return cls(
            base,
            np.array(distance_m, np.float64),
            np.array(distance_std_m, np.float64),
            np.array(count),
            np.array(error),
            np.array(variance),
            np.concatenate([image.amplitude for image in images]),
            truth,
            _means([one.amplitude_e for one in frames], [one.valid[0] for one in frames], root_mean_square=True),
            _means([one.intensity_e for one in frames], [one.valid[0] for one in frames]),
            tuple(noise),
            share,
            np.zeros(share.shape[1:], np.bool_),
        )

    def of_usable_boards(self, distance_m: Sequence[float] | NDArray[np.floating], notes: list[str]) -> BoardData:
        """Omit distances at which too few pixels measure, and then pixels that do not measure at all the others.

        Raises
        ------
        UsageError
            No pixel is left.
        """
        usable = self.share >= _USED_SHARE
        alive = usable.any(axis=0)
        if not alive.any():
            raise UsageError(
                f"no pixel is valid in {100 * _USED_SHARE:.0f} % of the frames at any distance: there is nothing to fit"
            )
        kept = usable[:, alive].mean(axis=1) >= _BOARD_SHARE
        kept[usable[:, alive].sum(axis=1).argmax()] = True
        for index in np.flatnonzero(~kept):
            notes.append(
                f"The frames at {distance_m[int(index)]:g} m were left out: "
                f"{100 * usable[index, alive].mean():.0f} % of the pixels answer there."
            )
        good = usable[kept].all(axis=0)
        lost = int((self.share < DEAD_SHARE).all(axis=0).sum())
        if lost > 0.1 * good.size:
            notes.append(
                f"{lost} of {good.size} pixels never answer and are called dead: does the board fill the image, and is "
                "it bright enough?"
            )

        def boards(values: Floats | None) -> Floats | None:
            return None if values is None else values[kept]

        return replace(
            self,
            distance_m=self.distance_m[kept],
            distance_std_m=self.distance_std_m[kept],
            n=self.n[kept],
            error_m=self.error_m[kept],
            variance_m2=self.variance_m2[kept],
            light=self.light[kept],
            truth_m=self.truth_m[kept],
            amplitude=boards(self.amplitude),
            intensity=boards(self.intensity),
            noise_m=tuple(noise for noise, used in zip(self.noise_m, kept, strict=True) if used),
            good=good,
        )

    @property
    def dead(self) -> NDArray[np.bool_]:
        """Pixels that answer at no distance, (rows, cols)."""
        return np.asarray((self.share < DEAD_SHARE).all(axis=0))

    def without(self, odd: NDArray[np.bool_]) -> BoardData:
        """Return the boards without some pixels."""
        return replace(self, good=self.good & ~odd)

    def shifted(self, board: int, change_m: float) -> BoardData:
        """Return the data with one board farther away; the measured ranges stay."""
        factor = 1 + change_m / self.distance_m[board]
        truth, error, light = self.truth_m.copy(), self.error_m.copy(), self.light.copy()
        truth[board] *= factor
        error[board] = wrap_difference_m(error[board] - (truth[board] - self.truth_m[board]), self.sensor)
        light[board] /= factor**2
        return replace(
            self,
            distance_m=self.distance_m + change_m * (np.arange(len(self.distance_m)) == board),
            truth_m=truth,
            error_m=error,
            light=light,
        )

    @property
    def phase_rad(self) -> Floats:
        """True phases, (boards, pixels used)."""
        return self.truth_m[:, self.good] / self.sensor.metres_per_radian

    def frame_correlation(self) -> tuple[float, float]:
        """Return the correlation of a pixel's noise with that of the frame before, all pixels together.

        Subtracting a mean of n values leaves a correlation of −1 / n, which is added again.
        """
        product, square, pairs, shift = 0.0, 0.0, 0, 0.0
        for noise in self.noise_m:
            values = noise[:, self.good]
            both = np.isfinite(values[1:]) & np.isfinite(values[:-1])
            product += float(np.where(both, values[1:] * values[:-1], 0.0).sum())
            square += float(np.where(both, 0.5 * (values[1:] ** 2 + values[:-1] ** 2), 0.0).sum())
            pairs += int(both.sum())
            shift += both.sum() / len(values)
        if square == 0:
            return 0.0, math.inf
        return product / square + shift / pairs, 1 / math.sqrt(pairs)


def _means(
    values: Sequence[Floats | None], valid: Sequence[NDArray[np.bool_]], *, root_mean_square: bool = False
) -> Floats | None:
    """Return mean, or root mean square, of every pixel's valid values; None unless all boards have them."""
    means = []
    for one, usable in zip(values, valid, strict=True):
        if one is None:
            return None
        power = 2 if root_mean_square else 1
        total = np.where(usable, np.nan_to_num(one[0]) ** power, 0.0).sum(axis=0) / np.maximum(usable.sum(axis=0), 1)
        means.append(total ** (1 / power))
    return np.array(means)


def known_distance_std(
    distance_m: Sequence[float] | NDArray[np.floating], stated: float | Sequence[float] | None
) -> list[float]:
    """Return the standard deviation of each distance."""
    std = np.atleast_1d(np.asarray(DISTANCE_STD_M if stated is None else stated, np.float64)).ravel().tolist()
    if len(std) == 1:
        std *= len(distance_m)
    if len(std) != len(distance_m):
        raise UsageError(
            f"give one 'distance_std_m', or one for each of the {len(distance_m)} distances, got {len(std)}"
        )
    if stated is None:  # of a board a few millimetres away it would be no small error
        return [min(one, _MOST_DISTANCE_STD * d) for one, d in zip(std, distance_m, strict=True)]
    for one, distance in zip(std, distance_m, strict=True):
        if distance > 0 and not 0 <= one <= _MOST_DISTANCE_STD * distance:
            raise UsageError(
                f"'distance_std_m' must be a number of metres from 0 to a tenth of the distance, "
                f"{_MOST_DISTANCE_STD * distance:g} at {distance:g} m, got {one:g}"
            )
    return std


def say_of_distances(std_m: Sequence[float], *, assumed: bool) -> str:
    """Describe the assumed uncertainty of the distances."""
    if not any(std_m):
        return "The distances were taken to be exact; standard errors hold only as far as they are."
    shown = dict.fromkeys(f"{1e3 * one:.3g}" for one in std_m)
    source = "assumed" if assumed else "stated"
    return (
        f"The distances were {source} to have a standard deviation of {', '.join(shown)} mm, "
        "independent of one another; the standard errors allow for it."
    )
