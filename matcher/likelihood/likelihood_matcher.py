"""Maximum-likelihood pose and class: seed from the bank, refine, rank, report covariance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark.data.shards.build import processors
from phasemark.matcher.chi_squared import largest_costs
from phasemark.matcher.estimate.acceptance import rank, with_parts
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import background_of
from phasemark.matcher.likelihood.auto_background import AutoBackground
from phasemark.matcher.likelihood.background_estimate import (
    NEAREST_WALL_M,
    estimate_surroundings,
    part_of_background,
)
from phasemark.matcher.likelihood.floor_albedo import estimate_floors, fit_before_floors
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.interpolation import misled_frames
from phasemark.matcher.likelihood.profiles import with_profiles
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scenes
from phasemark.matcher.likelihood.search import near_settings, search_views
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.likelihood.shared_errors import with_motion, with_shared_errors
from phasemark.matcher.likelihood.systematic import Systematic
from phasemark.matcher.likelihood.unknown_things import fit_without_borders
from phasemark.matcher.likelihood.valleys import with_valleys
from phasemark.matcher.match import Match
from phasemark.matcher.nearest.bank_minima import Search, Starts
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS, SURELY, counts
from phasemark.render import Background, PhasorImages
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.threads import mapped

__all__ = ["LikelihoodMatcher", "usual_workers"]

_WALL_MOVES_M = 0.1
"""By how much a wall may be elsewhere than is expected of a frame that is tracked."""
_PIXELS_AT_ONCE = 1 << 22
"""Of all frames that are matched together, times the square of the number of free parameters: every candidate has an
image of each pixel with its slopes, and there are more candidates the more parameters are free. A pixel takes up to a
kilobyte with two free parameters, and some fifteen with six."""


class LikelihoodMatcher:
    """Estimates class and continuous view of a landmark.

    Parameters
    ----------
    setup : Setup
    systematic : sequence of str
        Errors that all frames of a camera share, which covariances hold.
    workers : int, optional
    like : Scenes, optional
        Scenes of the same bank with another prior, to be used again.
    """

    def __init__(
        self,
        setup: Setup,
        systematic: Sequence[Systematic] = (),
        workers: int | None = None,
        like: Scenes | None = None,
    ) -> None:
        self.setup, self._systematic, self._workers = setup, systematic, workers or usual_workers()
        self.scenes = Scenes(setup, self._workers, like)

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames, in threads of their own parts of them; the answers do not depend on their number.

        A frame whose best view lies beyond the bearings that its prior has searched is matched again without one: there
        may be rivals farther out.
        """
        answers = self._matched(frames)
        if self.setup.bearing_is_free:
            likely = [answer.accepted or answer.reason == "undetermined" for answer in answers]
            bearing_rad = np.array([answer.bearing_rad for answer in answers], np.float64)
            beyond = np.flatnonzero(np.array(likely) & (np.abs(bearing_rad) > self.setup.widest_rad))
            if beyond.size:
                for k, answer in zip(beyond, self._without_prior._matched(frames[beyond]), strict=True):
                    answers[k] = answer
        if "motion" not in self._systematic:
            return answers
        return with_motion(self.setup.free, frames.sensor.systematic_time_s, frames.time_s, answers)

    @cached_property
    def _without_prior(self) -> LikelihoodMatcher:
        """The same matcher with nothing known of the bearing, made when it is first needed."""
        return LikelihoodMatcher(self.setup.without_prior(), self._systematic, self._workers, self.scenes)

    def _matched(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames, each alone."""
        match = self._match_auto if self.setup.auto else self._match_stated
        tilted = frames.tilts_rad.any(axis=1)
        if tilted.any():
            self.scenes.check_tilted()
        parts = [part for own in (~tilted, tilted) for part in self._parts(np.flatnonzero(own))]
        found = mapped(match, [frames[part] for part in parts], self._workers)
        by_frame = {
            k: answer for part, some in zip(parts, found, strict=True) for k, answer in zip(part, some, strict=True)
        }
        return [by_frame[k] for k in range(len(frames))]

    @property
    def is_quick(self) -> bool:
        """Whether a search renders next to nothing, for the images of the bank are fine enough."""
        return self.scenes.interpolates

    def track(self, frames: FilteredFrames, near: Sequence[Match]) -> Match:
        """Match one filtered frame from expected views alone, before an expected background.

        Of an automatic background the frame tells how far the wall is, where that is near where it is expected.
        """
        evidence, setup = Evidence.from_frames(frames, self.setup.on), self.setup
        names = list(setup.rules.names)
        classes = np.array([names.index(one.class_name) for one in near if one.class_name is not None], np.int64)
        views = np.array([[getattr(one, name) for name in VIEW] for one in near])
        scene, behind = self.scenes.on_rendered(), setup.stated
        if setup.auto:
            behind = near[0].background
            if behind is not None and behind.wall_m is not None:
                seen = estimate_surroundings(frames, 0, bearing_known=True, tilt_known=True).background
                if seen is not None and seen.wall_m is not None and abs(seen.wall_m - behind.wall_m) < _WALL_MOVES_M:
                    behind = replace(behind, wall_m=seen.wall_m, wall_albedo=seen.wall_albedo)
            scene = self.scenes.before([] if behind is None else [behind])
        if evidence.tilt_rad.any():
            self.scenes.check_tilted()
            scene = self.scenes.tilted()
        starts = Starts(np.zeros(len(views), np.int64), classes, views)
        fits = refine(scene.final, evidence, starts, near_settings(scene, evidence))
        fits = with_valleys(scene, evidence, fit_without_borders(scene, evidence, fits))
        bare = bare_cost(evidence.seen, scene.behind)
        (answer,) = rank(setup.rules, fits, self._doubt(fits), bare, [behind])
        return answer

    def _parts(self, which: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return frames in parts that are matched at once."""
        share = max(math.ceil(len(which) / self._workers), 1)
        most = _PIXELS_AT_ONCE // (self.setup.used.size * len(self.setup.free) ** 2)
        share = min(share, self.setup.policy.frames_at_once, max(most, 1))
        return [which[start : start + share] for start in range(0, len(which), share)]

    def _match_stated(self, frames: FilteredFrames, *, on_rendered: bool = False) -> list[Match]:
        """Match frames, all of them tilted or none, before the background that was stated, or none.

        Those that interpolated images mislead are matched again `on_rendered` ones.
        """
        setup, stated = self.setup, self.setup.stated
        evidence = Evidence.from_frames(frames, setup.on)
        interpolates = self.scenes.interpolates and not (on_rendered or evidence.tilt_rad.any())
        scene = self.scenes.on_rendered() if on_rendered else self.scenes.stated
        if evidence.tilt_rad.any():
            scene = self.scenes.tilted(evidence.tilt_rad)
        bare = bare_cost(evidence.seen, scene.behind)
        fits = search_views(scene, evidence, evidence.seen, bare)
        fits = fit_without_borders(scene, evidence, fits)
        floors = None
        if stated is not None and stated.estimates_floor_albedo:
            rendered = self.scenes.rendered
            floors = estimate_floors(setup, rendered, evidence, fits, stated)
            scene = replace(scene, final=rendered.with_background(*floors.backgrounds))
            fits = fit_before_floors(scene, evidence, fits)
        fits = with_profiles(scene, evidence, with_valleys(scene, evidence, fits))
        backgrounds = [stated] * len(frames) if floors is None else floors.backgrounds
        answers = rank(setup.rules, fits, self._doubt(fits), bare, backgrounds)
        if floors is not None:
            parts = zip(answers, floors.part, strict=True)
            answers = [with_parts(setup.rules, answer, {"floor_albedo": part}) for answer, part in parts]
        answers = self._with_mirror(evidence, answers, scene.search)
        answers = with_shared_errors(setup, self.scenes, self._systematic, evidence, answers)
        misled = misled_frames(scene, self.scenes.rendered, evidence, fits) if interpolates else np.empty(0, np.int64)
        if misled.size:
            for k, answer in zip(misled, self._match_stated(frames[misled], on_rendered=True), strict=True):
                answers[k] = answer
        return answers

    def _match_auto(self, frames: FilteredFrames) -> list[Match]:
        """Match frames, each before what stands behind it."""
        setup, scenes = self.setup, self.scenes
        evidence = Evidence.from_frames(frames, setup.on)
        bare = np.minimum(bare_cost(evidence.seen, None), self._bare_wall_cost(evidence))
        backgrounds, fits = AutoBackground(frames, evidence, bare, setup, scenes).search()
        answers: list[Match] = []
        for k, found in enumerate(rank(setup.rules, fits, self._doubt(fits), bare, backgrounds)):
            one, search = slice(k, k + 1), scenes.search if backgrounds[k] is None else scenes.open_search
            found = self._before_uncertain(backgrounds[k], evidence[one], found)
            mirrored = self._with_mirror(evidence[one], [found], search)
            answers += with_shared_errors(setup, scenes, self._systematic, evidence[one], mirrored)
        return answers

    def _before_uncertain(self, background: Background | None, evidence: Evidence, answer: Match) -> Match:
        """Return an accepted answer whose covariance holds the uncertainty of the background that was estimated."""
        if background is None or not answer.accepted or answer.covariance is None:
            return answer
        rules = self.setup.rules
        view = np.array([getattr(answer, name) for name in VIEW])
        class_index = list(rules.names).index(str(answer.class_name))
        further = part_of_background(
            self.scenes.rendered, evidence, class_index, view, self.setup.free, background, self.setup.prior_std
        )
        return with_parts(rules, replace(answer, covariance=answer.covariance + further), {})

    def _doubt(self, fits: Fits) -> NDArray[np.float64]:
        """Return the costs of fits that just fail a χ² test with the noise as stated, (m,)."""
        edge = special.chdtri(np.maximum(fits.dof, 1), self.setup.rules.false_alarm)
        return np.asarray(edge + DISAGREEMENT * fits.unexplained)

    def _with_mirror(self, evidence: Evidence, answers: list[Match], search: Search) -> list[Match]:
        """Say of accepted answers whether their frames may be mirrored left to right, by the bounds of the cells."""
        accepted = np.array([k for k, answer in enumerate(answers) if answer.accepted], np.int64)
        if not accepted.size:
            return answers
        some, seen = [answers[k] for k in accepted], evidence.seen[accepted]
        dof = np.array([answer.dof for answer in some])
        # what an answer leaves to unknown things costs the other view, too
        left = np.maximum(seen.returned.sum(axis=1) - dof - len(self.setup.free), 0)
        false_alarm = self.setup.rules.false_alarm
        limit = largest_costs(false_alarm, dof, evidence.noise_tails[accepted]) + DISAGREEMENT * left
        found = search.of_frames(accepted).may_explain(seen.mirrored(self.setup.bank.sensor.cols), limit)
        for k, answer, mirrored in zip(accepted, some, found, strict=True):
            answers[k] = replace(answer, may_be_mirrored=bool(mirrored))
        return answers

    def _bare_wall_cost(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return how badly a wall at its best distance explains all of each frame, (n,)."""
        seen, cost = evidence.seen, np.full(len(evidence.weight), np.inf)
        weight = np.where(seen.returned, seen.weight, 0.0)
        enough = (seen.returned.sum(axis=1) >= MIN_RETURNS) & (weight.sum(axis=1) > 0)
        which = np.flatnonzero(enough)
        forward = self.setup.bank.sensor.axis_cosine().ravel() * seen.range_m[which]
        wall_m = np.average(np.where(seen.returned[which], forward, 0.0), axis=1, weights=weight[which])
        which, wall_m = which[wall_m >= NEAREST_WALL_M], wall_m[wall_m >= NEAREST_WALL_M]
        if which.size:
            walls = [Background(wall_m=float(own)) for own in wall_m]
            cost[which] = bare_cost(evidence[which].seen, background_of(self.setup.bank, *walls))
        return cost


def bare_cost(seen: Observation, behind: PhasorImages | None) -> NDArray[np.float64]:
    """Return the whitened squared distance of frames from a scene without a landmark, (n,).

    `behind` has one image for all frames, or one for each.
    """
    if behind is None:
        return np.asarray(DISAGREEMENT * seen.returned.sum(axis=1), np.float64)
    sensor, shape = behind.sensor, (len(behind.phasor), -1)
    model = behind.range_m.reshape(shape)
    lit = np.isfinite(model)
    sure = counts(behind.phasor, behind.intensity, sensor, SURELY).reshape(shape)
    residual = wrap_difference_m(np.where(lit & seen.returned, seen.range_m - np.where(lit, model, 0.0), 0.0), sensor)
    wrong = (seen.returned & ~lit) | (seen.not_returned & sure)
    squared = np.minimum(seen.weight * residual**2, DISAGREEMENT)
    return np.asarray(squared.sum(axis=1) + DISAGREEMENT * wrong.sum(axis=1))


def usual_workers() -> int:
    """Return how many threads match where nobody says: one for each processor, at most eight."""
    return min(processors(), 8)
