"""Calibration from a recording with many poses: delay, offsets of zones, noise law and slow errors beside the mounting.

The ranges y of frame k are modelled as

    y = f(pose at stamp + delay, mounting) + zone offsets + S (e_k + e_b) + n

with the slopes S of the ranges by distance, δ, bearing, height and time, an error e_k of the pose of each frame, an
error e_b common to each block of time, and the noise n of pixels. Mounting and zone offsets are found by Gauss–Newton
under the covariance of the rest, with weak priors on the mounting. The sizes of e_k, e_b and of the zone offsets are
those of the greatest restricted likelihood (Patterson & Thompson 1971); the noise law is fitted to the squares of what
is left. So errors that vary slowly widen the covariance instead of being divided by √N.

Only pixels that the model says see nothing but the landmark have weight, and of these only those whose residual is
within a few standard deviations: a floor, a wall or an edge does not enter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from phasemark.matcher.calibration.mounting_model import ALL_NAMES, STEP, CalibrationModel, Images
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.render import Sensor
from phasemark.render.sensor.lens_fields import TERMS
from phasemark.render.sensor.range_noise import direct_range_std

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]

PRIOR_STD = {
    "pitch": math.radians(2.0),
    "roll": math.radians(2.0),
    "height": 0.05,
    "bearing": math.radians(3.0),
    "half_angle_h": 0.05,
    "half_angle_v": 0.05,
    "range_offset": 0.05,
    "delay": 0.2,
    "fx": 0.05,
    "fy": 0.05,
    **dict.fromkeys(("cx", "cy"), 2.0),
    **dict.fromkeys(TERMS[4:], 3.0),
}
"""How far a mounting is from the assumed one, standard deviations; half angles and focal lengths relative, principal
point and distortion in natural units. Also the range in which the model is trusted: a result beyond three of them is
not."""
_OF_ITSELF = ("half_angle_h", "half_angle_v", "fx", "fy")
_FULL = 1 - 1e-6
_ZONE_UNIT_M = 1e-3
_SIZE_UNIT = np.array([1e-3, math.radians(0.1), math.radians(0.1), 1e-3, 5e-3])
"""Units of the errors of poses: 1 mm, 0.1°, 0.1°, 1 mm, and 5 ms of time."""
_EFFECTS = len(_SIZE_UNIT)
_SIZE_BOUNDS = (0.02, 100.0)
_ZONE_BOUNDS = (0.02, 50.0)
_APPROACH, _ROUNDS, _STEPS = 8, 3, 3
_FIRST_GATE_M = 0.25
_GATE = 4.0
"""Standard deviations beyond which a pixel has no weight."""
_SETTLED = 0.01
"""A step below this many standard deviations ends the iteration."""
_NEEDED = 2.71
"""−2 log likelihood that a size of errors must gain (5 %, one-sided), or it is taken to be zero."""
_LEAST_NOISE_M = 1e-4
_CHUNK = 10
"""Frames in one matrix product."""
FOLDS = 4
"""Parts into which blocks of time are dealt to be held out."""


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of the random parts of the model.

    Parameters
    ----------
    frame, block : (5,) float64
        Of pose errors of frames and of blocks of time: distance, δ, bearing, height, and time (jitter of the stamps);
        metres, radians, seconds.
    zone_m : float
        Of the zone offsets.
    """

    frame: _Float
    block: _Float
    zone_m: float


