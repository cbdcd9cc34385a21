"""Maximum-likelihood pose and class: seed from the bank, refine, rank, report covariance."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.data.shards.executor import processors
from phasemark.matcher.chi_squared import largest_costs
from phasemark.matcher.estimate.acceptance import Rules, rank, with_parts
from phasemark.matcher.estimate.fits import Fits
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.frequencies import background_of, layers_of, pixels_of
from phasemark.matcher.likelihood.auto_background import AutoBackground
from phasemark.matcher.likelihood.background_estimate import (
    NEAREST_WALL_M,
    estimate_surroundings,
    part_of_background,
)
from phasemark.matcher.likelihood.bank_images import BankModel
from phasemark.matcher.likelihood.floor_albedo import estimate_floors, fit_before_floors
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.profiles import with_profiles
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence, ResidualKind
from phasemark.matcher.likelihood.search import near_settings, search_views
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY, SearchPolicy
from phasemark.matcher.likelihood.setup import Scene, Setup, check_free
from phasemark.matcher.likelihood.shared_errors import with_motion, with_shared_errors
from phasemark.matcher.likelihood.strip_images import StripModel
from phasemark.matcher.likelihood.systematic import Systematic
from phasemark.matcher.likelihood.unknown_things import fit_without_borders
from phasemark.matcher.likelihood.valleys import with_valleys
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD, Match
from phasemark.matcher.nearest.bank_minima import Search, Starts, Upward
from phasemark.matcher.nearest.cells import WIDE_PIXEL_RAD, CellBounds, Turned
from phasemark.matcher.nearest.grid import CELL_M, CELL_RAD, first_step
from phasemark.matcher.nearest.templates import Observation
from phasemark.matcher.pixel_agreement import DISAGREEMENT, MIN_RETURNS, counts
from phasemark.render import Background, PhasorImages, Renderer, Views
from phasemark.render.background import UNSTATED_ALBEDO_STD
from phasemark.render.phasor_images import wrap_difference_m
from phasemark.render.threads import mapped

__all__ = ["BEARING_STD_RAD", "ROBUST_FROM", "TILT_STD_RAD", "LikelihoodMatcher", "Pixels", "usual_workers"]

Pixels = Literal["all", "lower"]
ROBUST_FROM = 3.0
"""Residual, in σ, from which Huber's loss is linear: far enough out to cost an honest frame nothing."""
BEARING_STD_RAD, ZONE_BEARING_STD_RAD, TILT_STD_RAD = math.radians(1.5), math.radians(3.0), math.radians(3.0)
"""Standard deviations of the bearing, and of pitch and roll, before a frame is seen, unless the matcher is told."""


_FINE_GRID, _COARSE_GRID = (0.011, math.radians(1.1)), (0.022, math.radians(2.2))
"""Widest steps of a bank, metres and radians, on which interpolated images are at the bound, and on which they lead to
the solution."""
_FEWEST_PER_PARAMETER, _FURTHER_ZONES = 6, 3
"""Returns that each free parameter takes among unknown things or outliers; zones of a chip, which are few but show one
surface each, that an answer explains beyond its number of free parameters."""
_WALL_MOVES_M = 0.1
"""By how much a wall may be elsewhere than is expected of a frame that is tracked."""
_ALBEDO_RATIOS = 1 / 8, 8.0
"""Factors on a landmark's brightness beside the background's between which it is looked for where it is free."""
_SHARES_OF_COLUMN = -0.5, -0.25, 0.25, 0.5
_PIXELS_AT_ONCE = 1 << 22
"""Of all frames that are matched together, times the square of the number of free parameters: every candidate has an
image of each pixel with its slopes, and there are more candidates the more parameters are free. A pixel takes up to a
kilobyte with two free parameters, and some fifteen with six."""


