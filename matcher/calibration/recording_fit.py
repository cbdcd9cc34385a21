"""Calibration from a recording with many poses: delay, offsets of zones, noise law and slow errors beside the mounting.

The ranges y of frame k are modelled as

    y = f(pose at stamp + delay, mounting) + zone offsets + S (e_k + e_b) + n

with the slopes S of the ranges by distance, δ, bearing, height and time, an error e_k of the pose of each frame, an
error e_b common to each block of time, and the noise n of pixels. Mounting and zone offsets are found by Gauss–Newton
under the covariance of the rest, with weak priors on the mounting. The sizes of e_k, e_b and of the zone offsets are
those of the greatest restricted likelihood (:mod:`phasemark.matcher.estimate.variances`); the noise law is fitted to
the squares of the residuals. So errors that vary slowly widen the covariance instead of being divided by √N.

Only pixels that the model says see nothing but the landmark have weight, and of these only those whose residual is
within a few standard deviations: a floor, a wall or an edge does not enter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from phasemark import UsageError
from phasemark.matcher.calibration import notes as sentences
from phasemark.matcher.calibration.checks import check_poses, check_ranges, check_view, returns_beside
from phasemark.matcher.calibration.mounting import columns_of, prior_std
from phasemark.matcher.calibration.mounting_model import EFFECTS, Images, range_residual
from phasemark.matcher.calibration.problem import Problem, Solution, in_image, rms
from phasemark.matcher.estimate.variances import RandomEffects
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render.sensor.range_noise import direct_range_std
from phasemark.render.sensor.sensor_file import rounded

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]
_Noise = tuple[float, float, float]
"""Constant, shot and ambient part of the noise law of a direct sensor, metres."""

_BLOCK_S, _BLOCKS, _SHORTEST_BLOCK_S = 2.0, 20, 0.5
"""Length of a block of time, seconds, the number of blocks that a short recording is cut into, and their length."""
_ZONE_UNIT_M = 1e-3
_UNIT = np.array([1e-3, math.radians(0.1), math.radians(0.1), 1e-3, 5e-3])
"""Units of the errors of poses: 1 mm, 0.1°, 0.1°, 1 mm, and 5 ms of time."""
_SIZE_BOUNDS, _ZONE_BOUNDS = (0.02, 100.0), (0.02, 50.0)
"""Of the sizes of errors of poses and of zone offsets, in their units."""
_APPROACH, _ROUNDS, _STEPS = 8, 3, 3
_FIRST_GATE_M = 0.25
_GATE = 4.0
"""Standard deviations beyond which a pixel has no weight."""
_SETTLED = 0.01
"""A step below this many standard deviations ends the iteration."""
_LEAST_NOISE_M = 1e-4
FOLDS = 4
"""Parts into which blocks of time are dealt to be held out."""


def solve_recording(problem: Problem, *, moving: bool) -> Solution:
    """Find mounting, delay, zone offsets and noise from many poses, by time or one for each frame."""
    notes: list[str] = []
    if moving:
        problem, notes = problem.by_time()
    else:
        check_poses(problem)
    fit = RecordingFit(problem)
    if not moving:
        check_view(fit.model, fit.evidence, problem.assumed)
    images = fit.model.images(fit.assumed)
    check_ranges(fit.model, fit.evidence, np.where(fit.candidates(images), fit.residual(images), np.nan))
    solution = fit.solve(fit.approach())
    std = np.sqrt(np.diag(solution.covariance))
    delay_std = std[problem.names.index("delay")] if "delay" in problem.names else 0.0
    delay_unknown_s = 0.05
    if delay_std > delay_unknown_s:
        raise UsageError(
            f"the delay cannot be determined from this recording (± {1e3 * delay_std:.0f} ms): turn and approach"
            " faster, or state it with Mounting(delay_s=…) and give fixed=delay"
        )
    prior = fit.prior * fit.scale
    from_prior = 0.7  # standard deviation over that of the prior, from which the data are said not to tell a number
    untold = [name for name, of_prior in zip(problem.names, std > from_prior * prior, strict=True) if of_prior]
    return replace(solution, notes=(*notes, *sentences.untold_notes(untold), *solution.notes))


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of the random parts of the model.

    Parameters
    ----------
    frame, block : (5,) float64
        Of pose errors of frames and of blocks of time: distance, δ, bearing, height, and time (jitter of the stamps);
        in their units.
    zone : float
        Of the zone offsets, in theirs.
    """

    frame: _Float
    block: _Float
    zone: float = 2.0

    @property
    def variance(self) -> _Float:
        """Of both pose errors together, (5,); squares of metres, radians, seconds."""
        return np.asarray((self.frame**2 + self.block**2) * _UNIT**2)


