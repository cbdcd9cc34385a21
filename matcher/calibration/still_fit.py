"""The most likely mounting of a camera at rest: outlines to start with, then Levenberg–Marquardt on ranges or phasors.

Residuals are those of :mod:`phasemark.matcher.likelihood.residuals`, all poses together. Where poses are uncertain,
three numbers a pose are estimated beside the mounting, each with its own standard deviation as a prior, and eliminated
pose by pose (Schur complement), so that their cost is linear in the number of poses. Errors of the poses are
independent from pose to pose, normal, and of three sizes: places of the lens, headings, sides δ.

Which pixels count is decided at the start and held while the mounting moves, so that the sum stays comparable; at the
solution it is decided once more, and the mounting moves again.

The cost of ranges has a kink wherever an edge passes the border of a pixel, and small minima between kinks, most along
what the poses tell least. So the neighbourhood of the solution is searched for lower ones before it is taken.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from phasemark import UsageError
from phasemark.matcher.calibration import notes as sentences
from phasemark.matcher.calibration.checks import check_observable, check_pixels, check_poses, check_view, returns_beside
from phasemark.matcher.calibration.known_poses import PoseStd
from phasemark.matcher.calibration.mounting import ALL_NAMES, columns_of
from phasemark.matcher.calibration.mounting_model import LONGEST_STEP, POSE, CalibrationModel, Images, range_residual
from phasemark.matcher.calibration.problem import FEWEST_POSES, AstrayError, Problem, Solution, in_image, rms
from phasemark.matcher.calibration.registration import OUTLINE, register
from phasemark.matcher.chi_squared import p_values_of
from phasemark.matcher.estimate.variances import RandomEffects
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.information import covariance_of
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.pixel_agreement import DISAGREEMENT, one_frame_limit_m
from phasemark.render import predicted_range_std
from phasemark.render.sensor.sensor_file import rounded
from phasemark.render.threads import mapped

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]

_CLEAR = 1.5
"""Phasors count where the noise of one frame is below its limit by this factor: nearer to the limit a frame's own noise
decides whether its pixel is valid, and the brighter half would stand for all."""
_STEADY, _ORDINARY = 2.0, 1.5
"""Ranges count where the measured noise of one frame is below its limit by the first factor or, within it, at most the
second times the median of its pose: fainter pixels see little of the landmark, and their ranges jump as it moves."""
_MAX_ITERATIONS, _FOLLOWED = 40, 8
"""How often slopes are taken, and how many steps are tried with each."""
_SETTLED = 1e-3
"""A step that promises to lower χ² by less than this is not taken; where χ² is more than expected, by as much more."""
_SEARCH_STD = np.array([-6.0, -5.0, -4.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0])
"""How far along each, standard deviations."""
_SEARCH_FROM, _SEARCH_SETTLED = 3, 0.03
"""From how many of these places it descends by slopes over standard deviations, and until steps promise so little."""
_WIDTHS = (0.5, 1.0, 2.0)
"""Standard deviations over which slopes are taken for the covariance."""
_SEARCHES, _GAINED = 4, 0.1
"""Maximum number of repeated searches; stop when the cost falls by less than `_GAINED`."""
FALSE_ALARM = 0.01
"""A fit whose χ² is exceeded with less than this probability does not fit."""
_POSES_FOR_ERRORS, _ROUNDS = 6, 2
"""Fewer poses do not tell the size of their errors; how often these sizes and the mounting are estimated in turn."""
_STD_STARTS = np.log([2e-4, math.radians(0.02), math.radians(0.02)]) + np.array([[0.0], [2.0], [4.0]])
"""Logarithms of the sizes of the poses' errors, metres and radians, where three descents begin."""
_STD_BOUNDS = [(math.log(1e-6), math.log(most)) for most in (0.1, math.radians(10.0), math.radians(10.0))]
"""Nothing is measured better, and nobody would call worse a known pose."""


