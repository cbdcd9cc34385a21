"""The most likely mounting: registration of outlines to start with, then Levenberg–Marquardt on ranges or phasors.

Residuals are those of :mod:`phasemark.matcher.likelihood.residuals`, all poses together. Where poses are uncertain,
three numbers a pose are estimated beside the mounting, each with its own standard deviation as a prior, and eliminated
pose by pose (Schur complement), so that their cost is linear in the number of poses.

Which pixels count is decided at the start and held while the mounting moves, so that the sum stays comparable; at the
solution it is decided once more, and the mounting moves again.

The cost of ranges has a kink wherever an edge passes the border of a pixel, and small minima between kinks, most along
what the poses tell least. So the neighbourhood of the solution is searched for lower ones before it is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phasemark.matcher.calibration.mounting_model import (
    ALL_NAMES,
    LONGEST_STEP,
    CalibrationModel,
    Images,
)
from phasemark.matcher.calibration.registration import OUTLINE, register
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.pixel_agreement import DISAGREEMENT, one_frame_limit_m
from phasemark.render import predicted_range_std

_CLEAR = 1.5
"""Phasors count where the noise of one frame is below its limit by this factor: nearer to the limit a frame's own noise
decides whether its pixel is valid, and the brighter half would stand for all."""
_STEADY, _ORDINARY = 2.0, 1.5
"""Ranges count where the measured noise of one frame is below its limit by the first factor or, within it, at most the
second times the median of its pose: fainter pixels see little of the landmark, and their ranges jump as it moves."""
_FULL = 1 - 1e-6
"""Coverage of a pixel that sees nothing but the landmark."""
_MAX_ITERATIONS, _FOLLOWED = 40, 8
"""How often slopes are taken, and how many steps are tried with each."""
_SETTLED = 1e-3
"""A step that promises to lower χ² by less than this is not taken; where χ² is more than expected, by as much more."""
_SEARCHED = 3
"""Directions, of those that the poses tell least, along which lower minima are looked for."""
_SEARCH_STD = np.array([-6.0, -5.0, -4.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0])
"""How far along each, standard deviations."""
_SEARCH_MOST = 1.0
"""Cap on a standard deviation that a search goes by (natural units); beyond it the landmark leaves the image."""
_SEARCH_FROM, _SEARCH_SETTLED = 3, 0.03
"""From how many of these places it descends by slopes over standard deviations, and until steps promise so little."""
_WIDTHS = (0.5, 1.0, 2.0)
"""Standard deviations over which slopes are taken for the covariance."""
_SEARCHES, _GAINED = 4, 0.1
"""How often the search is repeated about what it found, unless it saved less."""


@dataclass(frozen=True, eq=False)
class Place:
    """A mounting with the errors of the poses, and how well it fits.

    Parameters
    ----------
    theta : (21,) float64
        Mounting, in the order of :data:`~phasemark.matcher.calibration.mounting_model.ALL_NAMES`.
    u : (K, q) float64
        Errors of the poses, of unit variance each.
    shift : (K, 3) float64
        What they come to, :data:`~phasemark.matcher.calibration.mounting_model.POSE`.
    images : Images
        The model there.
    use : (K, pixels) bool
        Which pixels count.
    residual : (K, R) float64
        Whitened; 0 where a pixel does not count.
    cost : float
        Their sum of squares, with that of `u`.
    """

    theta: NDArray[np.float64]
    u: NDArray[np.float64]
    shift: NDArray[np.float64]
    images: Images
    use: NDArray[np.bool_]
    residual: NDArray[np.float64]
    cost: float


@dataclass(frozen=True, eq=False)
class Knowledge:
    """Information of the frames on the free parameters at one place.

    Parameters
    ----------
    information : (p, p) float64
        Uncertain poses taken into account.
    scatter : (p, p) float64
        Sum of outer products of the poses' own gradients: the middle of a sandwich.
    """

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
class _Linear:
    """Slopes at a mounting, whitened, and the normal matrix with the errors of the poses eliminated."""

    rows: NDArray[np.float64]  # (K, p, R)
    own_rows: NDArray[np.float64]  # (K, q, R)
    cross: NDArray[np.float64]  # (K, p, q)
    own: NDArray[np.float64]  # (K, q, q)
    information: NDArray[np.float64]  # (p, p)

    def gradients(
        self, residual: NDArray[np.float64], u: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the gradients of each pose: by the mounting, (K, p), and by its own errors, (K, q)."""
        own = np.einsum("kqr,kr->kq", self.own_rows, residual) - u
        eliminated = np.einsum("kpq,kq->kp", self.cross, self._solved(own))
        return np.einsum("kpr,kr->kp", self.rows, residual) - eliminated, own

    def pose_information(self) -> NDArray[np.float64]:
        """Return the information of each pose on the mounting, its own errors eliminated, (K, p, p)."""
        eliminated = np.linalg.solve(self.own, self.cross.transpose(0, 2, 1))
        return np.asarray(self.rows @ self.rows.transpose(0, 2, 1) - self.cross @ eliminated)

    def own_step(self, own_gradient: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return by how much each pose's errors move with a step of the mounting, (K, q)."""
        return self._solved(own_gradient - np.einsum("kpq,p->kq", self.cross, step))

    def own_promise(self, own_gradient: NDArray[np.float64]) -> float:
        """Return by how much the cost would fall if the errors of the poses alone changed."""
        return float((own_gradient * self._solved(own_gradient)).sum())

    def _solved(self, own_gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.linalg.solve(self.own, own_gradient[..., None])[..., 0])


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
    noise_measured : bool
        Whether the noise of ranges was measured, and so tells faint pixels; otherwise the model does.
    """

    def __init__(
        self,
        model: CalibrationModel,
        evidence: Evidence,
        free: Sequence[str],
        factor: NDArray[np.float64] | None,
        *,
        edges: bool,
        noise_measured: bool = True,
    ) -> None:
        self.model, self.evidence, self.free = model, evidence, tuple(free)
        self.columns = np.array([ALL_NAMES.index(name) for name in free])
        self.scale = model.scale[self.columns]
        k = len(evidence.weight)
        self.factor = np.zeros((k, 3, 0)) if factor is None else factor
        self.edges = edges
        self._steady = _steady(evidence) if evidence.on == "ranges" and noise_measured else None

    def start(self, theta: NDArray[np.float64]) -> NDArray[np.float64]:
        """Move a mounting to where outlines agree (see :func:`register`); set range offset and albedo by averages."""
        theta = register(self.model, self.evidence, theta, [name for name in OUTLINE if name in self.free]).copy()
        images = self.model.images(theta, self._no_shift)
        full = (self.evidence.weight > 0) & (images.coverage > _FULL)
        if "range_offset" in self.free and full.any():
            turned = self.evidence.value[full] * images.phasor[full].conj()
            mean = np.angle((turned / np.abs(turned)).sum())  # so that no range wraps about the median
            late = mean + np.median(np.angle(turned * np.exp(-1j * mean)))
            theta[ALL_NAMES.index("range_offset")] += self.evidence.sensor.metres_per_radian * late
        if "albedo" in self.free and self.evidence.on == "phasors":
            use = self.pixels(theta, images, cautious=True)
            measured = np.abs(self.evidence.value[use]).sum()
            modelled = np.abs(images.phasor[use]).sum()
            if measured > 0 and modelled > 0:
                theta[ALL_NAMES.index("albedo")] *= measured / modelled
        return theta

    def pixels(self, theta: NDArray[np.float64], images: Images, *, cautious: bool = False) -> NDArray[np.bool_]:
        """Return which pixels count at a mounting, (K, pixels).

        Those that returned and that one frame can measure (PHYSICS section 7): on phasors by what the model says, for
        brightness is part of what is compared; on ranges by what was measured, which no mounting changes, unless their
        noise was not. With `cautious`, where edges may not count, only those a pixel away from any edge, for the
        mounting may still move.
        """
        sensor, clear = self.evidence.sensor, self._steady
        if clear is None:
            std = predicted_range_std(np.abs(images.phasor), images.intensity, sensor)
            limit = one_frame_limit_m(sensor) / (_CLEAR if self.evidence.on == "phasors" else 1.0)
            clear = std <= limit * (1 + 1e-9)
        use = (self.evidence.weight > 0) & (images.phasor != 0) & clear
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

    def solve(
        self, theta: NDArray[np.float64], use: NDArray[np.bool_], shift: NDArray[np.float64] | None = None
    ) -> Place:
        """Run Levenberg–Marquardt with the pixels given, then with those of where it led.

        Parameters
        ----------
        theta : (21,) float64
        use : (K, pixels) bool
        shift : (K, 3) float64, optional
            Errors of the poses to start from; None: none.
        """
        shift = self._no_shift if shift is None else shift
        u = np.einsum("kji,ki->kj", np.linalg.pinv(self.factor), shift)
        place = self._descend(self._at(theta, u, use))
        for _ in range(2):
            place = self._with_its_pixels(place)
        return place

    def search(self, place: Place) -> Place:
        """Move from small minima to lower ones nearby, as long as the cost falls noticeably.

        On ranges with exact poses: phasors have none, and errors of poses blur what a pixel tells by more than small
        minima are wide.
        """
        if self.evidence.on == "phasors" or place.u.size:
            return place
        for _ in range(_SEARCHES):
            before, place = place.cost, min(place, self._lower(place), key=lambda one: one.cost)
            if before - place.cost < _GAINED:
                break
        return self._with_its_pixels(place)

    def knowledge(self, place: Place) -> Knowledge:
        """Return the uncertainty of a place, from slopes that no corner and no faint pixel distort."""
        linear = self._linearise_wide(place, _WIDTHS)
        by_pose, _ = linear.gradients(self._pull(place), place.u)
        return Knowledge(linear.information, by_pose.T @ by_pose)

    def information(self, theta: NDArray[np.float64], use: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the information of some pixels in a mounting, (p, p), at little cost."""
        return self._linearise(self._at(theta, np.zeros((len(use), self.factor.shape[2])), use)).information

    def linear(self, place: Place) -> _Linear:
        """Linearise about a place, with slopes over the standard deviations."""
        return self._linearise_wide(place)

    def _with_its_pixels(self, place: Place) -> Place:
        """Decide again which pixels count, and descend from the place if they changed."""
        use = self.pixels(place.theta, place.images)
        return place if (use == place.use).all() else self._descend(self._at(place.theta, place.u, use))

    def blocks(self, place: Place, unit: NDArray[np.float64]) -> Blocks:
        """Linearise about a place.

        Parameters
        ----------
        place : Place
        unit : (K, 3, 4) float64
            How (D, δ, b) of each pose change with errors of unit size.
        """
        slope, of_pose = self.model.slopes(place.theta, place.shift, self.free, self.evidence.on, of_poses=True)
        rows, own = self._whitened(slope, place), self._whitened(of_pose, place)
        without = place.residual + np.einsum("kir,ki->kr", own, place.shift)
        return Blocks(without, rows * self.scale[:, None], np.einsum("kij,kir->kjr", unit, own))

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

    def _pull(self, place: Place) -> NDArray[np.float64]:
        """Return the residuals that slopes can lower: what the model has left costs the same wherever it goes."""
        if self.evidence.on == "phasors":
            return place.residual
        return np.where(place.images.phasor == 0, 0.0, place.residual)

    def _whitened(self, slope: NDArray[np.complex128], place: Place) -> NDArray[np.float64]:
        """Return whitened slopes, (K, parameters, residuals), of what the model's own say."""
        evidence = self.evidence
        root = np.sqrt(np.where(place.use, evidence.weight, 0.0))[:, None]
        if evidence.on == "ranges":
            seen = np.where((place.images.phasor != 0)[:, None], root, 0.0)
            return np.asarray(evidence.sensor.metres_per_radian * slope.imag * seen)
        return np.concatenate([slope.real * root, slope.imag * root], axis=2)

    def _at(self, theta: NDArray[np.float64], u: NDArray[np.float64], use: NDArray[np.bool_]) -> Place:
        shift = np.einsum("kij,kj->ki", self.factor, u)
        images = self.model.images(theta, shift)
        residual = self._residual(images, use)
        return Place(theta, u, shift, images, use, residual, float((residual**2).sum() + (u**2).sum()))

    def _linearise(self, place: Place, *widths: NDArray[np.float64]) -> _Linear:
        """Take slopes over the least widths, or those given; over several, the median of each pixel's."""
        q = self.factor.shape[2]
        found = [
            self.model.slopes(place.theta, place.shift, self.free, self.evidence.on, of_poses=q > 0, width=width)
            for width in widths or (None,)
        ]
        rows = np.median([self._whitened(slope, place) for slope, _ in found], axis=0)
        own_rows = np.zeros((len(rows), 0, rows.shape[2]))
        if q:
            # the mount's bearing and a pose's move an image alike: only the same slopes cancel where they should
            of_pose = np.median([self._whitened(slope, place) for _, slope in found], axis=0)
            own_rows = np.einsum("kij,kir->kjr", self.factor, of_pose)
        cross = rows @ own_rows.transpose(0, 2, 1)
        own = own_rows @ own_rows.transpose(0, 2, 1) + np.eye(q)
        eliminated = np.linalg.solve(own, cross.transpose(0, 2, 1))  # (K, q, p)
        information = (rows @ rows.transpose(0, 2, 1) - cross @ eliminated).sum(axis=0)
        return _Linear(rows, own_rows, cross, own, information)

    def _linearise_wide(self, place: Place, widths: Sequence[float] = (1.0,)) -> _Linear:
        """Take slopes over multiples of the standard deviations that slopes at the place give."""
        narrow = self._linearise(place)
        scale = self.model.scale
        std = np.zeros(len(ALL_NAMES))
        std[self.columns] = np.sqrt(np.diag(covariance_of(narrow.information, self.scale, weak="wide")))
        std[ALL_NAMES.index("range_offset")] = 0.0  # its slope is exact
        if (max(widths) * std <= self.model.step).all():
            return narrow
        return self._linearise(place, *(np.minimum(width * np.nan_to_num(std), 0.5 * scale) for width in widths))

    def _descend(self, place: Place) -> Place:
        """Run Levenberg–Marquardt; slopes cost most, so they are computed again only when a step with them fails."""
        for _ in range(_MAX_ITERATIONS):
            before, expected = place.cost, float(np.count_nonzero(place.residual))
            settled = _SETTLED * max(1.0, place.cost / max(expected, 1.0))
            place = self._follow(place, self._linearise(place), settled)
            if before - place.cost < settled:
                break
        return place

    def _follow(self, place: Place, linear: _Linear, settled: float) -> Place:
        """Run Levenberg–Marquardt with the same slopes throughout."""
        damping = 1e-3
        for _ in range(_FOLLOWED):
            by_pose, own_gradient = linear.gradients(self._pull(place), place.u)
            gradient = by_pose.sum(axis=0)
            matrix = linear.information * np.outer(self.scale, self.scale)
            matrix = matrix + damping * np.diag(np.maximum(np.diag(matrix), 1e-12))
            step = self.scale * np.linalg.lstsq(matrix, self.scale * gradient, rcond=1e-14)[0]
            step /= max(1.0, float(np.abs(step / self.scale).max()) / LONGEST_STEP)
            if float(gradient @ step) + linear.own_promise(own_gradient) < settled:
                break
            there = self._stepped(place, linear, own_gradient, step)
            gain = place.cost - there.cost
            if gain < 0:
                damping *= 8
                continue
            place, damping = there, max(damping * 0.1, 1e-9)
            if gain < settled:
                break
        return place

    def _stepped(
        self,
        place: Place,
        linear: _Linear,
        own_gradient: NDArray[np.float64],
        step: NDArray[np.float64],
    ) -> Place:
        whole = np.zeros(len(ALL_NAMES))
        whole[self.columns] = step
        theta = self.model.moved(place.theta, whole)
        return self._at(theta, place.u + linear.own_step(own_gradient, step), place.use)

    def _lower(self, place: Place) -> Place:
        """Descend from the best places within six standard deviations along what the poses tell least."""
        wide = self._linearise_wide(place)
        _, own_gradient = wide.gradients(self._pull(place), place.u)
        covariance = covariance_of(wide.information, self.scale, weak="wide")
        values, vectors = np.linalg.eigh(covariance / np.outer(self.scale, self.scale))
        ways = self.scale[:, None] * vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), _SEARCH_MOST)
        steps = (_SEARCH_STD[:, None, None] * ways[:, -_SEARCHED:].T).reshape(-1, len(self.columns))

        def stepped(step: NDArray[np.float64]) -> Place:
            return self._stepped(place, wide, own_gradient, step)

        with ThreadPoolExecutor(self.model.workers) as pool:
            costs = list(pool.map(lambda step: stepped(step).cost, steps))
        descended = [
            self._follow(stepped(steps[k]), wide, _SEARCH_SETTLED)
            for k in np.argsort(costs, kind="stable")[:_SEARCH_FROM]
        ]
        return self._descend(min(descended, key=lambda one: one.cost))


def _steady(evidence: Evidence) -> NDArray[np.bool_]:
    """Return which pixels were measured well enough for their ranges to count, (K, pixels)."""
    std, limit = evidence.one_frame_std_m, one_frame_limit_m(evidence.sensor)
    usual = np.array([np.median(one[known]) if (known := np.isfinite(one)).any() else 0.0 for one in std])
    return np.asarray(std <= np.clip(_ORDINARY * usual, limit / _STEADY, limit)[:, None] * (1 + 1e-9))