@dataclass(frozen=True, eq=False)
class Linear:
    """The problem linearised about a place, whitened by the noise of pixels; frames in blocks."""

    jj: _Float  # (blocks, P, P)
    jr: _Float  # (blocks, P)
    js: _Float  # (K, P, 5)
    ss: _Float  # (K, 5, 5)
    sr: _Float  # (K, 5)
    rr: float
    start: NDArray[np.int64]  # first frame of each block
    log_noise: float

    def marginal(self, sizes: Sizes, keep: _Bool | None = None) -> tuple[_Float, _Float, float, float]:
        """Eliminate the pose errors.

        Parameters
        ----------
        sizes : Sizes
        keep : (blocks,) bool, optional
            Blocks that enter.

        Returns
        -------
        information : (P, P)
        gradient : (P,)
        quadratic : float
            rᵀ V⁻¹ r.
        log_det : float
            Logarithm of the determinant of V over that of the pixels' noise.
        """
        every = np.ones(len(self.start), bool) if keep is None else keep
        counts = np.diff(np.append(self.start, len(self.js)))
        frames = np.repeat(every, counts)
        js, ss, sr = self.js[frames], self.ss[frames], self.sr[frames]
        solved, log_det = _shrunk(ss, sizes.frame / _SIZE_UNIT)
        js_e = js @ solved
        information = self.jj[every].sum(axis=0) - _summed(js_e, js)
        e_sr = np.einsum("kij,kj->ki", solved, sr)
        gradient = self.jr[every].sum(axis=0) - np.einsum("kpi,ki->p", js, e_sr)
        quadratic = self.rr - float(np.einsum("ki,ki->", sr, e_sr))
        if (sizes.block > 0).any():
            start = np.concatenate([[0], np.cumsum(counts[every])[:-1]])
            of_block = np.add.reduceat(js - js_e @ ss, start, axis=0)
            own = np.add.reduceat(ss - ss @ solved @ ss, start, axis=0)
            pull = np.add.reduceat(sr - np.einsum("kij,kj->ki", ss, e_sr), start, axis=0)
            solved_b, log_b = _shrunk(own, sizes.block / _SIZE_UNIT)
            information = information - _summed(of_block @ solved_b, of_block)
            pulled = np.einsum("bij,bj->bi", solved_b, pull)
            gradient = gradient - np.einsum("bpi,bi->p", of_block, pulled)
            quadratic -= float(np.einsum("bi,bi->", pull, pulled))
            log_det += log_b
        return information, gradient, quadratic, log_det

    def pose_errors(self, sizes: Sizes, step: _Float) -> _Float:
        """Return the estimated pose errors of each frame after a step of the parameters, (K, 5) in units."""
        sr = self.sr - np.einsum("kpi,p->ki", self.js, step)
        solved, _ = _shrunk(self.ss, sizes.frame / _SIZE_UNIT)
        own = np.einsum("kij,kj->ki", solved, sr)
        if not (sizes.block > 0).any():
            return np.asarray(own)
        counts = np.diff(np.append(self.start, len(self.js)))
        pull = np.add.reduceat(sr - np.einsum("kij,kj->ki", self.ss, own), self.start, axis=0)
        gram = np.add.reduceat(self.ss - self.ss @ solved @ self.ss, self.start, axis=0)
        solved_b, _ = _shrunk(gram, sizes.block / _SIZE_UNIT)
        common = np.repeat(np.einsum("bij,bj->bi", solved_b, pull), counts, axis=0)
        own = np.einsum("kij,kj->ki", solved, sr - np.einsum("kij,kj->ki", self.ss, common))
        return np.asarray(own + common)