def solve_still(problem: Problem, pose_std: PoseStd | None) -> Solution:
    """Find the most likely mounting of a camera that stood still at each pose.

    Parameters
    ----------
    problem : Problem
    pose_std : PoseStd, optional
        How well the poses are known. None: they are exact, unless the residuals say that they are not.
    """
    check_poses(problem)
    frames, poses, model = problem.frames, problem.poses, problem.model()
    frames = replace(frames, range_m=frames.range_m - problem.sensor.zone_offsets)  # the range offset is estimated
    frames = frames.with_fixed_pattern()
    evidence = Evidence.from_frames(frames, problem.on)
    check_view(model, evidence, problem.assumed)
    edges = model.has_background or not returns_beside(model, evidence)
    scattered = problem.frames.std_from_scatter
    noise_measured = frames.amplitude_e is not None or scattered or problem.sensor.kind == "direct"

    def fit_with(std: PoseStd | None) -> StillFit:
        factor = None if std is None or std.exact else std.factor(poses)
        return StillFit(model, evidence, problem.names, factor, edges=edges, noise_measured=noise_measured)

    fit = fit_with(pose_std)
    if model.light_bounces:
        model.let_bounce(problem.assumed.vector)
    theta = fit.start(problem.assumed.vector)
    use = fit.pixels(model.images(theta), cautious=True)
    check_pixels(use, poses)
    check_observable(fit.information(theta, use), fit.free, fit.scale, poses)
    minima_cost = 50.0  # χ² that ending in a small minimum may cost; what fits worse has other reasons
    estimated = None
    try:
        place = fit.solve(theta, use)
        if model.light_bounces:
            model.let_bounce(place.theta)
            place = fit.solve(place.theta, place.use, place.shift)
        for _ in range(0 if noise_measured else _ROUNDS):
            evidence = _with_noise_of_the_law(evidence, frames, place.images)
            fit = fit_with(pose_std)
            place = fit.solve(place.theta, place.use, place.shift)
        if fit.p_value(place, less=minima_cost) >= FALSE_ALARM:
            place = fit.search(place)
        if pose_std is None and len(poses) >= _POSES_FOR_ERRORS and fit.p_value(place) < FALSE_ALARM:
            for _ in range(_ROUNDS):
                estimated = fit.pose_std(place)
                fit = fit_with(estimated)
                place = fit.solve(place.theta, place.use, place.shift)
    except UsageError as error:
        raise AstrayError(
            f"frames and poses do not belong together: a fit led to where no camera can be ({error})"
        ) from None
    return _solution(problem, fit, place, frames, estimated)


