"""The descent that all evidence shares: against closed forms of least squares."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from phasemark.matcher.estimate.solver import descend, newton_step


@dataclass(frozen=True)
class Curve:
    """Squared distance of a + b · exp(−rate · t) from its values at a = 2, b = 3, rate = 0.7, within bounds."""

    at: np.ndarray
    highest: float = np.inf
    TIMES = np.linspace(0, 4, 9)

    @property
    def _off(self) -> np.ndarray:
        a, b, rate = self.at
        return np.asarray(2 + 3 * np.exp(-0.7 * self.TIMES) - a - b * np.exp(-rate * self.TIMES))

    @property
    def _slope(self) -> np.ndarray:
        _, b, rate = self.at
        fall = np.exp(-rate * self.TIMES)
        return np.stack([np.ones(9), fall, -b * self.TIMES * fall])

    @property
    def cost(self) -> float:
        return float((self._off**2).sum())

    @property
    def information(self) -> np.ndarray:
        return np.asarray(self._slope @ self._slope.T)

    @property
    def gradient(self) -> np.ndarray:
        return np.asarray(self._slope @ self._off)

    def moved(self, step: np.ndarray) -> Curve:
        return Curve(np.minimum(self.at + step, self.highest), self.highest)


@pytest.mark.parametrize("seed", range(20))
def test_a_step_is_the_least_squares_solution_of_least_length_whatever_is_observed(seed: int) -> None:
    rng = np.random.default_rng(seed)
    p, rank = int(rng.integers(1, 6)), int(rng.integers(1, 6))
    design = rng.normal(size=(12, rank)) @ rng.normal(size=(rank, p)) * 10.0 ** rng.uniform(-2, 2, p)
    measured, root = rng.normal(size=12), np.linalg.norm(design, axis=0)
    # numpy's answer in units of equal information: of all that explain the measurement equally well the shortest
    want = np.linalg.lstsq(design / root, measured, rcond=1e-6)[0]
    step = newton_step(design.T @ design, design.T @ measured, 1 / root)
    np.testing.assert_allclose(step * root, want, rtol=1e-3, atol=1e-6)  # of a ridge of 1e-9 over the least eigenvalue


@pytest.mark.parametrize("seed", range(10))
def test_a_descent_comes_to_the_minimum_and_its_cost_never_rises(seed: int) -> None:
    costs: list[float] = []

    class Watched(Curve):
        def moved(self, step: np.ndarray) -> Watched:
            assert (np.abs(step) <= [0.5, 0.5, 0.2 + 1e-12]).all()
            return Watched(self.at + step)

        @property
        def information(self) -> np.ndarray:
            costs.append(self.cost)
            return super().information

    start = Watched(np.array([2, 3, 0.7]) + np.random.default_rng(seed).uniform(-0.5, 0.5, 3))
    end, left, steps = descend(start, np.array([0.5, 0.5, 0.2]), most=30, done=1e-20, shares=(1, 0.3, 0.09))
    np.testing.assert_allclose(end.at + left, [2, 3, 0.7], atol=1e-8)
    assert (np.diff(costs) <= 0).all()
    assert steps == len(costs) < 30


def test_a_descent_stops_at_bounds_at_a_small_promise_and_after_its_steps() -> None:
    start, longest = Curve(np.array([1.9, 2.8, 0.6]), highest=2.9), np.ones(3)
    bounded, left, _ = descend(start, longest, most=30, shares=(1, 0.3, 0.09, 0.027))
    assert bounded.at[1] == 2.9
    assert (left == 0).all()
    free = Curve(start.at)
    near, left, steps = descend(free, longest, most=30, done=free.cost)
    assert (near.at == free.at).all()
    assert steps == 1
    np.testing.assert_allclose(left, np.linalg.solve(free.information, free.gradient), rtol=1e-6)
    assert descend(free, longest, most=2)[2] == 2


def test_nothing_observed_moves_nothing() -> None:
    assert (newton_step(np.zeros((2, 2)), np.zeros(2), np.ones(2)) == 0).all()
    # a parameter known a million times worse than another, in units of its longest step, is noise of the slopes
    step = newton_step(np.diag([4.0, 4e-12]), np.array([2.0, 1e-6]), np.ones(2))
    assert step.tolist() == [pytest.approx(0.5), 0.0]
