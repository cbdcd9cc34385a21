"""Photon transfer: phase variances against the light, and what a weighted fit of the noise law says of them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from phasemark.render.bench.fit.boards import BoardData
from phasemark.render.bench.fit.fitted_sensor import Floats
from phasemark.render.sensor.range_noise import exact_phase_moments

NOISE_LEVELS_RATIO = 1.5  # largest light over smallest that tells two terms of the noise law apart


@dataclass(frozen=True, eq=False)
class NoiseData:
    """Phase variances (boards, pixels) beside the light, |S|, with their degrees of freedom."""

    light: Floats
    light_std: Floats  # (boards,), relative, of the boards' distances
    phase_variance: Floats
    degrees: Floats

    @classmethod
    def of(cls, data: BoardData) -> NoiseData:
        """Take the pixels used."""
        good = data.good
        variance = data.variance_m2[:, good] / data.sensor.metres_per_radian**2
        mean = variance.mean(axis=1, keepdims=True)
        # the law is a little low where noise is high: by what the exact density says
        above_law = np.ones_like(mean)
        np.divide(exact_phase_moments(np.sqrt(mean))[0], mean, out=above_law, where=mean > 0)
        light_std = 2 * data.distance_std_m / data.distance_m
        return cls(data.light[:, good], light_std, variance / above_law, data.n[:, good] - 1)

    @property
    def levels_differ(self) -> bool:
        """Whether the light of the boards tells what follows it from what does not."""
        mean = self.light.mean(axis=1)
        return bool(mean.max() >= NOISE_LEVELS_RATIO * mean.min())

    def two_terms(self, y: Floats, first: Floats, second: Floats) -> tuple[Floats, Floats]:
        """Fit y = p·first + q·second, where y has the relative variance 2 / degrees; return (p, q) and covariance.

        The weights come from the fit itself, in three rounds: weights from y would favour what chance made small.
        """
        design = np.column_stack([first.ravel(), second.ravel()])
        target, degrees = y.ravel(), self.degrees.ravel()
        expected = np.repeat(y.mean(axis=1), y.shape[1])
        for _ in range(4):
            root = np.sqrt(degrees / 2) / np.maximum(np.abs(expected), 1e-300)
            solution, covariance = solve_scaled(design * root[:, None], target * root)
            expected = design @ solution
            expected = np.where(expected > 0, expected, np.repeat(y.mean(axis=1), y.shape[1]))
        return solution, covariance

    def one_term(self, y: Floats) -> tuple[float, float]:
        """Return the mean of a y that should be the same everywhere, and its standard error."""
        weight = self.degrees / self.degrees.sum()
        mean = float((weight * y).sum())
        return mean, abs(mean) * math.sqrt(2 / float(self.degrees.sum()))

    def electrons_per_unit(self, amplitude: Floats, intensity: Floats) -> tuple[float, float] | None:
        """Return electrons a unit from 2σ_φ²A² = g·I + g²V, or None if the light does not vary enough."""
        mean = intensity.mean(axis=1)
        if not mean.max() >= NOISE_LEVELS_RATIO * max(mean.min(), 0) or mean.min() <= 0:
            return None
        (gain, _), covariance = self.two_terms(
            2 * self.phase_variance * amplitude**2, intensity, np.ones_like(intensity)
        )
        error = math.sqrt(covariance[0, 0])
        return None if gain <= 2 * error else (1 / gain, error / gain**2)


def solve_scaled(design: Floats, target: Floats) -> tuple[Floats, Floats]:
    """Solve least squares of unit weight, columns scaled; return solution and covariance."""
    scale = np.linalg.norm(design, axis=0)
    covariance = np.linalg.inv((design / scale).T @ (design / scale))
    return covariance @ ((design / scale).T @ target) / scale, covariance / np.outer(scale, scale)