def _solution(
    problem: Problem, fit: StillFit, place: Place, frames: FilteredFrames, estimated: PoseStd | None
) -> Solution:
    """Return the result of a fit; `estimated` are the pose errors found from the residuals, if they were."""
    poses, use = problem.poses, place.use
    information, scatter, lasting = fit.knowledge(place, frames.pattern_m)
    try:
        check_observable(information, fit.free, fit.scale, poses)
    except UsageError as error:  # all numbers could be determined where the fit began
        raise AstrayError(str(error)) from None
    plain = covariance_of(information, fit.scale, weak="wide")
    dof, p_value, pose_chi2 = fit.dof(place), fit.p_value(place), (place.residual**2).sum(axis=1)
    covariance, expected, source = plain, float(max(dof, 1)), "the noise law"
    if frames.std_from_scatter:
        # weights that were estimated from ν + 1 frames are too large in the mean by ν / (ν − 2), and scatter themselves
        nu = max(float(np.median(frames.n_effective.reshape(len(poses), -1)[use])) - 1, 5.0)
        covariance, expected, source = plain * nu / (nu - 4), expected * nu / (nu - 2), "the scatter of the frames"
    notes = [] if estimated is None else [sentences.pose_std_note(estimated)]
    count = use.sum(axis=1) * fit.evidence.per_pixel
    if dof > 0 and p_value < FALSE_ALARM:
        excess, n, p = place.cost / expected, len(poses), len(fit.free)
        poses_for_sandwich = 3  # poses for each free parameter from which their own scatter tells the covariance
        if n >= poses_for_sandwich * p:
            covariance = plain @ scatter @ plain * n / (n - p)
            source = "the scatter of the poses (sandwich), for the residuals are more than noise"
        else:
            covariance = covariance * excess
            source += f", scaled by χ² = {excess:.3g} for each degree of freedom, for the residuals are more than noise"
        notes += sentences.misfit_notes(excess, p_value, poses, pose_chi2 / np.maximum(count, 1))
    if p_value < FALSE_ALARM or frames.pattern_m:
        covariance = covariance + plain @ lasting @ plain
    notes += sentences.unused_notes(fit.edges, poses, count)
    notes += sentences.observability_notes(fit.free, covariance, fit.scale, poses)
    before, after = (
        range_residual(fit.evidence, images) for images in (fit.model.images(problem.assumed.vector), place.images)
    )
    sensor_fields = {}
    if estimated is not None and problem.sensor.kind == "direct":
        across = estimated.position_m / float(np.median(poses.distance_m))
        sensor_fields = {
            "systematic_distance_m": rounded(estimated.position_m),
            "systematic_delta_deg": rounded(math.degrees(math.hypot(estimated.delta_rad, across))),
            "systematic_bearing_deg": rounded(math.degrees(math.hypot(estimated.heading_rad, across))),
        }
    return Solution(
        problem=problem,
        theta=place.theta,
        covariance=covariance,
        covariance_from=source,
        chi2=place.cost,
        dof=dof,
        p_value=p_value,
        use=use,
        residual_m=in_image(after, use, problem.sensor),
        residual_before_m=in_image(before, use, problem.sensor),
        range_std_m=in_image(np.maximum(fit.evidence.seen.weight, 1e-300) ** -0.5, use, problem.sensor),
        pose_shift=place.shift,
        pose_chi2=pose_chi2,
        held_out_m=fit.held_out(place, before, after),
        edges=fit.edges,
        notes=tuple(notes),
        sensor_fields=sensor_fields,
        pose_std=estimated,
    )


@dataclass(frozen=True, eq=False)
class Place:
    """A mounting with the errors of the poses, and how well it fits.

    Parameters
    ----------
    theta : (22,) float64
        Mounting, in the order of :data:`~phasemark.matcher.calibration.mounting.ALL_NAMES`.
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

    theta: _Float
    u: _Float
    shift: _Float
    images: Images
    use: _Bool
    residual: _Float
    cost: float


class _Linear:
    """Slopes at a mounting, whitened, and the normal matrix with the errors of the poses eliminated.

    Parameters
    ----------
    rows : (K, p, R) float64
        By the mounting.
    own_rows : (K, q, R) float64
        By errors of the poses of unit variance.
    """

    def __init__(self, rows: _Float, own_rows: _Float) -> None:
        self.rows, self.own_rows = rows, own_rows
        self.cross = rows @ own_rows.transpose(0, 2, 1)
        self.own = own_rows @ own_rows.transpose(0, 2, 1) + np.eye(own_rows.shape[1])
        eliminated = np.linalg.solve(self.own, self.cross.transpose(0, 2, 1))
        self.pose_information = rows @ rows.transpose(0, 2, 1) - self.cross @ eliminated
        """Of each pose on the mounting, (K, p, p)."""
        self.information: _Float = self.pose_information.sum(axis=0)

    def gradients(self, residual: _Float, u: _Float) -> tuple[_Float, _Float]:
        """Return the gradients of each pose: by the mounting, (K, p), and by its own errors, (K, q)."""
        own = np.einsum("kqr,kr->kq", self.own_rows, residual) - u
        eliminated = np.einsum("kpq,kq->kp", self.cross, self.solved(own))
        return np.einsum("kpr,kr->kp", self.rows, residual) - eliminated, own

    def own_step(self, own_gradient: _Float, step: _Float) -> _Float:
        """Return by how much each pose's errors move with a step of the mounting, (K, q)."""
        return self.solved(own_gradient - np.einsum("kpq,p->kq", self.cross, step))

    def solved(self, own_gradient: _Float) -> _Float:
        """Return by how much each pose's errors would move if the mounting stayed, (K, q)."""
        return np.asarray(np.linalg.solve(self.own, own_gradient[..., None])[..., 0])