class LikelihoodMatcher:
    """Estimates class and continuous view of a landmark; see :class:`~phasemark.matcher.Matcher` for the parameters."""

    def __init__(
        self,
        bank: Bank,
        *,
        free: Sequence[str] | None = None,
        background: Background | Literal["auto", "unknown"] | None = None,
        false_alarm: float = 0.01,
        on: ResidualKind = "ranges",
        pixels: Pixels = "all",
        robust: bool = False,
        bearing_std_rad: float | None = None,
        height_std_m: float = math.inf,
        pitch_std_rad: float = TILT_STD_RAD,
        roll_std_rad: float = TILT_STD_RAD,
        systematic: Sequence[Systematic] = (),
        tolerance_m: float = TOLERANCE_M,
        tolerance_rad: float = TOLERANCE_RAD,
        workers: int | None = None,
        policy: SearchPolicy = DEFAULT_POLICY,
        reported: bool = False,
    ) -> None:
        has_prior = free is None  # the default frees the bearing, with a prior
        usual = (*VIEW[:3], "pitch_rad", "roll_rad") if reported else VIEW[:3]
        names = check_free(usual if free is None else free)
        if bearing_std_rad is None:
            bearing_std_rad = ZONE_BEARING_STD_RAD if reported else BEARING_STD_RAD
        if reported:
            background = "unknown"  # what stands behind the landmark changes no zone that reports the landmark
        _check_choices(bank, background, on)
        known = {"height_m": height_std_m, "pitch_rad": pitch_std_rad, "roll_rad": roll_std_rad}
        if has_prior:
            known["bearing_rad"] = bearing_std_rad
        prior = tuple(known.get(name, math.inf) for name in names)
        unknown = background == "unknown"
        self._bank = bank
        self._systematic = systematic
        self._workers = workers or usual_workers()
        self.free = names
        self._stated = background if isinstance(background, Background) else None
        self._auto = background == "auto"
        huber = ROBUST_FROM if robust or unknown else None
        fewest = _FEWEST_PER_PARAMETER * len(names)
        if reported:
            fewest = len(names) + _FURTHER_ZONES
        rules = Rules.of_bank(bank, names, false_alarm, tolerance_m, tolerance_rad)
        if reported and has_prior:  # pitch and roll are free because no mounting is level, and not to be found
            rules = replace(rules, tolerance={**rules.tolerance, **dict.fromkeys(VIEW[4:], math.inf)})
        # unexplained pixels that must stand against a far view of the same landmark among unknown things; of zones, one
        against_far_view = 4
        rules = replace(
            rules,
            among_unknown=unknown,
            rival_cost=DISAGREEMENT * (against_far_view if unknown and not reported else 1),
            fewest_explained=0 if huber is None else fewest,
        )
        self._setup = Setup(
            bank=bank,
            rules=rules,
            prior_std=prior if has_prior or min(prior) < math.inf else (),
            bearing_has_prior=has_prior,
            on=on,
            albedo_std=self._albedo_std() if on == "ranges" and not reported else 0.0,
            unknown=unknown,
            reports_one_surface=reported,
            used=pixels_of(bank, pixels).ravel(),
            huber=huber,
            widest_rad=policy.prior_sigma * bearing_std_rad if has_prior else math.inf,
            policy=policy,
        )
        behind = background_of(bank, self._stated) if self._stated is not None else None
        self._search = self._search_in(self._cells(behind, workers=self._workers))
        self._open_search = self._search.before(self._cells(None, open_edges=True)) if self._auto else self._search
        self._set_scene(behind)
        if self._auto or self._exact is None:
            self._check_distances()
        if self._stated is not None and self._stated.floor_m is not None and "height_m" not in self._setup.free:
            self._check_floor(self._stated.floor_m)

    def _set_scene(self, behind: PhasorImages | None) -> None:
        """Set what is searched and compared where all frames have the same background."""
        self._exact, self._scout = self._bank_models(behind)
        final = self._exact or self._rendered
        self._scene = Scene(self._setup, behind, final, None if self._exact else self._scout, self._search)

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames, in threads of their own parts of them; the answers do not depend on their number.

        A frame whose best view lies beyond the bearings that its prior has searched is matched again without one: there
        may be rivals farther out.
        """
        answers = self._matched(frames)
        if self._setup.bearing_is_free:
            likely = [answer.accepted or answer.reason == "undetermined" for answer in answers]
            bearing_rad = np.array([answer.bearing_rad for answer in answers], np.float64)
            beyond = np.flatnonzero(np.array(likely) & (np.abs(bearing_rad) > self._setup.widest_rad))
            if beyond.size:
                for k, answer in zip(beyond, self._without_prior._matched(frames[beyond]), strict=True):
                    answers[k] = answer
        if "motion" not in self._systematic:
            return answers
        return with_motion(self.free, frames.sensor.systematic_time_s, frames.time_s, answers)

    @cached_property
    def _without_prior(self) -> LikelihoodMatcher:
        """The same matcher with nothing known of the bearing, made when it is first needed."""
        other, setup = copy.copy(self), self._setup
        prior = tuple(
            math.inf if name == "bearing_rad" else std for name, std in zip(setup.free, setup.prior_std, strict=True)
        )
        other._setup = replace(setup, prior_std=prior, bearing_has_prior=False, widest_rad=math.inf)
        other.__dict__.pop("_search_of_tilted", None)
        other._search, other._open_search = (other._search_in(one.cells) for one in (self._search, self._open_search))
        other._set_scene(self._scene.behind)
        return other

    def _matched(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames, each alone."""
        match = self._match_auto if self._auto else self._match_stated
        tilted = frames.tilts_rad.any(axis=1)
        if tilted.any():
            self._check_tilted()
        parts = [part for own in (~tilted, tilted) for part in self._parts(np.flatnonzero(own))]
        found = mapped(match, [frames[part] for part in parts], self._workers)
        by_frame = {
            k: answer for part, some in zip(parts, found, strict=True) for k, answer in zip(part, some, strict=True)
        }
        return [by_frame[k] for k in range(len(frames))]

    def _albedo_std(self) -> float:
        """Return how well the logarithm of the landmark's albedo is known beside that of wall and floor."""
        if self._auto:
            return UNSTATED_ALBEDO_STD
        if self._stated is None or self._stated.estimates_floor_albedo:  # which is estimated for a landmark as stated
            return 0.0
        return self._stated.albedo_ratio_std

    @property
    def rules(self) -> Rules:
        """Rules by which an answer is accepted."""
        return self._setup.rules

    def renderer(self, class_index: int) -> Renderer:
        """Return what renders a class, with what it has computed of the light around it."""
        return self._rendered.renderer(class_index)

    @property
    def is_quick(self) -> bool:
        """Whether a search renders nothing, for the images of the bank are fine enough."""
        return self._exact is not None and not self._auto

    def track(self, frames: FilteredFrames, near: Sequence[Match]) -> Match:
        """Match one filtered frame from expected views alone, before an expected background.

        Of an automatic background the frame tells how far the wall is, where that is near where it is expected.
        """
        evidence, setup = Evidence.from_frames(frames, self._setup.on), self._setup
        names = list(setup.rules.names)
        classes = np.array([names.index(one.class_name) for one in near if one.class_name is not None], np.int64)
        views = np.array([[getattr(one, name) for name in VIEW] for one in near])
        scene, behind = self._scene, self._stated
        if self._auto:
            behind = near[0].background
            if behind is not None and behind.wall_m is not None:
                seen = estimate_surroundings(frames, 0, bearing_known=True, tilt_known=True).background
                if seen is not None and seen.wall_m is not None and abs(seen.wall_m - behind.wall_m) < _WALL_MOVES_M:
                    behind = replace(behind, wall_m=seen.wall_m, wall_albedo=seen.wall_albedo)
            scene = self._scene_before([] if behind is None else [behind])
        if evidence.tilt_rad.any():
            self._check_tilted()
            scene = replace(scene, final=self._rendered, scout=None)
        starts = Starts(np.zeros(len(views), np.int64), classes, views)
        fits = refine(scene.final, evidence, starts, near_settings(scene, evidence))
        if setup.unknown and not setup.reports_one_surface:
            fits = fit_without_borders(scene, evidence, fits)
        fits = with_valleys(scene, evidence, fits)
        bare = bare_cost(evidence.seen, scene.behind)
        (answer,) = rank(setup.rules, fits, self._doubt(fits), bare, [behind])
        return answer

    def _parts(self, which: NDArray[np.int64]) -> list[NDArray[np.int64]]:
        """Return frames in parts that are matched at once."""
        share = max(math.ceil(len(which) / self._workers), 1)
        most = _PIXELS_AT_ONCE // (self._setup.used.size * len(self.free) ** 2)
        share = min(share, self._setup.policy.frames_at_once, max(most, 1))
        return [which[start : start + share] for start in range(0, len(which), share)]

    def _match_stated(self, frames: FilteredFrames) -> list[Match]:
        """Match frames, all of them tilted or none, before the background that was stated, or none."""
        evidence = Evidence.from_frames(frames, self._setup.on)
        scene = self._scene
        if evidence.tilt_rad.any():  # a bank is of level views: others are rendered
            search = self._search_of_tilted.tilted(evidence.tilt_rad)
            scene = replace(scene, final=self._rendered, scout=None, search=search)
        bare = bare_cost(evidence.seen, scene.behind)
        fits = search_views(scene, evidence, evidence.seen, bare)
        if self._setup.unknown and not self._setup.reports_one_surface:
            fits = fit_without_borders(scene, evidence, fits)
        floors = None
        if self._stated is not None and self._stated.estimates_floor_albedo:
            floors = estimate_floors(self._setup, self._rendered, evidence, fits, self._stated)
            scene = replace(scene, final=self._rendered.with_background(*floors.backgrounds))
            fits = fit_before_floors(scene, evidence, fits)
        fits = with_profiles(scene, evidence, with_valleys(scene, evidence, fits))
        backgrounds = [self._stated] * len(frames) if floors is None else floors.backgrounds
        answers = rank(self._setup.rules, fits, self._doubt(fits), bare, backgrounds)
        if floors is not None:
            answers = [
                with_parts(self._setup.rules, match, {"floor_albedo": part})
                for match, part in zip(answers, floors.part, strict=True)
            ]
        answers = self._with_mirror(evidence, answers, scene.search)
        return self._with_shared_errors(frames, evidence, answers)

    def _match_auto(self, frames: FilteredFrames) -> list[Match]:
        """Match frames, each before what stands behind it."""
        evidence = Evidence.from_frames(frames, self._setup.on)
        bare = np.minimum(bare_cost(evidence.seen, None), self._bare_wall_cost(evidence))
        scenes = self._scene_before, self._whole_scene_before, self._open_scene
        backgrounds, fits = AutoBackground(frames, evidence, bare, self._setup, self._rendered, *scenes).search()
        answers: list[Match] = []
        for k, found in enumerate(rank(self._setup.rules, fits, self._doubt(fits), bare, backgrounds)):
            one, search = slice(k, k + 1), self._search if backgrounds[k] is None else self._open_search
            found = self._before_uncertain(backgrounds[k], evidence[one], found)
            mirrored = self._with_mirror(evidence[one], [found], search)
            answers.extend(self._with_shared_errors(frames[one], evidence[one], mirrored))
        return answers

    def _before_uncertain(self, background: Background | None, evidence: Evidence, answer: Match) -> Match:
        """Return an accepted answer whose covariance holds the uncertainty of the background that was estimated."""
        if background is None or not answer.accepted or answer.covariance is None:
            return answer
        rules = self._setup.rules
        view = np.array([getattr(answer, name) for name in VIEW])
        class_index = list(rules.names).index(str(answer.class_name))
        further = part_of_background(
            self._rendered, evidence, class_index, view, self.free, background, self._setup.prior_std
        )
        return with_parts(rules, replace(answer, covariance=answer.covariance + further), {})

    def _doubt(self, fits: Fits) -> NDArray[np.float64]:
        """Return the costs of fits that just fail a χ² test with the noise as stated, (m,)."""
        edge = special.chdtri(np.maximum(fits.dof, 1), self._setup.rules.false_alarm)
        return np.asarray(edge + DISAGREEMENT * fits.unexplained)

    def _with_mirror(self, evidence: Evidence, answers: list[Match], search: Search) -> list[Match]:
        """Say of accepted answers whether their frames may be mirrored left to right, by the bounds of the cells."""
        accepted = np.array([k for k, answer in enumerate(answers) if answer.accepted], np.int64)
        if not accepted.size:
            return answers
        some, seen = [answers[k] for k in accepted], evidence.seen[accepted]
        dof = np.array([answer.dof for answer in some])
        # what an answer leaves to unknown things costs the other view, too
        left = np.maximum(seen.returned.sum(axis=1) - dof - len(self._setup.free), 0)
        false_alarm = self._setup.rules.false_alarm
        limit = largest_costs(false_alarm, dof, evidence.noise_tails[accepted]) + DISAGREEMENT * left
        found = search.of_frames(accepted).may_explain(seen.mirrored(self._bank.sensor.cols), limit)
        for k, answer, mirrored in zip(accepted, some, found, strict=True):
            answers[k] = replace(answer, may_be_mirrored=bool(mirrored))
        return answers

    def _with_shared_errors(self, frames: FilteredFrames, evidence: Evidence, answers: list[Match]) -> list[Match]:
        """Add to covariances what all frames of a camera share."""
        return with_shared_errors(
            self._setup, lambda: self._rendered, self._systematic, frames.sensor, evidence, answers
        )

    @cached_property
    def _rendered(self) -> RenderedModel:
        """What renders the landmarks of the bank, made when it is first needed."""
        fits_albedo = self._setup.on == "phasors" or self._setup.albedo_std > 0
        splits = fits_albedo and (self._auto or self._stated is not None)
        return RenderedModel(
            self._bank,
            self._stated,
            self._setup.policy.cache_bytes,
            splits_light=splits,
            reported=self._setup.reports_one_surface,
        )

    @cached_property
    def _turned(self) -> Turned | None:
        """What renders views of the bank at bearings within half a column, where pixels are wide.

        Before backgrounds that are estimated cells are made for every frame: then the views are kept.
        """
        known: dict[tuple[int, float, int], list[PhasorImages]] = {}
        light = [self._rendered.renderer(c) for c in range(len(self._bank.classes))]
        if self._setup.reports_one_surface:  # as the bank has them
            meshes = [self._bank.mesh(name) for name in self._bank.classes]
            light = [Renderer(mesh, self._bank.sensor, albedo=float(mesh.metadata["albedo"])) for mesh in meshes]

        def turned(class_index: int, distance_m: float, delta_rad: NDArray[np.float64]) -> list[PhasorImages]:
            key = class_index, distance_m, len(delta_rad)
            if key in known:
                return known[key]
            renderer, width_rad = light[class_index], self._bank.sensor.pixel_rad
            images = [renderer.render(distance_m, delta_rad, share * width_rad) for share in _SHARES_OF_COLUMN]
            if self._auto:
                known[key] = images
            return images

        return turned if self._bank.sensor.pixel_rad > WIDE_PIXEL_RAD else None

    def _bank_models(self, behind: PhasorImages | None) -> tuple[BankModel | None, BankModel | StripModel | None]:
        """Return the interpolated images that the answer is taken from, and those of a scout; None where unfit."""
        setup = self._setup
        fixed = setup.free == VIEW[:2]
        alone = setup.on == "ranges" and self._stated is None
        chip = setup.reports_one_surface  # its ranges jump between the nodes of a bank, and its strips need no tilt
        is_exact = fixed and alone and not chip and BankModel.grid_is_fine_enough(self._bank, *_FINE_GRID)
        level = setup.free in (VIEW[:2], VIEW[:3]) or (chip and "height_m" not in setup.free)
        has_strips = alone and not is_exact and level
        if has_strips and StripModel.suits(self._bank, self._search.widest_columns):
            return None, StripModel(self._bank, self._search.widest_columns)
        scouts = fixed and BankModel.grid_is_fine_enough(self._bank, *_COARSE_GRID)
        if not (is_exact or scouts):
            return None, None
        model = BankModel(self._bank)
        return model if is_exact else None, model.smooth(behind) if scouts else None

    def _check_tilted(self) -> None:
        """Check that tilted frames can be matched."""
        if self._auto or self._stated is not None:
            raise UsageError(
                "frames with a tilt take no wall or floor: leave 'background' out, or give background=\"unknown\""
            )
        self._check_distances()

    def _check_distances(self) -> None:
        """Check that the bank has distances at which views are rendered."""
        nearest, (step_m, step_rad) = self._rendered.limits(self._bank.delta_rad)[0].min(), _FINE_GRID
        if self._bank.distance_m[-1] < nearest:
            raise UsageError(
                f"the bank ends at {self._bank.distance_m[-1]:g} m, and views nearer than {nearest:.3g} m, where the"
                " lens is in the landmark, are not rendered: build it in steps of at most"
                f" {step_m:g} m and {math.degrees(step_rad):.2g}°, and free"
                " distance_m and delta_rad alone without a background"
            )

    def _check_floor(self, floor_m: float) -> None:
        """Check that the landmarks of the bank do not reach below a floor that was stated."""
        view = Views.broadcast(float(self._bank.distance_m[-1])).in_camera(self._bank.sensor)
        for c in range(len(self._setup.rules.names)):
            Background(floor_m=floor_m).check_behind(self._rendered.renderer(c).footprint, view)

    def _cells(
        self,
        behind: PhasorImages | None,
        *,
        open_edges: bool = False,
        tilted: bool = False,
        only: NDArray[np.bool_] | None = None,
        workers: int = 1,
    ) -> CellBounds:
        """Return the cells of the bank before some background, for level or for tilted frames."""
        setup, bank = self._setup, self._bank
        return CellBounds(
            bank,
            (max(1, round(CELL_M / first_step(bank.distance_m))), max(1, round(CELL_RAD / first_step(bank.delta_rad)))),
            behind,
            aside=setup.bearing_is_free or tilted,
            upward=not setup.height_and_tilt_are_known or tilted,
            open_edges=open_edges,
            turned=self._turned if setup.bearing_is_free or tilted else None,
            only=only,
            ratios=_ALBEDO_RATIOS if setup.albedo_std > 0 and behind is not None else (),
            workers=workers,
        )

    @cached_property
    def _search_of_tilted(self) -> Search:
        """The search in frames whose tilt is known, made when it is first needed."""
        return self._search_in(self._cells(None, tilted=True, workers=self._workers))

    def _search_in(self, cells: CellBounds) -> Search:
        """Return a search in some cells, over all bearings that are looked for where they are free."""
        setup, layers = self._setup, layers_of(self._bank)
        return Search(
            cells,
            self._bank.sensor if layers is None else layers.camera,
            layers,
            setup.widest_rad if setup.bearing_is_free else 0.0,
            Upward(setup.prior_std_of("height_m"), setup.prior_std_of("pitch_rad"), setup.policy.prior_sigma),
            setup.prior_std_of("bearing_rad") or math.inf,
        )

    def _open_scene(self) -> Scene:
        """Return the scene without a background whose search leaves open whether there is one."""
        return replace(self._scene, search=self._open_search, closed_search=lambda *_: self._search)

    def _scene_before(self, backgrounds: Sequence[Background]) -> Scene:
        """Return the scene of estimated backgrounds; see :class:`AutoBackground`."""
        if not backgrounds:
            return self._scene
        behind = background_of(self._bank, *backgrounds)

        def closed_search(k: int, only: NDArray[np.bool_]) -> Search:
            return self._search.before(self._cells(background_of(self._bank, backgrounds[k]), only=only))

        return replace(
            self._scene,
            behind=behind,
            final=self._rendered.with_background(*backgrounds),
            scout=self._scout.before(behind) if isinstance(self._scout, BankModel) else None,
            search=self._open_search,
            closed_search=closed_search if self._bank.is_open else None,
        )

    def _whole_scene_before(self, backgrounds: Sequence[Background]) -> Scene:
        """Return the same, searched in images of the bank before each background."""
        search = self._search.before(*(self._cells(background_of(self._bank, own)) for own in backgrounds))
        return replace(self._scene_before(backgrounds), search=search, closed_search=None)

    def _bare_wall_cost(self, evidence: Evidence) -> NDArray[np.float64]:
        """Return how badly a wall at its best distance explains all of each frame, (n,)."""
        seen, cost = evidence.seen, np.full(len(evidence.weight), np.inf)
        weight = np.where(seen.returned, seen.weight, 0.0)
        enough = (seen.returned.sum(axis=1) >= MIN_RETURNS) & (weight.sum(axis=1) > 0)
        which = np.flatnonzero(enough)
        forward = self._bank.sensor.axis_cosine().ravel() * seen.range_m[which]
        wall_m = np.average(np.where(seen.returned[which], forward, 0.0), axis=1, weights=weight[which])
        which, wall_m = which[wall_m >= NEAREST_WALL_M], wall_m[wall_m >= NEAREST_WALL_M]
        if which.size:
            walls = [Background(wall_m=float(own)) for own in wall_m]
            cost[which] = bare_cost(evidence[which].seen, background_of(self._bank, *walls))
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
    sure = counts(behind.phasor, behind.intensity, sensor).reshape(shape)
    residual = wrap_difference_m(np.where(lit & seen.returned, seen.range_m - np.where(lit, model, 0.0), 0.0), sensor)
    wrong = (seen.returned & ~lit) | (seen.not_returned & sure)
    squared = np.minimum(seen.weight * residual**2, DISAGREEMENT)
    return np.asarray(squared.sum(axis=1) + DISAGREEMENT * wrong.sum(axis=1))


def _check_choices(bank: Bank, background: object, on: str) -> None:
    """Check that the choices of a matcher go together."""
    if bank.plan.model != "ray":
        raise UsageError(f"the bank's model is '{bank.plan.model}', which knows no mixed pixels: refine needs 'ray'")
    if background == "unknown" and on != "ranges":
        raise UsageError('background="unknown" takes on="ranges": the brightness of unknown things tells nothing')
    if isinstance(background, Background) and background.estimates_floor_albedo and on != "ranges":
        raise UsageError("'floor_albedo_std' takes on=\"ranges\": state the floor's albedo, and 0")
    if background == "auto" and layers_of(bank) is not None:
        raise UsageError('background="auto" takes on="ranges" with several modulation frequencies')


def usual_workers() -> int:
    """Return how many threads match where nobody says: one for each processor, at most eight."""
    return min(processors(), 8)