class RecordingFit:
    """One calibration from a recording.

    Parameters
    ----------
    problem : Problem
        On ranges, whatever it says; the albedo is never free.
    edges : bool, optional
        Whether pixels that see the landmark in part count; None: where everything that returns is in the model.
    """

    def __init__(self, problem: Problem, *, edges: bool | None = None) -> None:
        self.problem, self.free, self.zones = problem, problem.names, problem.zones
        self.assumed, self.sensor = problem.assumed.vector, problem.sensor
        self.model, self.evidence = problem.model(), Evidence.from_frames(problem.frames, "ranges")
        direct = self.sensor.kind == "direct"
        if edges is None:
            edges = self.model.has_background or not (direct or returns_beside(self.model, self.evidence))
        self.edges = edges
        self.columns = columns_of(self.free)
        self.scale = self.model.scale[self.columns]
        self.prior = np.array([prior_std(name, self.assumed, self.model.scale) for name in self.free]) / self.scale
        self.stated_zones = self.sensor.zone_offsets.ravel()
        n, stamps, track = len(problem.frames), problem.frames.time_s, problem.track
        block, self.least = np.arange(n), np.zeros(len(EFFECTS))
        if track is not None and stamps is not None:
            length = min(_BLOCK_S, max(float(stamps[-1] - stamps[0]) / _BLOCKS, _SHORTEST_BLOCK_S))
            block = np.floor((stamps - stamps[0]) / length).astype(np.int64)
            self.least[-1] = track.jitter_s / _UNIT[-1]  # stamps are at least so uncertain
        self.start = np.flatnonzero(np.diff(block, prepend=-1) != 0)
        self.single = len(self.start) == n

    # the model

    def residual(self, images: Images) -> _Float:
        """Return measured less modelled ranges without zone offsets, (K, pixels); NaN where there is none."""
        return np.where(self.evidence.weight > 0, range_residual(self.evidence, images), np.nan)

    def candidates(self, images: Images) -> _Bool:
        """Return which pixels returned and see the landmark, alone and a pixel from its edge unless edges count."""
        there = (images.phasor != 0) & (self.evidence.weight > 0)
        return np.asarray(there if self.edges else there & self.model.alone(images, from_edges=True))

    def seen(self, theta: _Float, zone: _Float) -> tuple[_Float, _Bool]:
        """Return the residuals at a place, and which pixels may count."""
        images = self.model.images(theta)
        return self.residual(images) - zone, self.candidates(images)

    def slopes(self, theta: _Float) -> tuple[_Float, _Float]:
        """Return slopes of the ranges by the free parameters, (K, p, pixels), and by pose errors, (K, 5, pixels)."""
        slope = self.model.slopes(theta, (*self.free, *EFFECTS), "ranges")
        by_free, by_pose = np.split(self.sensor.metres_per_radian * slope.imag, [len(self.free)], axis=1)
        return by_free, by_pose

    # linear algebra

    def linear(self, slopes: tuple[_Float, _Float], residual: _Float, use: _Bool, std: _Float) -> RandomEffects:
        """Return Gram matrices of the parameters (in natural units) and the pose errors (in their units)."""
        weight = np.where(use, 1 / std**2, 0.0)
        r = np.where(use, residual, 0.0)
        j = np.where(use[:, None], slopes[0], 0.0) * self.scale[:, None]
        s = np.where(use[:, None], slopes[1], 0.0) * _UNIT[:, None]
        wj, ws = weight[:, None] * j, weight[:, None] * s
        js, jr = j @ ws.transpose(0, 2, 1), np.einsum("kpr,kr->kp", wj, r)
        jj = np.add.reduceat(j @ wj.transpose(0, 2, 1), self.start, axis=0)
        if self.zones:  # slopes by the offset of a zone are 1 there and 0 elsewhere
            js = np.concatenate([js, _ZONE_UNIT_M * ws.transpose(0, 2, 1)], axis=1)
            jr = np.concatenate([jr, _ZONE_UNIT_M * weight * r], axis=1)
            cross = _ZONE_UNIT_M * np.add.reduceat(wj, self.start, axis=0)
            own = _ZONE_UNIT_M**2 * np.add.reduceat(weight, self.start, axis=0)
            square = own[:, :, None] * np.eye(own.shape[1])
            jj = np.block([[jj, cross], [cross.transpose(0, 2, 1), square]])
        return RandomEffects(
            jj,
            np.add.reduceat(jr, self.start, axis=0),
            js,
            s @ ws.transpose(0, 2, 1),
            np.einsum("ksr,kr->ks", ws, r),
            float((weight * r**2).sum()),
            self.start,
        )

    def prior_of(self, theta: _Float, zone: _Float, sizes: Sizes) -> tuple[_Float, _Float]:
        """Return the prior's precision and how far its mean is from a place, (P,) each, in natural units."""
        precision, away = self.prior**-2.0, (self.assumed - theta)[self.columns] / self.scale
        if not self.zones:
            return precision, away
        of_zones = np.full(zone.shape, sizes.zone**-2.0)
        return np.append(precision, of_zones), np.append(away, (self.stated_zones - zone) / _ZONE_UNIT_M)

    def step(
        self, linear: RandomEffects, theta: _Float, zone: _Float, sizes: Sizes, keep: _Bool | None = None
    ) -> tuple[_Float, _Float]:
        """Return the Gauss–Newton step and the covariance, in natural units."""
        information, gradient, _, _ = linear.marginal(sizes.frame, sizes.block, keep)
        precision, away = self.prior_of(theta, zone, sizes)
        covariance = np.asarray(np.linalg.inv(information + np.diag(precision)))
        return covariance @ (gradient + precision * away), covariance

    def moved(self, theta: _Float, zone: _Float, step: _Float) -> tuple[_Float, _Float]:
        """Return the place a step leads to."""
        own, of_zones = np.split(step, [len(self.free)])
        there = self.model.stepped(theta, self.columns, self.scale * own)
        return there, zone + _ZONE_UNIT_M * of_zones if self.zones else zone

    def settled(self, step: _Float, covariance: _Float, share: float) -> bool:
        """Return True if the mounting moves by less than a share of its standard deviations."""
        return bool((np.abs(step) < share * np.sqrt(np.diag(covariance)))[: len(self.free)].all())

    # sizes of errors

    def sizes(self, linear: RandomEffects, theta: _Float, zone: _Float, start: Sizes) -> Sizes:
        """Return the most likely sizes; one that gains too little likelihood is zero."""
        effects = len(EFFECTS)
        own = effects if self.single else 2 * effects

        def unpacked(log: _Float, active: _Bool) -> Sizes:
            values = np.where(active, np.exp(log), 0.0)
            block = np.zeros(effects) if self.single else values[effects:own]
            return Sizes(np.maximum(values[:effects], self.least), block, values[own] if self.zones else start.zone)

        def cost(log: _Float, active: _Bool) -> float:
            sizes = unpacked(log, active)
            return linear.minus_two_log(sizes.frame, sizes.block, self.prior_of(theta, zone, sizes))

        def fitted(log: _Float, active: _Bool) -> tuple[_Float, float]:
            if not active.any():
                return log, cost(log, active)

            def whole(part: _Float) -> _Float:
                out = log.copy()
                out[active] = part
                return out

            def cost_of(part: _Float) -> float:
                return cost(whole(part), active)

            bounds = [(low, high) for low, high in limits[active]]
            found = optimize.minimize(
                cost_of, log[active], method="L-BFGS-B", bounds=bounds,
                options={"eps": 1e-3, "maxiter": 10, "ftol": 1e-6},
            )  # fmt: skip
            return whole(found.x), float(found.fun)

        limits = np.log([_SIZE_BOUNDS] * own + [_ZONE_BOUNDS] * self.zones)
        before = np.clip(start.frame if self.single else np.append(start.frame, start.block), 0.5, 20.0)
        log = np.log(np.append(before, [np.clip(start.zone, 0.1, 20.0)] * self.zones))
        active = np.ones(len(log), bool)
        log, best = fitted(log, active)
        dropped = False
        needed = 2.71  # −2 log likelihood that a size of errors must gain (5 %, one-sided), or it is taken to be zero
        while active[:own].any():
            without = []
            for i in np.flatnonzero(active[:own]):
                fewer = active.copy()
                fewer[i] = False
                without.append((cost(log, fewer), i))
            lowest, i = min(without)
            if lowest - best >= needed:
                break
            active[i], best, dropped = False, lowest, True
        if dropped:
            log, _ = fitted(log, active)
        return unpacked(log, active)

    def noise(self, residual: _Float, leverage: _Float, use: _Bool, old: _Noise) -> _Noise:
        """Return the noise law of a direct sensor: squares of residuals regressed on 1, 1/I and 1/I².

        Gamma regression by iterated, non-negative least squares. The shot term enters only where it gains likelihood
        beside the ambient one, whose shape over a short span of ranges is nearly the same.
        """
        square = residual[use] ** 2 / np.maximum(1 - leverage[use], 0.1)
        over_i = self.evidence.seen.range_m[use] ** 2 / 0.8
        best = (math.inf, old)
        term_shows = 6.63  # −2 log likelihood that a term of the noise law must gain (1 %)
        for terms in ((0,), (0, 2), (0, 1), (0, 1, 2)):
            design = np.stack([over_i**power for power in terms], axis=1)
            variance = np.full(len(square), square.mean())
            found = np.zeros(len(terms))
            for _ in range(8):
                found = optimize.nnls(design / variance[:, None], square / variance)[0]
                variance = np.maximum(design @ found, _LEAST_NOISE_M**2)
            cost = float((np.log(variance) + square / variance).sum()) + term_shows * len(terms)
            if cost < best[0]:
                parts = dict(zip(terms, np.sqrt(found).tolist(), strict=True))
                best = (cost, (parts[0], parts.get(1, 0.0), parts.get(2, 0.0)))
        return best[1]

    def std_of(self, noise: _Noise) -> _Float:
        """Return the noise of each pixel by a noise law, (K, pixels)."""
        constant, shot, ambient = noise
        sensor = self.sensor.with_(range_std_m=constant, range_shot_std_m=shot, range_ambient_std_m=ambient)
        law = direct_range_std(0.8 / np.maximum(self.evidence.seen.range_m, 1e-3) ** 2, sensor)
        return np.asarray(np.maximum(law, _LEAST_NOISE_M))

    # the whole

    def approach(self) -> _Float:
        """Run Gauss–Newton from what is assumed, with a gate that narrows with the residuals; return the place."""
        theta, zone, sizes = self.assumed, self.stated_zones, Sizes(np.full(len(_UNIT), 2.0), np.zeros(len(_UNIT)))
        gate = _FIRST_GATE_M
        for _ in range(_APPROACH):
            residual, seen = self.seen(theta, zone)
            near = seen & (np.abs(residual) < gate)
            if near.sum() < 3 * len(self.free):
                break
            spread = _spread(residual[near])
            gate = max(min(gate, 4 * spread), 1e-3)
            use = seen & (np.abs(residual) < gate)
            linear = self.linear(self.slopes(theta), residual, use, np.full(use.shape, max(spread, 1e-3)))
            step, covariance = self.step(linear, theta, zone, sizes)
            theta, _ = self.moved(theta, zone, step)
            if self.settled(step, covariance, 0.1) and gate > 3.9 * spread:
                break
        return theta

    def misfit(self, theta: _Float) -> float:
        """Return the mean square of the residuals of all candidates, each at most 5 cm, m²."""
        residual, seen = self.seen(theta, self.stated_zones)
        return float((np.minimum(np.abs(residual[seen]), _FIRST_GATE_M / 5) ** 2).mean()) if seen.any() else math.inf

    def solve(self, theta: _Float) -> Solution:
        """Find mounting, zone offsets, noise law and sizes of errors.

        Parameters
        ----------
        theta : (21,) float64
            A place from :meth:`approach`.
        """
        zone, sensor = self.stated_zones, self.sensor
        fits_noise = self.zones and sensor.kind == "direct"
        std = np.sqrt(1 / np.where(self.evidence.weight > 0, self.evidence.weight, 1.0))
        twice = np.full(len(EFFECTS), 2.0)
        sizes = Sizes(twice, np.zeros(len(EFFECTS)) if self.single else twice)
        noise = (sensor.range_std_m, sensor.range_shot_std_m, sensor.range_ambient_std_m)
        if fits_noise:
            residual, seen = self.seen(theta, np.zeros_like(zone))
            spread = _spread(residual[seen & (np.abs(residual) < _FIRST_GATE_M)])
            std = np.full(std.shape, max(min(spread, 0.02), _LEAST_NOISE_M))
        pose_error = None
        for _ in range(_ROUNDS):
            slopes, first = self.slopes(theta), pose_error is None
            for _ in range(_STEPS):
                residual, seen = self.seen(theta, zone)
                use = self._gated(residual, seen, slopes[1], std, sizes, None if first else pose_error)
                linear = self.linear(slopes, residual, use, std)
                step, covariance = self.step(linear, theta, zone, sizes)
                pose_error = linear.errors(step, sizes.frame, sizes.block) * _UNIT
                theta, zone = self.moved(theta, zone, step)
                if self.settled(step, covariance, _SETTLED):
                    break
            residual, seen = self.seen(theta, zone)
            use = self._gated(residual, seen, slopes[1], std, sizes, pose_error)
            linear = self.linear(slopes, residual, use, std)
            if fits_noise:
                noise = self.noise(*self._left(linear, slopes[1], residual, use, std, sizes), use, noise)
                std = self.std_of(noise)
                linear = self.linear(slopes, residual, use, std)
            sizes = self.sizes(linear, theta, zone, sizes)
        step, covariance = self.step(linear, theta, zone, sizes)
        theta, zone = self.moved(theta, zone, step)
        pose_error = linear.errors(step, sizes.frame, sizes.block) * _UNIT
        chi2 = linear.marginal(sizes.frame, sizes.block).quadratic
        after, seen = self.seen(theta, zone)
        before = self.seen(self.assumed, self.stated_zones)[0]
        judged = use | (seen & (np.abs(before) < _GATE * _total(std, slopes[1], sizes)))
        judged &= np.isfinite(before) & np.isfinite(after)
        held_out = self._held_out(self.linear(slopes, after, use, std), slopes[0], after, theta, zone, sizes)
        beside = after - np.einsum("ks,ksr->kr", pose_error, self.slopes(theta)[1])
        left_out = 1 - float(use.sum()) / max(int(seen.sum()), 1)
        dof, systematic, p = int(use.sum()) - len(self.free), np.sqrt(sizes.variance), len(self.free)
        return Solution(
            problem=self.problem,
            theta=theta,
            covariance=covariance[:p, :p] * np.outer(self.scale, self.scale),
            covariance_from="noise, slow errors and weak priors (restricted maximum likelihood)",
            chi2=chi2,
            dof=dof,
            p_value=float(special.chdtrc(max(dof, 1), chi2)),
            use=use,
            residual_m=in_image(after, use, sensor),
            residual_before_m=in_image(before, use, sensor),
            range_std_m=in_image(std, use, sensor),
            pose_shift=pose_error[:, :3],
            pose_chi2=np.where(use, (beside / std) ** 2, 0.0).sum(axis=1),
            held_out_m=(rms(before[judged]), rms(held_out[judged])),
            edges=self.edges,
            notes=tuple(sentences.recording_notes(use, left_out, systematic)),
            left_out=left_out,
            sensor_fields=self._sensor_fields(zone, noise, systematic) if self.zones else {},
        )

    def _gated(
        self, residual: _Float, seen: _Bool, pose: _Float, std: _Float, sizes: Sizes, pose_error: _Float | None
    ) -> _Bool:
        """Return which candidates are within the gate: of all errors, and of the noise beside the pose's error."""
        spread = _total(std, pose, sizes)
        if pose_error is None:
            spread = np.maximum(spread, _spread(residual[seen & (np.abs(residual) < _FIRST_GATE_M)]))
            return np.asarray(seen & (np.abs(residual) < _GATE * spread))
        beside = residual - np.einsum("ks,ksr->kr", pose_error, pose)
        return np.asarray(seen & (np.abs(residual) < _GATE * spread) & (np.abs(beside) < _GATE * 1.25 * std))

    def _left(
        self, linear: RandomEffects, pose: _Float, residual: _Float, use: _Bool, std: _Float, sizes: Sizes
    ) -> tuple[_Float, _Float]:
        """Return residuals beside the pose errors, and the share of their variance that fitting these took."""
        count = linear.jr.shape[1]
        errors = linear.errors(np.zeros(count), sizes.frame, sizes.block) * _UNIT
        s = np.where(use[:, None], pose, 0.0) * (_UNIT[:, None] / std[:, None])
        leverage = np.einsum("ksr,kst,ktr->kr", s, linear.error_covariance(np.hypot(sizes.frame, sizes.block)), s)
        left = residual - np.einsum("ks,ksr->kr", errors, pose)
        return left, np.minimum(leverage + count / max(int(use.sum()), 1), 0.9)

    def _held_out(
        self, linear: RandomEffects, slope: _Float, residual: _Float, theta: _Float, zone: _Float, sizes: Sizes
    ) -> _Float:
        """Return the residuals of each part of the blocks under what the others tell, by the linearised problem."""
        fold = np.arange(len(self.start)) % FOLDS
        of_frame = np.repeat(fold, np.diff(np.append(self.start, len(residual))))
        after = np.full(residual.shape, np.nan)
        for k in range(min(FOLDS, len(self.start))):
            step, _ = self.step(linear, theta, zone, sizes, fold != k)
            change = np.einsum("kpr,p->kr", slope, self.scale * step[: len(self.free)])
            if self.zones:
                change = change + _ZONE_UNIT_M * step[len(self.free) :]
            after[of_frame == k] = (residual - change)[of_frame == k]
        return after

    def _sensor_fields(self, zone: _Float, noise: _Noise, systematic: _Float) -> dict[str, object]:
        """Return zone offsets, noise law and systematic errors as fields of the sensor."""
        distance, delta, bearing, height, time = systematic.tolist()
        table = zone.reshape(self.sensor.rows, self.sensor.cols).tolist()
        fields = {
            "zone_offset_m": tuple(map(tuple, table)),
            **dict(zip(("range_std_m", "range_shot_std_m", "range_ambient_std_m"), noise, strict=True)),
            "systematic_distance_m": distance,
            "systematic_delta_deg": math.degrees(delta),
            "systematic_bearing_deg": math.degrees(bearing),
            "systematic_height_m": height,
            "systematic_time_s": time,
        }
        return {name: rounded(value) for name, value in fields.items()}


def _spread(residual: _Float) -> float:
    """Return the standard deviation that the median of absolute residuals means."""
    median_std = 1.4826  # standard deviation over median absolute deviation of normal errors
    return median_std * float(np.median(np.abs(residual)))


def _total(std: _Float, pose: _Float, sizes: Sizes) -> _Float:
    """Return the standard deviation of ranges by noise and pose errors together, (K, pixels)."""
    return np.asarray(np.sqrt(std**2 + np.einsum("ksr,s->kr", pose**2, sizes.variance)))