def _summed(a: _Float, b: _Float) -> _Float:
    """Return the sum over k of a_k b_kᵀ, in products too small for a BLAS to spread them over busy processors."""
    n = -(-len(a) // _CHUNK)
    padding = ((0, n * _CHUNK - len(a)), (0, 0), (0, 0))

    def chunks(one: _Float) -> _Float:
        whole = np.pad(one, padding).reshape(n, _CHUNK, one.shape[1], one.shape[2])
        return np.ascontiguousarray(whole.transpose(0, 2, 1, 3)).reshape(n, one.shape[1], -1)

    return np.asarray((chunks(a) @ chunks(b).transpose(0, 2, 1)).sum(axis=0))


def _shrunk(gram: _Float, size: _Float) -> tuple[_Float, float]:
    """Return L (1 + L G L)⁻¹ L for each Gram matrix G with L = diag(size), and the sum of log det(1 + L G L)."""
    middle = np.eye(len(size)) + size[:, None] * gram * size
    solved = size[:, None] * np.linalg.inv(middle) * size
    return solved, float(np.linalg.slogdet(middle)[1].sum())


@dataclass(frozen=True, eq=False)
class Recorded:
    """Result of fitting a recording.

    Parameters
    ----------
    theta : (21,) float64
    covariance : (p, p) float64
        Of the free parameters; radians, metres, seconds.
    zone_m, zone_std_m : (pixels,) float64
        Offsets of zones and their standard deviations; 0 where they were not estimated.
    noise : tuple of float
        Constant, shot and ambient part of the noise law.
    sizes : Sizes
    systematic : (5,) float64
        Standard deviations of pose errors: distance, δ, bearing, height, time.
    use : (K, pixels) bool
    candidates : (K, pixels) bool
        Pixels that the model says see the landmark alone.
    residual_m, before_m, std_m : (K, pixels) float64
        Residuals with what was found and with what was assumed; noise of pixels.
    pose_error : (K, 5) float64
    chi2 : float
    held_out_m : (before, after)
        Root mean square of the residuals of frames that did not enter, with what was assumed and with what the other
        frames told.
    """

    theta: _Float
    covariance: _Float
    zone_m: _Float
    zone_std_m: _Float
    noise: tuple[float, float, float]
    sizes: Sizes
    systematic: _Float
    use: _Bool
    candidates: _Bool
    residual_m: _Float
    before_m: _Float
    std_m: _Float
    pose_error: _Float
    chi2: float
    held_out_m: tuple[float, float]


class Recording:
    """One calibration from a recording.

    Parameters
    ----------
    model : CalibrationModel
    evidence : Evidence
        Ranges, one position a frame, in the order of time.
    free : sequence of str
        Parameters to estimate; never the albedo.
    assumed : (21,) float64
    block : (K,) int64
        Block of time of each frame, ascending.
    edges : bool
        Whether pixels that see the landmark in part count.
    zones : bool
        Whether the offsets of zones and the noise law of a direct sensor are estimated.
    jitter_s : float
        Smallest standard deviation of the error of a stamp.
    """

    def __init__(
        self,
        model: CalibrationModel,
        evidence: Evidence,
        free: Sequence[str],
        assumed: _Float,
        block: NDArray[np.int64],
        *,
        edges: bool,
        zones: bool,
        jitter_s: float = 0.0,
    ) -> None:
        self.least = np.array([0.0, 0.0, 0.0, 0.0, jitter_s])
        self.model, self.evidence, self.free, self.assumed = model, evidence, tuple(free), assumed
        self.columns = np.array([ALL_NAMES.index(name) for name in free])
        self.scale = model.scale[self.columns]
        self.edges, self.zones = edges, zones
        self.start = np.flatnonzero(np.concatenate([[True], np.diff(block) != 0]))
        self.sensor: Sensor = model.sensor
        self.pixels = self.sensor.rows * self.sensor.cols
        self.prior = np.array([prior_std(name, assumed, model.scale) for name in free]) / self.scale
        self.single = len(self.start) == len(block)

    # the model

    def residual(self, images: Images) -> _Float:
        """Return measured less modelled ranges without zone offsets, (K, pixels); NaN where there is none."""
        evidence = self.evidence
        there = (images.phasor != 0) & (evidence.weight > 0)
        turned = np.angle(evidence.value * images.phasor.conj())
        return np.where(there, evidence.sensor.metres_per_radian * turned, np.nan)

    def images(self, theta: _Float) -> Images:
        """Render all frames."""
        return self.model.images(theta, np.zeros((len(self.evidence.weight), 4)))

    def candidates(self, images: Images) -> _Bool:
        """Return which pixels returned and see the landmark, alone and a pixel from its edge unless edges count."""
        there = (images.phasor != 0) & (self.evidence.weight > 0)
        if self.edges:
            return np.asarray(there)
        full = (images.coverage > _FULL).reshape(-1, self.sensor.rows, self.sensor.cols)
        inner = ndimage.minimum_filter(full, size=(1, 3, 3), mode="nearest")
        return np.asarray(there & inner.reshape(there.shape))

    def slopes(self, theta: _Float) -> tuple[_Float, _Float]:
        """Return slopes of the ranges by the free parameters, (K, p, pixels), and by pose errors, (K, 5, pixels)."""
        k = len(self.evidence.weight)
        rendered = [name for name in self.free if name not in ("height", "bearing", "range_offset", "delay")]
        scale = self.evidence.sensor.metres_per_radian

        def difference(job: tuple[str | None, int]) -> _Float:
            name, column = job
            half = STEP if name is None else self.model.step[ALL_NAMES.index(name)]
            span = 2 * half
            if name in TERMS:
                span = self.model.span(theta, ALL_NAMES.index(name), half)
            ends = []
            for side in (1.0, -1.0):
                there, shift = theta.copy(), np.zeros((k, 4))
                if name is None:
                    shift[:, column] = side * half
                elif name in TERMS:
                    there = self.model.beside(theta, ALL_NAMES.index(name), side * half)
                else:
                    there[ALL_NAMES.index(name)] += side * half
                ends.append(self.model.images(there, shift).phasor)
            return np.asarray(scale * np.angle(ends[0] * ends[1].conj()) / span)

        jobs: list[tuple[str | None, int]] = [(name, 0) for name in rendered] + [(None, i) for i in range(4)]
        with ThreadPoolExecutor(self.model.workers) as pool:
            found = list(pool.map(difference, jobs))
        pose = np.stack(found[len(rendered) :], axis=1)
        by_time = np.einsum("ks,ksr->kr", self.model.pose_rates(theta), pose)
        by_name = dict(zip(rendered, found, strict=False))
        by_name["range_offset"] = np.ones_like(pose[:, 0])
        by_name["bearing"], by_name["height"] = pose[:, 2], pose[:, 3]
        by_name["delay"] = by_time
        effects = np.concatenate([pose, by_time[:, None]], axis=1)
        return np.stack([by_name[name] for name in self.free], axis=1), effects

    # linear algebra

    def linear(self, slopes: tuple[_Float, _Float], residual: _Float, use: _Bool, std: _Float) -> Linear:
        """Return Gram matrices of the parameters (in natural units) and the pose errors (in their units)."""
        weight = np.where(use, 1 / std**2, 0.0)
        r = np.where(use, residual, 0.0)
        j = np.where(use[:, None], slopes[0], 0.0) * self.scale[:, None]
        s = np.where(use[:, None], slopes[1], 0.0) * _SIZE_UNIT[:, None]
        p, z = len(self.free), self.pixels if self.zones else 0
        wj, ws = weight[:, None] * j, weight[:, None] * s
        js = np.zeros((len(r), p + z, _EFFECTS))
        js[:, :p] = j @ ws.transpose(0, 2, 1)
        of_frame = np.zeros((len(r), p + z))
        of_frame[:, :p] = np.einsum("kpr,kr->kp", wj, r)
        jj = np.zeros((len(self.start), p + z, p + z))
        jj[:, :p, :p] = np.add.reduceat(j @ wj.transpose(0, 2, 1), self.start, axis=0)
        if z:
            js[:, p:] = _ZONE_UNIT_M * ws.transpose(0, 2, 1)
            of_frame[:, p:] = _ZONE_UNIT_M * weight * r
            cross = _ZONE_UNIT_M * np.add.reduceat(wj, self.start, axis=0)
            jj[:, :p, p:], jj[:, p:, :p] = cross, cross.transpose(0, 2, 1)
            index = p + np.arange(z)
            jj[:, index, index] = _ZONE_UNIT_M**2 * np.add.reduceat(weight, self.start, axis=0)
        return Linear(
            jj,
            np.add.reduceat(of_frame, self.start, axis=0),
            js,
            s @ ws.transpose(0, 2, 1),
            np.einsum("ksr,kr->ks", ws, r),
            float((weight * r**2).sum()),
            self.start,
            float(2 * np.log(std[use]).sum()),
        )

    def prior_of(self, theta: _Float, zone: _Float, sizes: Sizes) -> tuple[_Float, _Float]:
        """Return the prior's precision and how far its mean is from a place, (P,) each, in natural units."""
        precision = np.asarray(1 / self.prior**2, np.float64)
        away: _Float = (self.assumed - theta)[self.columns] / self.scale
        if not self.zones:
            return precision, away
        zone_precision = np.full(self.pixels, (_ZONE_UNIT_M / sizes.zone_m) ** 2)
        stated = self.sensor.zone_offsets.ravel()
        return np.concatenate([precision, zone_precision]), np.concatenate([away, (stated - zone) / _ZONE_UNIT_M])

    def step(
        self, linear: Linear, theta: _Float, zone: _Float, sizes: Sizes, keep: _Bool | None = None
    ) -> tuple[_Float, _Float]:
        """Return the Gauss–Newton step and the covariance, in natural units."""
        information, gradient, _, _ = linear.marginal(sizes, keep)
        precision, away = self.prior_of(theta, zone, sizes)
        covariance: _Float = np.asarray(np.linalg.inv(information + np.diag(precision)), np.float64)
        return covariance @ (gradient + precision * away), covariance

    def moved(self, theta: _Float, zone: _Float, step: _Float) -> tuple[_Float, _Float]:
        """Return the place a step leads to."""
        whole = np.zeros(len(theta))
        whole[self.columns] = self.scale * step[: len(self.free)]
        return self.model.moved(theta, whole), zone + _ZONE_UNIT_M * step[len(self.free) :] if self.zones else zone

    # sizes of errors

    def restricted(self, linear: Linear, theta: _Float, zone: _Float, sizes: Sizes) -> float:
        """Return −2 log of the restricted likelihood of some sizes, but for a constant."""
        information, gradient, quadratic, log_det = linear.marginal(sizes)
        precision, away = self.prior_of(theta, zone, sizes)
        matrix, pull = information + np.diag(precision), gradient + precision * away
        explained = pull @ np.linalg.solve(matrix, pull) - float(precision @ away**2)
        return float(quadratic - explained + log_det + np.linalg.slogdet(matrix)[1] - np.log(precision).sum())

    def sizes(self, linear: Linear, theta: _Float, zone: _Float, start: Sizes) -> Sizes:
        """Return the most likely sizes; one that gains too little likelihood is zero."""
        own = _EFFECTS if self.single else 2 * _EFFECTS

        def unpacked(log: _Float, active: _Bool) -> Sizes:
            values = np.where(active, np.exp(log[:own]), 0.0)
            block = np.zeros(_EFFECTS) if self.single else values[_EFFECTS:] * _SIZE_UNIT
            zone_m = float(np.exp(log[own])) * _ZONE_UNIT_M if self.zones else start.zone_m
            return Sizes(np.maximum(values[:_EFFECTS] * _SIZE_UNIT, self.least), block, zone_m)

        def fitted(log: _Float, active: _Bool) -> tuple[_Float, float]:
            index = np.flatnonzero(np.append(active, [True] * self.zones))

            def cost(part: _Float) -> float:
                whole = log.copy()
                whole[index] = part
                return self.restricted(linear, theta, zone, unpacked(whole, active))

            if not index.size:
                return log, cost(log[index])
            limits = [*[tuple(np.log(_SIZE_BOUNDS))] * own, tuple(np.log(_ZONE_BOUNDS))]
            found = optimize.minimize(
                cost, log[index], method="L-BFGS-B", bounds=[limits[i] for i in index],
                options={"eps": 1e-3, "maxiter": 10, "ftol": 1e-6},
            )  # fmt: skip
            whole = log.copy()
            whole[index] = found.x
            return whole, float(found.fun)

        log = np.zeros(own + int(self.zones))
        log[:_EFFECTS] = np.log(np.clip(start.frame / _SIZE_UNIT, 0.5, 20.0))
        if not self.single:
            log[_EFFECTS : 2 * _EFFECTS] = np.log(np.clip(start.block / _SIZE_UNIT, 0.5, 20.0))
        if self.zones:
            log[own] = math.log(np.clip(start.zone_m / _ZONE_UNIT_M, 0.1, 20.0))
        active = np.ones(own, bool)
        log, best = fitted(log, active)
        dropped = False
        while active.any():
            without = []
            for i in np.flatnonzero(active):
                fewer = active.copy()
                fewer[i] = False
                without.append((self.restricted(linear, theta, zone, unpacked(log, fewer)), i))
            cost, i = min(without)
            if cost - best >= _NEEDED:
                break
            active[i], best, dropped = False, cost, True
        if dropped:
            log, _ = fitted(log, active)
        return unpacked(log, active)

    def noise(
        self, residual: _Float, leverage: _Float, use: _Bool, old: tuple[float, float, float]
    ) -> tuple[float, float, float]:
        """Return the noise law of a direct sensor: squares of residuals regressed on 1, 1/I and 1/I².

        Gamma regression by iterated, non-negative least squares. The shot term enters only where it gains likelihood
        beside the ambient one, whose shape over a short span of ranges is nearly the same.
        """
        square = residual[use] ** 2 / np.maximum(1 - leverage[use], 0.1)
        over_i = self.evidence.seen.range_m[use] ** 2 / 0.8
        best = (math.inf, old)
        for terms in ((0,), (0, 2), (0, 1), (0, 1, 2)):
            design = np.stack([over_i**power for power in terms], axis=1)
            variance = np.full(len(square), square.mean())
            found = np.zeros(len(terms))
            for _ in range(8):
                found = optimize.nnls(design / variance[:, None], square / variance)[0]
                variance = np.maximum(design @ found, _LEAST_NOISE_M**2)
            cost = float((np.log(variance) + square / variance).sum()) + 6.63 * len(terms)  # 1 %: a term must show
            if cost < best[0]:
                parts = np.zeros(3)
                parts[list(terms)] = np.sqrt(found)
                best = (cost, (float(parts[0]), float(parts[1]), float(parts[2])))
        return best[1]

    def std_of(self, noise: tuple[float, float, float]) -> _Float:
        """Return the noise of each pixel by a noise law, (K, pixels)."""
        constant, shot, ambient = noise
        sensor = self.sensor.with_(range_std_m=constant, range_shot_std_m=shot, range_ambient_std_m=ambient)
        seen = self.evidence.seen
        law = direct_range_std(0.8 / np.maximum(seen.range_m, 1e-3) ** 2, sensor)
        return np.asarray(np.maximum(law, _LEAST_NOISE_M))

    # the whole

    def approach(self, theta: _Float) -> tuple[_Float, float]:
        """Run Gauss–Newton with a gate that narrows with the residuals; return the place and their spread."""
        sizes = Sizes(2 * _SIZE_UNIT, np.zeros(_EFFECTS), 2e-3)
        zone, spread, gate = self.sensor.zone_offsets.ravel(), math.nan, _FIRST_GATE_M
        for _ in range(_APPROACH):
            images = self.images(theta)
            residual = self.residual(images) - zone
            seen = self.candidates(images)
            near = seen & (np.abs(residual) < gate)
            if near.sum() < 3 * len(self.free):
                break
            spread = 1.4826 * float(np.median(np.abs(residual[near])))
            gate = max(min(gate, 4 * spread), 1e-3)
            use = seen & (np.abs(residual) < gate)
            linear = self.linear(self.slopes(theta), residual, use, np.full(use.shape, max(spread, 1e-3)))
            step, covariance = self.step(linear, theta, zone, sizes)
            theta, _ = self.moved(theta, zone, step)
            if (np.abs(step) < 0.1 * np.sqrt(np.diag(covariance)))[: len(self.free)].all() and gate > 3.9 * spread:
                break
        return theta, spread

    def misfit(self, theta: _Float) -> float:
        """Return the mean square of the residuals of all candidates, each at most 5 cm, m²."""
        images = self.images(theta)
        seen = self.candidates(images)
        if not seen.any():
            return math.inf
        residual = self.residual(images)[seen] - np.broadcast_to(self.sensor.zone_offsets.ravel(), seen.shape)[seen]
        return float((np.minimum(np.abs(residual), _FIRST_GATE_M / 5) ** 2).mean())

    def solve(self, theta: _Float) -> Recorded:
        """Find mounting, zone offsets, noise law and sizes of errors.

        Parameters
        ----------
        theta : (21,) float64
            A place from :meth:`approach`.
        """
        zone = self.sensor.zone_offsets.ravel()
        fits_noise = self.zones and self.sensor.kind == "direct"
        std = np.sqrt(1 / np.where(self.evidence.weight > 0, self.evidence.weight, 1.0))
        sizes = Sizes(2 * _SIZE_UNIT, np.zeros(_EFFECTS) if self.single else 2 * _SIZE_UNIT, 2e-3)
        noise = (self.sensor.range_std_m, self.sensor.range_shot_std_m, self.sensor.range_ambient_std_m)
        if fits_noise:
            images = self.images(theta)
            near = np.abs(self.residual(images)) < _FIRST_GATE_M
            spread = 1.4826 * float(np.median(np.abs(self.residual(images)[self.candidates(images) & near])))
            std = np.full(std.shape, max(min(spread, 0.02), _LEAST_NOISE_M))
        pose_error, linear, use = np.zeros((len(std), _EFFECTS)), None, None
        for round_ in range(_ROUNDS):
            slopes = self.slopes(theta)
            for _ in range(_STEPS):
                images = self.images(theta)
                residual = self.residual(images) - zone
                seen = self.candidates(images)
                use = self._gated(residual, seen, slopes[1], std, sizes, pose_error if round_ else None)
                linear = self.linear(slopes, residual, use, std)
                step, covariance = self.step(linear, theta, zone, sizes)
                pose_error = linear.pose_errors(sizes, step) * _SIZE_UNIT
                theta, zone = self.moved(theta, zone, step)
                p = len(self.free)
                if (np.abs(step[:p]) < _SETTLED * np.sqrt(np.diag(covariance))[:p]).all():
                    break
            images = self.images(theta)
            residual, seen = self.residual(images) - zone, self.candidates(images)
            use = self._gated(residual, seen, slopes[1], std, sizes, pose_error)
            linear = self.linear(slopes, residual, use, std)
            if fits_noise:
                noise = self.noise(*self._left(linear, slopes[1], residual, use, std, sizes), use, noise)
                std = self.std_of(noise)
                linear = self.linear(slopes, residual, use, std)
            sizes = self.sizes(linear, theta, zone, sizes)
        assert linear is not None
        assert use is not None
        step, covariance = self.step(linear, theta, zone, sizes)
        theta, zone = self.moved(theta, zone, step)
        pose_error = linear.pose_errors(sizes, step) * _SIZE_UNIT
        _, _, quadratic, _ = linear.marginal(sizes)
        p = len(self.free)
        own = covariance[:p, :p] * np.outer(self.scale, self.scale)
        zone_std = np.sqrt(np.diag(covariance)[p:]) * _ZONE_UNIT_M if self.zones else np.zeros(self.pixels)
        images, before = self.images(theta), self.images(self.assumed)
        found = Recorded(
            theta, own, zone, zone_std, noise, sizes, np.sqrt(sizes.frame**2 + sizes.block**2), use,
            self.candidates(images), self.residual(images) - zone,
            self.residual(before) - self.sensor.zone_offsets.ravel(), std, pose_error, quadratic, (math.nan, math.nan),
        )  # fmt: skip
        return replace(found, held_out_m=self.held_out(found, slopes))

    def _gated(
        self, residual: _Float, seen: _Bool, pose: _Float, std: _Float, sizes: Sizes, pose_error: _Float | None
    ) -> _Bool:
        """Return which candidates are within the gate: of all errors, and of the noise beside the pose's error."""
        spread = np.sqrt(std**2 + np.einsum("ksr,s->kr", pose**2, sizes.frame**2 + sizes.block**2))
        if pose_error is None:
            near = seen & (np.abs(residual) < _FIRST_GATE_M)
            spread = np.maximum(spread, 1.4826 * float(np.median(np.abs(residual[near]))))
            return np.asarray(seen & (np.abs(residual) < _GATE * spread))
        beside = residual - np.einsum("ks,ksr->kr", pose_error, pose)
        return np.asarray(seen & (np.abs(residual) < _GATE * spread) & (np.abs(beside) < _GATE * 1.25 * std))

    def _left(
        self, linear: Linear, pose: _Float, residual: _Float, use: _Bool, std: _Float, sizes: Sizes
    ) -> tuple[_Float, _Float]:
        """Return residuals beside the pose errors, and the share of their variance that fitting these took."""
        errors = linear.pose_errors(sizes, np.zeros(linear.jr.shape[1])) * _SIZE_UNIT
        left = residual - np.einsum("ks,ksr->kr", errors, pose)
        solved, _ = _shrunk(linear.ss, np.hypot(sizes.frame, sizes.block) / _SIZE_UNIT)
        s = np.where(use[:, None], pose, 0.0) * (_SIZE_UNIT[:, None] / std[:, None])
        leverage = np.einsum("ksr,kst,ktr->kr", s, solved, s)
        return left, np.minimum(leverage + linear.jr.shape[1] / max(int(use.sum()), 1), 0.9)

    def held_out(self, found: Recorded, slopes: tuple[_Float, _Float]) -> tuple[float, float]:
        """Return the r.m.s. residual of held-out blocks before and after, by the linearised problem."""
        before = found.before_m
        spread = np.sqrt(
            found.std_m**2 + np.einsum("ksr,s->kr", slopes[1] ** 2, found.sizes.frame**2 + found.sizes.block**2)
        )
        also = found.candidates & np.isfinite(before) & (np.abs(before) < _GATE * spread)
        judged = (found.use | also) & np.isfinite(before) & np.isfinite(found.residual_m)
        linear = self.linear(slopes, found.residual_m, found.use, found.std_m)
        fold = np.arange(len(self.start)) % FOLDS
        counts = np.diff(np.append(self.start, len(before)))
        after = np.full(before.shape, np.nan)
        for k in range(min(FOLDS, len(self.start))):
            step, _ = self.step(linear, found.theta, found.zone_m, found.sizes, fold != k)
            change = np.einsum("kpr,p->kr", slopes[0], self.scale * step[: len(self.free)])
            if self.zones:
                change = change + _ZONE_UNIT_M * step[len(self.free) :]
            frames = np.repeat(fold == k, counts)
            after[frames] = (found.residual_m - change)[frames]
        return _rms(before[judged]), _rms(after[judged])


def prior_std(name: str, assumed: _Float, scale: _Float) -> float:
    """Return the prior standard deviation of a parameter in its unit: radians, metres, seconds, pixels.

    Parameters
    ----------
    name : str
    assumed, scale : (21,) float64
        What is assumed, and natural units.
    """
    column = ALL_NAMES.index(name)
    if name in _OF_ITSELF:
        return PRIOR_STD[name] * float(assumed[column])
    return PRIOR_STD[name] * (float(scale[column]) if name in TERMS else 1.0)


def _rms(values: _Float) -> float:
    return math.sqrt(float((values**2).mean())) if values.size else math.nan
