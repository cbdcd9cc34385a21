"""Calibration from a recording with many poses: delay, offsets of zones, noise law and slow errors beside the mounting.

The ranges y of frame k are modelled as

    y = f(pose at stamp + delay, mounting + u_r) + zone offsets + S (e_k + e_b) + n

with what its recording has of its own u_r (:mod:`phasemark.matcher.calibration.recording_effects`), the slopes S of the
ranges by distance, δ, bearing, height and time (of poses that state a tilt by pitch and roll too), an error e_k of the
pose of each frame, an error e_b common to each block of time, and the noise n of pixels. Mounting, u_r and zone offsets
are found by Gauss–Newton under the covariance of the rest, with weak priors on the mounting. The sizes of e_k, e_b and
of the zone offsets are those of the greatest restricted likelihood (:mod:`phasemark.matcher.estimate.variances`); the
noise law is fitted to the squares of the residuals. So errors that vary slowly widen the covariance instead of being
divided by √N. Where results without one block of time each scatter more than that says, the covariance is widened by as
much.

Only pixels that the model says see nothing but the landmark have weight, and of these only those whose residual is
within a few standard deviations: a floor, a wall or an edge does not enter.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from phasemark import UsageError
from phasemark.matcher.calibration import notes as sentences
from phasemark.matcher.calibration.checks import check_enough, check_poses, check_ranges, check_view, returns_beside
from phasemark.matcher.calibration.mounting import ALL_NAMES, PARAMETERS, columns_of, prior_std
from phasemark.matcher.calibration.mounting_model import (
    EFFECTS,
    LEVEL_EFFECTS,
    CalibrationModel,
    Images,
    range_residual,
)
from phasemark.matcher.calibration.problem import MOST_FRAMES, Problem, Solution, in_image, rms
from phasemark.matcher.calibration.recording_effects import TURN, RecordingSizes, stated_apart
from phasemark.matcher.estimate.variances import RandomEffects
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.systematic import RECORDING_FIELDS
from phasemark.render.sensor.range_noise import direct_range_std
from phasemark.render.sensor.sensor_file import rounded

_Float = NDArray[np.float64]
_Bool = NDArray[np.bool_]
_Noise = tuple[float, float, float]
"""Constant, shot and ambient part of the noise law of a direct sensor, metres."""

_BLOCK_S, _BLOCKS, _SHORTEST_BLOCK_S = 2.0, 20, 0.5
"""Length of a block of time, seconds, the number of blocks that a short recording is cut into, and their length."""
_ZONE_UNIT_M = 1e-3
_UNIT = np.array([1e-3, math.radians(0.1), math.radians(0.1), 1e-3, 5e-3, math.radians(0.1), math.radians(0.1)])
"""Units of :data:`EFFECTS`: 1 mm, 0.1°, 0.1°, 1 mm, 5 ms of time, and 0.1° of pitch and roll."""
_SIZE_BOUNDS, _ZONE_BOUNDS = (0.02, 100.0), (0.02, 50.0)
"""Of the sizes of errors of poses and of zone offsets, in their units."""
_APPROACH, _FEWEST_ROUNDS, _MOST_ROUNDS, _STEPS = 8, 3, 8, 3
_FIRST_GATE_M = 0.25
_GATE = 4.0
"""Standard deviations beyond which a pixel has no weight."""
_SETTLED = 0.01
"""A step below this many standard deviations ends the iteration."""
_SAME = 0.1
"""A round that moves the mounting by less than this many standard deviations is the last."""
_LEAST_NOISE_M = 1e-4
FOLDS = 4
"""Parts into which blocks of time are dealt to be held out."""


def solve_recording(problem: Problem) -> Solution:
    """Find mounting, delay, zone offsets and noise from many poses, by time or one for each frame."""
    notes: list[str] = []
    if problem.moving:
        problem, notes = _by_time(problem)
    else:
        check_poses(problem)
    fit = RecordingFit(problem)
    for k, recorded in enumerate(fit.recorded, 1):
        if not problem.moving:
            check_view(recorded.model, recorded.evidence, problem.assumed)
        images = recorded.model.images(fit.assumed)
        where = recorded.candidates(images, edges=fit.edges)
        with _named(k, len(fit.recorded)):
            check_ranges(recorded.model, recorded.evidence, np.where(where, recorded.residual(images), np.nan))
    solution = fit.solve(fit.approach())
    if "delay" in fit.own:
        notes.append(
            "Each recording has its own delay, of its two clocks: the sensor file keeps"
            f" delay_s = {problem.assumed.delay_s:g}. Find that of a recording to be matched by a calibration of this"
            " sensor file with free=delay, and state it by pose_times_s(delay_s=…)."
        )
    std = np.sqrt(np.diag(solution.covariance))
    prior = fit.prior * fit.scale
    from_prior = 0.7  # standard deviation over that of the prior, from which the data are said not to tell a number
    untold = [name for name, of_prior in zip(problem.common, std > from_prior * prior, strict=True) if of_prior]
    return replace(solution, notes=(*notes, *sentences.untold_notes(untold), *solution.notes))


def _by_time(problem: Problem) -> tuple[Problem, list[str]]:
    """Return the problem with poses by time, and notes on what was left out, of several recordings by their number."""
    recordings = problem.recordings
    found = []
    for k, one in enumerate(recordings, 1):
        with _named(k, len(recordings)):
            found.append(one.by_time(MOST_FRAMES // len(recordings)))
    several = len(found) > 1
    notes = [f"Recording {k}: {note}" if several else note for k, (_, own) in enumerate(found, 1) for note in own]
    return replace(found[0][0], others=tuple(one for one, _ in found[1:])), notes


@contextmanager
def _named(k: int, recordings: int) -> Iterator[None]:
    """Name the recording of which the block refuses something, if there are several."""
    try:
        yield
    except UsageError as error:
        raise (UsageError(f"recording {k}: {error}") if recordings > 1 else error) from None


class Place(NamedTuple):
    """Mounting, zone offsets and what each recording has of its own, in a descent.

    Parameters
    ----------
    theta : (22,) float64
        Mounting.
    zone : (pixels,) float64
        Zone offsets, metres.
    own : (R, q) float64
        What each recording has of its own; metres, radians, seconds.
    """

    theta: _Float
    zone: _Float
    own: _Float


@dataclass(frozen=True, eq=False)
class Recorded:
    """Frames of one recording with their model."""

    model: CalibrationModel
    evidence: Evidence

    def residual(self, images: Images) -> _Float:
        """Return measured less modelled ranges without zone offsets, (K, pixels); NaN where there is none."""
        return np.where(self.evidence.weight > 0, range_residual(self.evidence, images), np.nan)

    def candidates(self, images: Images, *, edges: bool) -> _Bool:
        """Return which pixels returned and see the landmark, alone and a pixel from its edge unless edges count."""
        there = (images.phasor != 0) & (self.evidence.weight > 0)
        return np.asarray(there if edges else there & self.model.alone(images, from_edges=True))


@dataclass(frozen=True)
class Sizes:
    """Standard deviations of the random parts of the model.

    Parameters
    ----------
    frame, block : (s,) float64
        Of pose errors of frames and of blocks of time: distance, δ, bearing, height, time (jitter of the stamps), and
        of poses that state a tilt pitch and roll; in their units.
    recording : RecordingSizes
        Of what recordings have of their own.
    zone : float
        Of the zone offsets, in their unit.
    """

    frame: _Float
    block: _Float
    recording: RecordingSizes
    zone: float = 2.0

    @property
    def variance(self) -> _Float:
        """Of both pose errors together, (s,); squares of metres, radians, seconds."""
        return np.asarray((self.frame**2 + self.block**2) * _UNIT[: len(self.frame)] ** 2)


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
        self.problem, self.free, self.zones = problem, problem.common, problem.zones
        self.assumed, self.sensor = problem.assumed.vector, problem.sensor
        self.recorded = [
            Recorded(one.model(), Evidence.from_frames(one.frames, "ranges")) for one in problem.recordings
        ]
        self.seen_range_m = np.concatenate([one.evidence.seen.range_m for one in self.recorded])
        self.stated_weight = np.concatenate([one.evidence.weight for one in self.recorded])
        direct = self.sensor.kind == "direct"
        if edges is None:
            edges = problem.chip or all(
                one.model.has_background or not (direct or returns_beside(one.model, one.evidence))
                for one in self.recorded
            )
        self.edges, natural = edges, self.recorded[0].model.scale
        self.columns = columns_of(self.free)
        self.scale = natural[self.columns]
        self.prior = np.array([prior_std(name, self.assumed, natural) for name in self.free]) / self.scale
        self.stated_zones = self.sensor.zone_offsets.ravel()
        apart = stated_apart(self.sensor, problem.names)
        moving = problem.track is not None
        self.usual_own = RecordingSizes.of(problem.names, len(self.recorded), moving=moving, stated=apart)
        self.own = self.usual_own.names
        tilted = any(one.model.poses.are_tilted for one in self.recorded)
        self.effects = EFFECTS if tilted else LEVEL_EFFECTS
        self.unit, self.least = _UNIT[: len(self.effects)], np.zeros(len(self.effects))
        self.least_noise_m = max(_LEAST_NOISE_M, problem.frames.chip_error_m if problem.chip else 0.0)
        self._set_blocks()

    def _set_blocks(self) -> None:
        """Set to which recording each frame belongs, the first frame of each block of time, and what stamps leave."""
        blocks: list[NDArray[np.int64]] = []
        for one in self.problem.recordings:
            block, stamps = np.arange(len(one.frames)), one.frames.time_s
            if one.track is not None and stamps is not None:
                length = min(_BLOCK_S, max(float(stamps[-1] - stamps[0]) / _BLOCKS, _SHORTEST_BLOCK_S))
                block = np.floor((stamps - stamps[0]) / length).astype(np.int64)
                k = self.effects.index("time_s")  # stamps are so uncertain at least
                self.least[k] = max(self.least[k], one.track.jitter_s / _UNIT[k])
            blocks.append(block + (blocks[-1][-1] + 1 if blocks else 0))
        block = np.concatenate(blocks)
        self.recording = np.repeat(np.arange(len(blocks)), [len(one) for one in blocks])
        self.start = np.flatnonzero(np.diff(block, prepend=-1) != 0)
        self.single = len(self.start) == len(block)
        if len(self.start) == 1 and not self.single:
            raise UsageError(
                f"frames with a pose span less than {_SHORTEST_BLOCK_S:g} s: errors of the poses cannot be told from"
                " the camera's; record a few seconds"
            )

    @property
    def start_place(self) -> Place:
        """What is assumed."""
        return Place(self.assumed, self.stated_zones, np.zeros((len(self.recorded), len(self.own))))

    # the model

    def of_recording(self, place: Place, r: int) -> tuple[_Float, _Float | None]:
        """Return the mounting of a recording, and what is added to its poses."""
        own = dict(zip(self.own, place.own[r].tolist(), strict=True))
        turn = own.pop(TURN, 0.0)
        model = self.recorded[r].model
        theta = model.stepped(place.theta, columns_of(list(own)), np.array(list(own.values()))) if own else place.theta
        return theta, np.tile([0.0, -turn, -turn, 0.0], (len(model.poses), 1)) if turn else None

    def seen(self, place: Place) -> tuple[_Float, _Bool]:
        """Return the residuals at a place, (K, pixels), and which pixels may count."""
        residuals, candidates = [], []
        for r, one in enumerate(self.recorded):
            images = one.model.images(*self.of_recording(place, r))
            residuals.append(one.residual(images))
            candidates.append(one.candidates(images, edges=self.edges))
        return np.concatenate(residuals) - place.zone, np.concatenate(candidates)

    def slopes(self, place: Place, *, central: bool = True) -> tuple[_Float, _Float]:
        """Return slopes of the ranges by parameters, (K, P, pixels), and by pose errors, (K, s, pixels).

        The parameters are the free ones, in natural units, what each recording has of its own, and offsets of zones.
        """
        found = []
        names = tuple(dict.fromkeys((*self.free, *(name for name in self.own if name not in (TURN, "delay")))))
        for r, one in enumerate(self.recorded):
            theta, shift = self.of_recording(place, r)
            slope = one.model.slopes(theta, (*names, *self.effects), "ranges", shift=shift, central=central)
            found.append(self.sensor.metres_per_radian * slope.imag)
        by_mounting, by_pose = np.split(np.concatenate(found), [len(names)], axis=1)
        by_free = by_mounting[:, : len(self.free)]
        by_turn = -by_pose[:, EFFECTS.index("delta_rad")] - by_pose[:, EFFECTS.index("bearing_rad")]
        by_name = {TURN: by_turn, "delay": by_pose[:, EFFECTS.index("time_s")]}
        by_own = [by_name[name] if name in by_name else by_mounting[:, names.index(name)] for name in self.own]
        parts = [
            np.where((self.recording == r)[:, None], one, 0.0)[:, None]
            for r in range(len(self.recorded))
            for one in by_own
        ]
        if self.zones:  # slopes by the offset of a zone are 1 there and 0 elsewhere
            pixels = by_free.shape[2]
            parts.append(np.broadcast_to(_ZONE_UNIT_M * np.eye(pixels), (len(by_free), pixels, pixels)))
        return np.concatenate([by_free * self.scale[:, None], *parts], axis=1), by_pose

    def delay_s(self, place: Place) -> float:
        """Return the delay, of several recordings the mean."""
        own = float(place.own[:, self.own.index("delay")].mean()) if "delay" in self.own else 0.0
        return float(place.theta[ALL_NAMES.index("delay")]) + own

    # linear algebra

    def linear(self, slopes: tuple[_Float, _Float], residual: _Float, use: _Bool, std: _Float) -> RandomEffects:
        """Return Gram matrices of the parameters (in natural units) and the pose errors (in their units)."""
        j, s, r = (np.where(use[:, None], one / std[:, None], 0.0) for one in (*slopes, residual[:, None]))
        return RandomEffects.of_frames(j, s * self.unit[:, None], r[:, 0], self.start)

    def prior_of(self, place: Place, sizes: Sizes) -> tuple[_Float, _Float]:
        """Return the prior's precision and how far its mean is from a place, (P,) each, in natural units."""
        precision = [self.prior**-2.0, np.tile(sizes.recording.std**-2.0, len(self.recorded))]
        away = [(self.assumed - place.theta)[self.columns] / self.scale, -place.own.ravel()]
        if self.zones:
            precision.append(np.full(place.zone.shape, sizes.zone**-2.0))
            away.append((self.stated_zones - place.zone) / _ZONE_UNIT_M)
        return np.concatenate(precision), np.concatenate(away)

    def step(
        self, linear: RandomEffects, place: Place, sizes: Sizes, keep: _Bool | None = None
    ) -> tuple[_Float, _Float]:
        """Return the Gauss–Newton step and the covariance, in natural units."""
        information, gradient, _, _ = linear.marginal(sizes.frame, sizes.block, keep)
        precision, away = self.prior_of(place, sizes)
        covariance = np.asarray(np.linalg.inv(information + np.diag(precision)))
        return covariance @ (gradient + precision * away), covariance

    def moved(self, place: Place, step: _Float) -> Place:
        """Return the place a step leads to."""
        common, own, of_zones = np.split(step, np.cumsum([len(self.free), place.own.size]))
        theta = self.recorded[0].model.stepped(place.theta, self.columns, self.scale * common)
        zone = place.zone + _ZONE_UNIT_M * of_zones if self.zones else place.zone
        return Place(theta, zone, place.own + own.reshape(place.own.shape))

    def settled(self, step: _Float, covariance: _Float, share: float) -> bool:
        """Return True if the mounting moves by less than a share of its standard deviations."""
        p = len(self.free)
        return bool((np.abs(step[:p]) < share * np.sqrt(np.diag(covariance)[:p])).all())

    # sizes of errors

    def sizes(self, linear: RandomEffects, place: Place, start: Sizes) -> Sizes:
        """Return the most likely sizes; one that gains too little likelihood is zero."""
        effects = len(self.effects)
        own = effects if self.single else 2 * effects

        def unpacked(log: _Float, active: _Bool) -> Sizes:
            values = np.where(active, np.exp(log), 0.0)
            block = np.zeros(effects) if self.single else values[effects:own]
            zone = values[own] if self.zones else start.zone
            return Sizes(np.maximum(values[:effects], self.least), block, start.recording, zone)

        def cost(log: _Float, active: _Bool) -> float:
            sizes = unpacked(log, active)
            return linear.minus_two_log(sizes.frame, sizes.block, self.prior_of(place, sizes))

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
        each, active = np.arange(len(log)), np.ones(len(log), bool)
        log, best = fitted(log, active)
        dropped = False
        needed = 2.71  # −2 log likelihood that a size of errors must gain (5 %, one-sided), or it is taken to be zero
        while active[:own].any():
            lowest, i = min((cost(log, active & (each != i)), i) for i in np.flatnonzero(active[:own]))
            if lowest - best >= needed:
                break
            active[i], best, dropped = False, lowest, True
        if dropped:
            log, _ = fitted(log, active)
        found = unpacked(log, active)
        if len(self.recorded) == 1:
            return found
        information, gradient, _, _ = linear.marginal(found.frame, found.block)
        precision, away = self.prior_of(place, found)
        first = len(self.free)
        others = np.ones(len(precision), bool)
        others[first : first + place.own.size] = False
        gradient = gradient + np.where(others, precision * away, 0.0)
        likely = found.recording.most_likely(information, gradient, precision, place.own, first)
        return replace(found, recording=likely)

    def noise(self, residual: _Float, leverage: _Float, use: _Bool, old: _Noise) -> _Noise:
        """Return the noise law of a direct sensor: squares of residuals regressed on 1, 1/I and 1/I².

        Gamma regression by iterated, non-negative least squares. The shot term enters only where it gains likelihood
        beside the ambient one, whose shape over a short span of ranges is nearly the same.
        """
        square = residual[use] ** 2 / np.maximum(1 - leverage[use], 0.1)
        over_i = self.seen_range_m[use] ** 2 / 0.8
        best = (math.inf, old)
        term_shows = 6.63  # −2 log likelihood that a term of the noise law must gain (1 %)
        for terms in ((0,), (0, 2), (0, 1), (0, 1, 2)):
            design = np.stack([over_i**power for power in terms], axis=1)
            variance = np.full(len(square), square.mean())
            found = np.zeros(len(terms))
            for _ in range(8):
                found = optimize.nnls(design / variance[:, None], square / variance)[0]
                variance = np.maximum(design @ found, self.least_noise_m**2)
            cost = float((np.log(variance) + square / variance).sum()) + term_shows * len(terms)
            if cost < best[0]:
                parts = dict(zip(terms, np.sqrt(found).tolist(), strict=True))
                best = (cost, (parts[0], parts.get(1, 0.0), parts.get(2, 0.0)))
        return best[1]

    def std_of(self, noise: _Noise) -> _Float:
        """Return the noise of each pixel by a noise law, (K, pixels)."""
        constant, shot, ambient = noise
        sensor = self.sensor.with_(range_std_m=constant, range_shot_std_m=shot, range_ambient_std_m=ambient)
        law = direct_range_std(0.8 / np.maximum(self.seen_range_m, 1e-3) ** 2, sensor)
        return np.asarray(np.maximum(law, self.least_noise_m))

    # the whole

    def approach(self, *, central: bool = True) -> Place:
        """Run Gauss–Newton from what is assumed, with a gate that narrows with the residuals; return the place.

        Differences that are not `central` take half the time; zones that the landmark fills in part may mislead them.
        """
        place, sizes = self.start_place, self.usual_sizes(2.0, 0.0)
        gate = _FIRST_GATE_M
        for _ in range(_APPROACH):
            residual, seen = self.seen(place)
            near = seen & (np.abs(residual) < gate)
            if near.sum() < 3 * len(self.free):
                break
            spread = _spread(residual[near])
            gate = max(min(gate, 4 * spread), 1e-3)
            use = seen & (np.abs(residual) < gate)
            slopes = self.slopes(place, central=central)
            linear = self.linear(slopes, residual, use, np.full(use.shape, max(spread, 1e-3)))
            step, covariance = self.step(linear, place, sizes)
            place = self.moved(place, step)._replace(zone=self.stated_zones)
            if self.settled(step, covariance, 0.1) and gate > 3.9 * spread:
                break
        return place

    def usual_sizes(self, frame: float, block: float) -> Sizes:
        """Return sizes of errors before a frame is seen; of poses some of their units."""
        count = len(self.effects)
        return Sizes(np.full(count, frame), np.full(count, block), self.usual_own)

    def misfit(self, place: Place) -> tuple[float, int]:
        """Return the mean square of the residuals of all candidates, each at most 5 cm, m², and their number."""
        residual, seen = self.seen(place._replace(zone=self.stated_zones))
        if not seen.any():
            return math.inf, 0
        return float((np.minimum(np.abs(residual[seen]), _FIRST_GATE_M / 5) ** 2).mean()), int(seen.sum())

    def solve(self, place: Place) -> Solution:
        """Find mounting, zone offsets, noise law and sizes of errors.

        Parameters
        ----------
        place : Place
            From :meth:`approach`.
        """
        sensor = self.sensor
        fits_noise = self.zones and sensor.kind == "direct"
        std = np.sqrt(1 / np.where(self.stated_weight > 0, self.stated_weight, 1.0))
        sizes = self.usual_sizes(2.0, 0.0 if self.single else 2.0)
        noise = (sensor.range_std_m, sensor.range_shot_std_m, sensor.range_ambient_std_m)
        if fits_noise:
            residual, seen = self.seen(place._replace(zone=np.zeros_like(place.zone)))
            spread = _spread(residual[seen & (np.abs(residual) < _FIRST_GATE_M)])
            std = np.full(std.shape, max(min(spread, 0.02), self.least_noise_m))
        pose_error = None
        for count in range(1, _MOST_ROUNDS + 1):
            slopes, first, before = self.slopes(place), pose_error is None, place.theta
            for _ in range(_STEPS):
                residual, seen = self.seen(place)
                use = self._gated(residual, seen, slopes[1], std, sizes, None if first else pose_error)
                linear = self.linear(slopes, residual, use, std)
                step, covariance = self.step(linear, place, sizes)
                pose_error = linear.errors(step, sizes.frame, sizes.block) * self.unit
                place = self.moved(place, step)
                if self.settled(step, covariance, _SETTLED):
                    break
            residual, seen = self.seen(place)
            use = self._gated(residual, seen, slopes[1], std, sizes, pose_error)
            check_enough(int(use.sum()), len(self.free))
            linear = self.linear(slopes, residual, use, std)
            if fits_noise:
                noise = self.noise(*self._left(linear, slopes[1], residual, use, std, sizes), use, noise)
                std = self.std_of(noise)
                linear = self.linear(slopes, residual, use, std)
            sizes = self.sizes(linear, place, sizes)
            moved = (place.theta - before)[self.columns] / self.scale
            if count >= _FEWEST_ROUNDS and self.settled(moved, covariance, _SAME):
                break
        step, covariance = self.step(linear, place, sizes)
        place = self.moved(place, step)
        pose_error = linear.errors(step, sizes.frame, sizes.block) * self.unit
        chi2 = linear.marginal(sizes.frame, sizes.block).quadratic
        after, seen = self.seen(place)
        before = self.seen(self.start_place)[0]
        judged = use | (seen & (np.abs(before) < _GATE * _total(std, slopes[1], sizes)))
        judged &= np.isfinite(before) & np.isfinite(after)
        at_end = self.linear(slopes, after, use, std)
        held_out = self._held_out(at_end, slopes[0], after, place, sizes)
        wider = 1.0 if self.single else self._scatter_of_blocks(at_end, place, sizes, covariance)
        beside = after - np.einsum("ks,ksr->kr", pose_error, self.slopes(place)[1])
        pose_chi2 = np.where(use, (beside / std) ** 2, 0.0).sum(axis=1)
        left_out = 1 - float((use & seen).sum()) / max(int(seen.sum()), 1)
        few = 3  # pixels of a frame that tell nothing of it
        shown = seen.sum(axis=1)
        frames_out = (use & seen).sum(axis=1) < shown / 2
        out_of = [frames_out[(self.recording == r) & (shown > few)] for r in range(len(self.recorded))]
        dof, systematic, p = int(use.sum()) - len(self.free), np.sqrt(sizes.variance), len(self.free)
        std_own = np.sqrt(wider * np.diag(covariance))[p:][: place.own.size].reshape(place.own.shape)
        own = np.stack([place.own, std_own], axis=-1)
        return Solution(
            problem=self.problem,
            theta=place.theta,
            covariance=wider * covariance[:p, :p] * np.outer(self.scale, self.scale),
            covariance_from="noise, slow errors and weak priors (restricted maximum likelihood)"
            + (f", {math.sqrt(wider):.2g} times as wide by the scatter of blocks of time" if wider > 1.0 else ""),
            chi2=chi2,
            dof=dof,
            p_value=float(special.chdtrc(max(dof, 1), chi2)),
            use=use,
            residual_m=in_image(after, use, sensor),
            residual_before_m=in_image(before, use, sensor),
            range_std_m=in_image(std, use, sensor),
            pose_shift=pose_error[:, :3],
            pose_chi2=pose_chi2,
            held_out_m=(rms(before[judged]), rms(held_out[judged])),
            edges=self.edges,
            notes=tuple(sentences.recording_notes(use, left_out, systematic, in_file=self.zones)),
            left_out=left_out,
            frames_left_out=tuple(float(one.mean()) if one.size else 0.0 for one in out_of),
            own=tuple(dict(zip(self.own, map(tuple, one), strict=True)) for one in own.tolist()),
            tilt_std_rad=np.append(systematic, [0.0, 0.0])[len(LEVEL_EFFECTS) :][:2],
            sensor_fields=self._sensor_fields(
                place.zone, noise, systematic, sizes.recording, overdispersion_of(pose_chi2, use.sum(axis=1))
            ),
        )

    def _scatter_of_blocks(self, linear: RandomEffects, place: Place, sizes: Sizes, covariance: _Float) -> float:
        """Return by what factor results without one block of time each scatter beyond a covariance (jackknife)."""
        count, p = len(self.start), len(self.free)
        without = np.array([self.step(linear, place, sizes, np.arange(count) != k)[0][:p] for k in range(count)])
        away = without - without.mean(axis=0)
        scatter = (count - 1) / count * away.T @ away
        return max(1.0, float(np.trace(np.linalg.solve(covariance[:p, :p], scatter))) / p)

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
        errors = linear.errors(np.zeros(count), sizes.frame, sizes.block) * self.unit
        s = np.where(use[:, None], pose, 0.0) * (self.unit[:, None] / std[:, None])
        leverage = np.einsum("ksr,kst,ktr->kr", s, linear.error_covariance(np.hypot(sizes.frame, sizes.block)), s)
        left = residual - np.einsum("ks,ksr->kr", errors, pose)
        return left, np.minimum(leverage + count / max(int(use.sum()), 1), 0.9)

    def _held_out(self, linear: RandomEffects, slope: _Float, residual: _Float, place: Place, sizes: Sizes) -> _Float:
        """Return the residuals of each part of the blocks under what the others tell, by the linearised problem."""
        fold = np.arange(len(self.start)) % FOLDS
        of_frame = np.repeat(fold, np.diff(np.append(self.start, len(residual))))
        after = np.full(residual.shape, np.nan)
        for k in range(min(FOLDS, len(self.start))):
            step, _ = self.step(linear, place, sizes, fold != k)
            after[of_frame == k] = (residual - np.einsum("kpr,p->kr", slope, step))[of_frame == k]
        return after

    def _sensor_fields(
        self, zone: _Float, noise: _Noise, systematic: _Float, recording: RecordingSizes, overdispersion: float
    ) -> dict[str, object]:
        """Return zone offsets, noise law, systematic errors and what recordings differ by as fields of the sensor."""
        fields: dict[str, object] = {}
        if self.problem.track is not None:
            for name, own in RECORDING_FIELDS.items():
                parameter = next(one for one in PARAMETERS.values() if one.field == name)
                if parameter.name in self.free:
                    fields[own] = parameter.in_file * recording.of_another(parameter.name)
        if self.zones:
            distance, delta, bearing, height, time = systematic.tolist()[: len(LEVEL_EFFECTS)]
            table = zone.reshape(self.sensor.rows, self.sensor.cols).tolist()
            fields |= {
                "zone_offset_m": tuple(map(tuple, table)),
                **dict(zip(("range_std_m", "range_shot_std_m", "range_ambient_std_m"), noise, strict=True)),
                "systematic_distance_m": distance,
                "systematic_delta_deg": math.degrees(delta),
                "systematic_bearing_deg": math.degrees(bearing),
                "systematic_height_m": height,
                "systematic_time_s": time,
                "overdispersion": overdispersion,
            }
        return {name: rounded(value) for name, value in fields.items()}


def overdispersion_of(chi2: _Float, pixels: NDArray[np.int64]) -> float:
    """Return by what share χ² of frames, (K,), scatters more about its mean than that of normal residuals.

    0 where that may be chance: of K frames the variance of χ² is known to a share of √(2 / K).
    """
    fewest = 8  # pixels of a frame whose χ² tells anything
    told = pixels >= fewest
    if not told.any():
        return 0.0
    n = pixels[told]
    share = chi2[told].sum() / n.sum()
    excess = float((n * (chi2[told] / n / share - 1) ** 2).mean()) / 2 - 1
    return excess if excess > 2 * math.sqrt(2 / len(n)) else 0.0


def _spread(residual: _Float) -> float:
    """Return the standard deviation that the median of absolute residuals means."""
    median_std = 1.4826  # standard deviation over median absolute deviation of normal errors
    return median_std * float(np.median(np.abs(residual)))


def _total(std: _Float, pose: _Float, sizes: Sizes) -> _Float:
    """Return the standard deviation of ranges by noise and pose errors together, (K, pixels)."""
    return np.asarray(np.sqrt(std**2 + np.einsum("ksr,s->kr", pose**2, sizes.variance)))