class StillFit:
    """One calibration problem.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
        Filtered frames, one for each pose.
    free : sequence of str
    factor : (K, 3, q) float64, optional
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
        factor: _Float | None = None,
        *,
        edges: bool,
        noise_measured: bool = True,
    ) -> None:
        self.model, self.evidence, self.free = model, evidence, tuple(free)
        self.columns = columns_of(free)
        self.scale = model.scale[self.columns]
        k = len(evidence.weight)
        self.factor = np.zeros((k, 3, 0)) if factor is None else factor
        self.edges = edges
        self._steady = _steady(evidence) if evidence.on == "ranges" and noise_measured else None

    def start(self, theta: _Float) -> _Float:
        """Move a mounting to where outlines agree (see :func:`register`); set range offset and albedo by averages."""
        theta = register(self.model, self.evidence, theta, [name for name in OUTLINE if name in self.free]).copy()
        images = self.model.images(theta)
        full = (self.evidence.weight > 0) & self.model.alone(images)
        if "range_offset" in self.free and full.any():
            turned = self.evidence.value[full] * images.phasor[full].conj()
            mean = np.angle((turned / np.abs(turned)).sum())  # so that no range wraps about the median
            late = mean + np.median(np.angle(turned * np.exp(-1j * mean)))
            theta[ALL_NAMES.index("range_offset")] += self.evidence.sensor.metres_per_radian * late
        if "albedo" in self.free and self.evidence.on == "phasors":
            use = self.pixels(images, cautious=True)
            measured = np.abs(self.evidence.value[use]).sum()
            modelled = np.abs(images.phasor[use]).sum()
            if measured > 0 and modelled > 0:
                theta[ALL_NAMES.index("albedo")] *= measured / modelled
        return theta

    def pixels(self, images: Images, *, cautious: bool = False) -> _Bool:
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
            use &= self.model.alone(images, from_edges=cautious)
        return np.asarray(use)

    def solve(self, theta: _Float, use: _Bool, shift: _Float | None = None) -> Place:
        """Run Levenberg–Marquardt with the pixels given, then with those of where it led.

        Parameters
        ----------
        theta : (22,) float64
        use : (K, pixels) bool
        shift : (K, 3) float64, optional
            Errors of the poses to start from; None: none.
        """
        u = np.zeros((len(use), self.factor.shape[2]))
        if shift is not None:
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

    def knowledge(self, place: Place, pattern_m: float = 0.0) -> tuple[_Float, _Float, _Float]:
        """Return the information of a place, from slopes that no corner and no faint pixel distort, and its scatter.

        Parameters
        ----------
        place : Place
        pattern_m : float
            Standard deviation of a fixed pattern that is known to be in the ranges; 0: the residuals tell it.

        Returns
        -------
        information : (p, p) float64
            On the free parameters, uncertain poses taken into account.
        scatter : (p, p) float64
            Sum of outer products of the poses' own gradients: the middle of a sandwich.
        lasting : (p, p) float64
            What residuals of a pixel that are alike in all poses, as those of a fixed pattern, add to that.
        """
        linear = self._linearise_wide(place, _WIDTHS)
        pull = self._pull(place)
        by_pose, _ = linear.gradients(pull, place.u)
        alike = pattern_m * np.sqrt(self.evidence.weight) if pattern_m and self.evidence.on == "ranges" else pull
        own = (linear.rows * alike[:, None]).reshape(len(pull), len(self.free), self.evidence.per_pixel, -1).sum(axis=2)
        own = own / self.scale[:, None]
        by_pixel = own.sum(axis=0)
        value, vectors = np.linalg.eigh(by_pixel @ by_pixel.T - np.einsum("kpr,kqr->pq", own, own))
        axes = self.scale[:, None] * vectors * np.sqrt(np.maximum(value, 0.0))
        return linear.information, by_pose.T @ by_pose, axes @ axes.T

    def information(self, theta: _Float, use: _Bool) -> _Float:
        """Return the information of some pixels in a mounting, (p, p), at little cost."""
        return self._linearise(self._at(theta, np.zeros((len(use), self.factor.shape[2])), use)).information

    def dof(self, place: Place) -> int:
        """Return the degrees of freedom of the fit."""
        return int(place.use.sum()) * self.evidence.per_pixel - len(self.free)

    def p_value(self, place: Place, *, less: float = 0.0) -> float:
        """Return the chance of a χ² as large as that of a place less something."""
        cost, dof = np.array([max(place.cost - less, 0.0)]), np.array([self.dof(place)])
        return float(p_values_of(cost, dof, self.evidence.noise_tails[:1])[0])

    def pose_std(self, place: Place) -> PoseStd:
        """Return the sizes of the poses' errors of the greatest restricted likelihood, linearised about a place."""
        names = (*self.free, *POSE[:3])
        slope = self._whitened(self.model.slopes(place.theta, names, self.evidence.on, shift=place.shift), place)
        rows, own = np.split(slope, [len(self.free)], axis=1)
        errors = np.einsum("kij,kir->kjr", PoseStd(1.0, 1.0, 1.0).factor(self.model.poses), own)
        exact = place.residual + np.einsum("kir,ki->kr", own, place.shift)
        effects = RandomEffects.of_frames(rows * self.scale[:, None], errors, exact)

        def cost(log: _Float) -> float:
            return effects.minus_two_log(np.exp(log)[[0, 0, 1, 2]])  # a lens moves along and across

        with np.errstate(invalid="ignore"):  # of poses that go with nothing all sizes may cost infinitely much
            found = [
                optimize.minimize(
                    cost, start, method="Nelder-Mead", bounds=_STD_BOUNDS, options={"xatol": 0.02, "fatol": 0.02}
                )
                for start in _STD_STARTS
            ]
        best = min(found, key=lambda one: float(one.fun))
        return PoseStd(*np.exp(best.x).tolist())

    def held_out(self, place: Place, before_m: _Float, after_m: _Float) -> tuple[float, float]:
        """Return the r.m.s. residual of each pose with the mounting assumed, and with that of all other poses.

        The second by the jackknife of the linearised problem: without pose k the mounting moves by −(H − H_k)⁻¹ g_k.
        """
        both = place.use & np.isfinite(before_m) & np.isfinite(after_m)
        if len(both) <= FEWEST_POSES or not both.any():
            return math.nan, math.nan
        linear = self._linearise_wide(place)
        by_pose, _ = linear.gradients(place.residual, place.u)
        slope = self.model.slopes(place.theta, self.free, "ranges", shift=place.shift)
        slope_m, after_m = self.evidence.sensor.metres_per_radian * slope.imag, after_m.copy()
        for k, gradient in enumerate(by_pose):
            left = linear.information - linear.pose_information[k]
            step = covariance_of(left, self.scale, weak="wide") @ gradient
            after_m[k] += np.einsum("pr,p->r", slope_m[k], np.clip(step, -10 * self.scale, 10 * self.scale))
        return rms(before_m[both]), rms(after_m[both])

    def _with_its_pixels(self, place: Place) -> Place:
        """Decide again which pixels count, and descend from the place if they changed."""
        use = self.pixels(place.images)
        return place if (use == place.use).all() else self._descend(self._at(place.theta, place.u, use))

    def _residual(self, images: Images, use: _Bool) -> _Float:
        """Return whitened residuals, (K, pixels), on phasors (K, 2 · pixels)."""
        evidence = self.evidence
        root = np.sqrt(np.where(use, evidence.weight, 0.0))
        if evidence.on == "ranges":
            # a chosen pixel that the model no longer sees costs DISAGREEMENT, whatever the step
            lost = np.where(use, math.sqrt(DISAGREEMENT), 0.0)
            return np.where(images.phasor == 0, lost, range_residual(evidence, images) * root)
        difference = (evidence.value - images.phasor) * root
        return np.concatenate([difference.real, difference.imag], axis=1)

    def _pull(self, place: Place) -> _Float:
        """Return the residuals that slopes can lower: what the model has left costs the same wherever it goes."""
        if self.evidence.on == "phasors":
            return place.residual
        return np.where(place.images.phasor == 0, 0.0, place.residual)

    def _whitened(self, slope: NDArray[np.complex128], place: Place) -> _Float:
        """Return whitened slopes, (K, parameters, residuals), of what the model's own say."""
        evidence = self.evidence
        root = np.sqrt(np.where(place.use, evidence.weight, 0.0))[:, None]
        if evidence.on == "ranges":
            seen = np.where((place.images.phasor != 0)[:, None], root, 0.0)
            return np.asarray(evidence.sensor.metres_per_radian * slope.imag * seen)
        return np.concatenate([slope.real * root, slope.imag * root], axis=2)

    def _at(self, theta: _Float, u: _Float, use: _Bool) -> Place:
        shift = np.einsum("kij,kj->ki", self.factor, u)
        images = self.model.images(theta, shift)
        residual = self._residual(images, use)
        return Place(theta, u, shift, images, use, residual, float((residual**2).sum() + (u**2).sum()))

    def _linearise(self, place: Place, *widths: _Float) -> _Linear:
        """Take slopes over the least widths, or those given; over several, the median of each pixel's."""
        names = (*self.free, *POSE[:3]) if self.factor.shape[2] else self.free
        found = [
            self._whitened(
                self.model.slopes(place.theta, names, self.evidence.on, shift=place.shift, width=width), place
            )
            for width in widths or (None,)
        ]
        rows, own = np.split(np.median(found, axis=0), [len(self.free)], axis=1)
        return _Linear(rows, np.einsum("kij,kir->kjr", self.factor[:, : own.shape[1]], own))

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
            if float(gradient @ step) + float((own_gradient * linear.solved(own_gradient)).sum()) < settled:
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

    def _stepped(self, place: Place, linear: _Linear, own_gradient: _Float, step: _Float) -> Place:
        theta = self.model.stepped(place.theta, self.columns, step)
        return self._at(theta, place.u + linear.own_step(own_gradient, step), place.use)

    def _lower(self, place: Place) -> Place:
        """Descend from the best places within six standard deviations along what the poses tell least."""
        wide = self._linearise_wide(place)
        _, own_gradient = wide.gradients(self._pull(place), place.u)
        covariance = covariance_of(wide.information, self.scale, weak="wide")
        values, vectors = np.linalg.eigh(covariance / np.outer(self.scale, self.scale))
        # cap on a standard deviation that a search goes by (natural units); beyond it the landmark leaves the image
        search_most = 1.0
        ways = self.scale[:, None] * vectors * np.minimum(np.sqrt(np.maximum(values, 0.0)), search_most)
        searched = 3  # directions, of those that the poses tell least, along which lower minima are looked for
        steps = (_SEARCH_STD[:, None, None] * ways[:, -searched:].T).reshape(-1, len(self.columns))

        def stepped(step: _Float) -> Place:
            return self._stepped(place, wide, own_gradient, step)

        costs = mapped(lambda step: stepped(step).cost, list(steps), self.model.workers)
        descended = [
            self._follow(stepped(steps[k]), wide, _SEARCH_SETTLED)
            for k in np.argsort(costs, kind="stable")[:_SEARCH_FROM]
        ]
        return self._descend(min(descended, key=lambda one: one.cost))


def _with_noise_of_the_law(evidence: Evidence, frames: FilteredFrames, images: Images) -> Evidence:
    """Return ranges with the noise that the law has for the light of model images, which edges and slopes lessen."""
    std = np.maximum(predicted_range_std(np.abs(images.phasor), images.intensity, evidence.sensor), 1e-4)
    count = frames.n_effective.reshape(std.shape)
    return replace(evidence, weight=np.where(evidence.weight > 0, count / std**2, 0.0))


def _steady(evidence: Evidence) -> _Bool:
    """Return which pixels were measured well enough for their ranges to count, (K, pixels)."""
    std, limit = evidence.one_frame_std_m, one_frame_limit_m(evidence.sensor)
    usual = np.array([np.median(one[known]) if (known := np.isfinite(one)).any() else 0.0 for one in std])
    return np.asarray(std <= np.clip(_ORDINARY * usual, limit / _STEADY, limit)[:, None] * (1 + 1e-9))
