"""The most likely mounting: registration of outlines to start with, then Levenberg–Marquardt on ranges or phasors.

Residuals are those of :mod:`phasemark.matcher.likelihood`, all poses together. Where poses are uncertain, three numbers
a pose are estimated beside the mounting, each with its own standard deviation as a prior, and eliminated pose by pose
(Schur complement), so that their cost is linear in the number of poses.

Which pixels count is decided at the start and held while the mounting moves, so that the sum stays comparable; at the
solution it is decided once more, and the mounting moves again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phasemark.matcher.calibrate_model import NAMES, SCALE, CalibrationModel, Images, clipped
from phasemark.matcher.coarse import DISAGREEMENT
from phasemark.matcher.likelihood import Evidence, one_frame_limit_m
from phasemark.render import predicted_range_std

_OUTLINE = ("pitch", "roll", "height", "bearing", "half_angle_h", "half_angle_v")
"""What an outline tells."""
_OUTLINE_STD = np.array([3.0, 3.0, 3.0, 3.0, 0.7, 0.7])
"""How far each may be from where it was thought to be, in natural units: only the registration leans on it."""
_OUTLINE_NOISE = 0.2
"""Of a pixel: how much of it the model says returns, against whether it did."""
_RETURNS_FROM, _PREVAILS_FROM = 0.2, 0.6
"""Coverage that is enough for a return, and for one from the landmark if something stands behind; below, the chance of
it is taken to rise evenly."""
_TRIED = np.array([-3.0, -1.5, 0.0, 1.5, 3.0])
"""Pitches and bearings, degrees, from which the registration may start: a pixel apart."""
_BESIDE = 0.02
"""Share of pixels with a return from elsewhere, above which something stands behind."""
_OUTLINE_STEPS = 6
_OUTLINE_WIDTH = 0.2
"""Half width of its differences, natural units: a seventh of a pixel."""
_NEARBY_M = 0.1
"""A return so much farther from the landmark than its own size is something else."""
_CLEAR = 1.5
"""Phasors count where the noise of one frame is below its limit by this factor: nearer to the limit a frame's own noise
decides whether its pixel is valid, and the brighter half would stand for all."""
_FULL = 1 - 1e-6
"""Coverage of a pixel that sees nothing but the landmark."""
_MAX_ITERATIONS = 40
_SETTLED = 1e-3
"""A step that promises to lower the whitened squared residual by less than this is not taken."""
_LONGEST = 1.0
"""No step is longer, in natural units: slopes jump where edges pass corners of pixels."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the likelihood is greatest.

    Parameters
    ----------
    theta : (8,) float64
        Mounting, in the order of :data:`~phasemark.matcher.calibrate_model.NAMES`.
    shift : (K, 3) float64
        Estimated errors of the poses, :data:`~phasemark.matcher.calibrate_model.POSE`.
    images : Images
        The model there.
    use : (K, pixels) bool
    residual : (K, R) float64
        Whitened; 0 where a pixel does not count.
    cost : float
        Their sum of squares, with that of the poses' errors in their standard deviations.
    information : (p, p) float64
        In the free parameters, uncertain poses taken into account.
    scatter : (p, p) float64
        Sum of outer products of the poses' own gradients: the middle of a sandwich.
    """

    theta: NDArray[np.float64]
    shift: NDArray[np.float64]
    images: Images
    use: NDArray[np.bool_]
    residual: NDArray[np.float64]
    cost: float
    information: NDArray[np.float64]
    scatter: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Blocks:
    """A linearised problem, whitened; R residuals a pose.

    Parameters
    ----------
    residual : (K, R) float64
        Without any errors of the poses.
    mounting : (K, p, R) float64
        Slopes by the free parameters, natural units.
    pose : (K, 4, R) float64
        Slopes by errors of unit size.
    """

    residual: NDArray[np.float64]
    mounting: NDArray[np.float64]
    pose: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Sums:
    """Normal equations with the poses eliminated."""

    information: NDArray[np.float64]
    gradient: NDArray[np.float64]
    scatter: NDArray[np.float64]
    cross: NDArray[np.float64]  # (K, p, q)
    own: NDArray[np.float64]  # (K, q, q)
    own_gradient: NDArray[np.float64]  # (K, q)


class Fit:
    """One calibration problem.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
        Filtered frames, one for each pose.
    free : sequence of str
    factor : (K, 3, q) float64 or None
        Root of the covariance of each pose's errors; None: they are exact.
    edges : bool
        Whether pixels that see the landmark in part may count.
    """

    def __init__(
        self,
        model: CalibrationModel,
        evidence: Evidence,
        free: Sequence[str],
        factor: NDArray[np.float64] | None,
        *,
        edges: bool,
    ) -> None:
        self.model, self.evidence, self.free = model, evidence, tuple(free)
        self.columns = np.array([NAMES.index(name) for name in free])
        self.scale = SCALE[self.columns]
        k = len(evidence.weight)
        self.factor = np.zeros((k, 3, 0)) if factor is None else factor
        self.edges = edges

    def start(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move a mounting to where outlines agree (see :func:`register`), and set the albedo to the mean brightness."""
        theta = register(self.model, self.evidence, theta, [name for name in _OUTLINE if name in self.free])
        if "albedo" in self.free and self.evidence.on == "phasors":
            images = self.model.images(theta, self._no_shift)
            use = self.pixels(theta, images, cautious=True)
            measured = np.abs(self.evidence.value[use]).sum()
            modelled = np.abs(images.phasor[use]).sum()
            if measured > 0 and modelled > 0:
                theta = theta.copy()
                theta[-1] *= measured / modelled
        return theta

    def pixels(self, theta: NDArray[np.float64], images: Images, *, cautious: bool = False) -> NDArray[np.bool_]:
        """Return which pixels count at a mounting, (K, pixels).

        Those that returned and that the model says one frame can measure (PHYSICS section 7); with `cautious`, where
        edges may not count, only those a pixel away from any edge, for the mounting may still move.
        """
        sensor = self.evidence.sensor
        limit = one_frame_limit_m(sensor) / (_CLEAR if self.evidence.on == "phasors" else 1.0)
        std = predicted_range_std(np.abs(images.phasor), images.intensity, sensor)
        use = (self.evidence.weight > 0) & (images.phasor != 0) & (std <= limit * (1 + 1e-9))
        if not self.edges:
            full = images.coverage > _FULL
            if cautious:
                shaped = full.reshape(len(full), sensor.rows, sensor.cols)
                full = ndimage.minimum_filter(shaped, size=(1, 3, 3), mode="nearest").reshape(full.shape)
            use &= full
        return np.asarray(use)

    @property
    def _no_shift(self) -> NDArray[np.float64]:
        return np.zeros((len(self.evidence.weight), 3))

    def solve(self, theta: NDArray[np.float64], use: NDArray[np.bool_]) -> Solution:
        """Run Levenberg–Marquardt from a mounting with the pixels given, then with those of the solution."""
        u = np.zeros((len(use), self.factor.shape[2]))
        for _ in range(2):
            theta, u = self._descend(theta, u, use)
            images = self.model.images(theta, self._shift(u))
            again = self.pixels(theta, images)
            if (again == use).all():
                break
            use = again
        else:
            theta, u = self._descend(theta, u, use)
        return self.conclude(theta, u, use)

    def conclude(self, theta: NDArray[np.float64], u: NDArray[np.float64], use: NDArray[np.bool_]) -> Solution:
        """Take stock of a mounting, with slopes over its standard deviations."""
        shift = self._shift(u)
        images = self.model.images(theta, shift)
        residual = self._residual(images, use)
        sums = self._sums(theta, u, images, use)
        std = np.zeros(len(NAMES))
        std[self.columns] = np.sqrt(np.diag(inverse(sums.information, self.scale)))
        std = np.minimum(np.nan_to_num(std), 0.5 * SCALE)
        sums = self._sums(theta, u, images, use, width=std)
        cost = float((residual**2).sum() + (u**2).sum())
        return Solution(theta, shift, images, use, residual, cost, sums.information, sums.scatter)

    def blocks(self, solution: Solution, unit: NDArray[np.float64]) -> Blocks:
        """Linearise about a solution.

        Parameters
        ----------
        solution : Solution
        unit : (K, 3, 4) float64
            How (D, δ, b) of each pose change with errors of unit size.
        """
        slope, of_pose = self.model.slopes(solution.theta, solution.shift, self.free, self.evidence.on, of_poses=True)
        rows = self._whitened(slope, solution.images, solution.use)
        own = self._whitened(of_pose, solution.images, solution.use)
        without = solution.residual + np.einsum("kir,ki->kr", own, solution.shift)
        return Blocks(without, rows * self.scale[:, None], np.einsum("kij,kir->kjr", unit, own))

    def _shift(self, u: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.einsum("kij,kj->ki", self.factor, u))

    def _residual(self, images: Images, use: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return whitened residuals, (K, pixels), on phasors (K, 2 · pixels)."""
        evidence = self.evidence
        root = np.sqrt(np.where(use, evidence.weight, 0.0))
        if evidence.on == "ranges":
            turned = np.angle(evidence.value * images.phasor.conj())
            residual = evidence.sensor.metres_per_radian * turned * root
            # what the model has left since the pixels were chosen disagrees, at a price that no move can lower to none
            return np.where(use & (images.phasor == 0), math.sqrt(DISAGREEMENT), residual)
        difference = (evidence.value - images.phasor) * root
        return np.concatenate([difference.real, difference.imag], axis=1)

    def _whitened(self, slope: NDArray[np.complex128], images: Images, use: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return whitened slopes, (K, parameters, residuals), of what the model's own say."""
        evidence = self.evidence
        root = np.sqrt(np.where(use, evidence.weight, 0.0))[:, None]
        if evidence.on == "ranges":
            seen = np.where((images.phasor != 0)[:, None], root, 0.0)
            return np.asarray(evidence.sensor.metres_per_radian * slope.imag * seen)
        return np.concatenate([slope.real * root, slope.imag * root], axis=2)

    def _sums(
        self,
        theta: NDArray[np.float64],
        u: NDArray[np.float64],
        images: Images,
        use: NDArray[np.bool_],
        width: NDArray[np.float64] | None = None,
    ) -> _Sums:
        q = self.factor.shape[2]
        slope, of_pose = self.model.slopes(
            theta, self._shift(u), self.free, self.evidence.on, of_poses=q > 0, width=width
        )
        rows = self._whitened(slope, images, use)
        residual = self._residual(images, use)
        own_rows = np.zeros((len(rows), 0, rows.shape[2]))
        if q:
            own_rows = np.einsum("kij,kir->kjr", self.factor, self._whitened(of_pose, images, use))
        cross = rows @ own_rows.transpose(0, 2, 1)
        own = own_rows @ own_rows.transpose(0, 2, 1) + np.eye(q)
        own_gradient = np.einsum("kjr,kr->kj", own_rows, residual) - u
        eliminated = np.linalg.solve(own, cross.transpose(0, 2, 1))  # (K, q, p)
        gradient = np.einsum("kpr,kr->kp", rows, residual) - np.einsum("kqp,kq->kp", eliminated, own_gradient)
        information = (rows @ rows.transpose(0, 2, 1) - cross @ eliminated).sum(axis=0)
        scatter = np.einsum("ka,kb->ab", gradient, gradient)
        return _Sums(information, gradient.sum(axis=0), scatter, cross, own, own_gradient)

    def _descend(
        self, theta: NDArray[np.float64], u: NDArray[np.float64], use: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        damping = 1e-3
        images = self.model.images(theta, self._shift(u))
        cost = float((self._residual(images, use) ** 2).sum() + (u**2).sum())
        sums = self._sums(theta, u, images, use)
        for _ in range(_MAX_ITERATIONS):
            matrix = sums.information * np.outer(self.scale, self.scale)
            matrix = matrix + damping * np.diag(np.maximum(np.diag(matrix), 1e-12))
            step = self.scale * np.linalg.lstsq(matrix, self.scale * sums.gradient, rcond=1e-14)[0]
            step /= max(1.0, float(np.abs(step / self.scale).max()) / _LONGEST)
            own_step = np.linalg.solve(
                sums.own, (sums.own_gradient - np.einsum("kpq,p->kq", sums.cross, step))[..., None]
            )
            promise = float(sums.gradient @ step)
            if u.size:
                promise += float(
                    (sums.own_gradient * np.linalg.solve(sums.own, sums.own_gradient[..., None])[..., 0]).sum()
                )
            if promise < _SETTLED:
                break
            moved = theta.copy()
            moved[self.columns] += step
            moved, moved_u = clipped(moved), u + own_step[..., 0]
            there = self.model.images(moved, self._shift(moved_u))
            its_cost = float((self._residual(there, use) ** 2).sum() + (moved_u**2).sum())
            if its_cost <= cost:
                theta, u, images = moved, moved_u, there
                done = cost - its_cost < _SETTLED
                cost, damping = its_cost, max(damping * 0.1, 1e-9)
                if done:
                    break
                sums = self._sums(theta, u, images, use)
            else:
                damping *= 8
                if damping > 1e5:
                    break
        return theta, u


def register(
    model: CalibrationModel, evidence: Evidence, theta: NDArray[np.float64], free: Sequence[str]
) -> NDArray[np.float64]:
    """Move a mounting to where the landmark's outlines agree with which pixels returned from near it.

    Gauss–Newton on coverage less return, over differences of a seventh of a pixel, from the best of several pitches
    and bearings. It needs no amplitudes, comes from two degrees away to some tenths of a pixel, and cares little what
    stands behind.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
    theta : (8,) float64
        Where the mounting is thought to be.
    free : sequence of str
        What may move.

    Returns
    -------
    (8,) float64
    """
    if not free:
        return theta
    seen = evidence.seen
    near = np.abs(seen.range_m - model.poses.distance_m[:, None]) < model.reach_m + _NEARBY_M
    target = np.where(seen.returned & near, 1.0, 0.0)
    known = seen.returned | seen.not_returned
    if not (known & ~seen.returned).any() and (target[known] == 1).all():
        known = np.ones_like(known)  # nothing was told apart: what is missing returned nothing
    enough = _PREVAILS_FROM if (seen.returned & ~near).mean() > _BESIDE else _RETURNS_FROM
    columns = np.array([NAMES.index(name) for name in free])
    scale = SCALE[columns]
    prior = np.array([_OUTLINE_STD[_OUTLINE.index(name)] for name in free])

    def difference(at: NDArray[np.float64]) -> NDArray[np.float64]:
        returns = np.minimum(model.coverage(at) / enough, 1.0)
        return np.asarray(np.where(known, target - returns, 0.0) / _OUTLINE_NOISE)

    def cost(at: NDArray[np.float64]) -> float:
        away = (at - theta)[columns] / scale / prior
        return float((difference(at) ** 2).sum() + (away**2).sum())

    tried = [theta]
    for name in ("pitch", "bearing"):
        if name in free:
            steps = np.eye(len(NAMES))[NAMES.index(name)] * SCALE[NAMES.index(name)]
            tried = [clipped(one + side * steps) for one in tried for side in _TRIED]
    best = min(tried, key=cost)
    for _ in range(_OUTLINE_STEPS):
        rows = []
        for column in columns:
            move = np.eye(len(NAMES))[column] * SCALE[column] * _OUTLINE_WIDTH
            rows.append((difference(best - move) - difference(best + move)).ravel() / (2 * _OUTLINE_WIDTH))
        design = np.array(rows)
        away = (best - theta)[columns] / scale
        matrix = design @ design.T + np.diag(1 / prior**2)
        step = np.linalg.solve(matrix, design @ difference(best).ravel() - away / prior**2)
        step /= max(1.0, float(np.abs(step).max()) / _LONGEST)
        moved = best.copy()
        moved[columns] += scale * step
        moved = clipped(moved)
        if cost(moved) >= cost(best):
            break
        best = moved
    return best


def inverse(information: NDArray[np.float64], scale: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a covariance; infinite variance along what is not observed.

    Parameters
    ----------
    information : (p, p) float64
    scale : (p,) float64
        Natural units, for the sake of rounding.
    """
    scaled = information * np.outer(scale, scale)
    root = np.sqrt(np.maximum(np.diag(scaled), 1e-20))
    values, vectors = np.linalg.eigh(scaled / np.outer(root, root))
    unit = vectors / np.where(values > 1e-12, np.sqrt(np.maximum(values, 1e-300)), 1e-8)
    covariance = (unit @ unit.T) / np.outer(root, root)
    return np.asarray(covariance * np.outer(scale, scale))
