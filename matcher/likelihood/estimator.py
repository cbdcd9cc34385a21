"""Maximum likelihood: candidates from the bank, refined, compared, and told with their uncertainty."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import special

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.landmarks.symmetry import mesh_symmetry
from phasemark.matcher.agreement import DISAGREEMENT, counts, pixel_mask
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.filters.stamps import spread_stamps
from phasemark.matcher.information import covariance_of, weak_direction
from phasemark.matcher.likelihood.background_estimate import (
    NEAREST_WALL_M,
    estimate_surroundings,
    fit_background,
    without_background,
)
from phasemark.matcher.likelihood.descent import Fits, Settings, refine
from phasemark.matcher.likelihood.images import VIEW, BankModel, ImageModel, RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence, ResidualKind
from phasemark.matcher.likelihood.systematic import (
    Systematic,
    calibrated_covariance,
    calibrated_fields,
    calibrated_slopes,
    carried_covariance,
    declared_covariance,
    rates_of_views,
)
from phasemark.matcher.match import Candidate, Match, Reason
from phasemark.matcher.nearest.bank_minima import Search, Starts
from phasemark.matcher.nearest.templates import Observation
from phasemark.render import (
    Background,
    PhasorImages,
    Renderer,
    Sensor,
    Views,
    delta_period_rad,
    phasor_to_range_m,
    wrap_delta_difference_rad,
    wrap_delta_rad,
    wrap_difference_m,
)

Pixels = Literal["all", "lower"]
MIN_RETURNS = 3
"""Fewer returns decide nothing."""
ROBUST_FROM = 3.0
"""Where Huber's loss turns linear, in σ: far enough out to cost an honest frame nothing."""
_MODES, _MODES_BEFORE_BACKGROUND = 2, 4
_MODES_AGAIN = 8
_DOUBTFUL, _HOPELESS = 0.05, 1e-3
"""p-values at which it is worth looking elsewhere: where the likelihood has side peaks, and where it is smooth."""
_BESIDE_RAD = math.radians(1.0)
"""Side peaks of the likelihood before a background are about so far away (PHYSICS section 7)."""
_BESIDE_AGAIN_RAD = tuple(math.radians(side) for side in (-3.0, -2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0, 3.0))
_CLOSE_BY_RAD = tuple(math.radians(side) for side in (-0.7, -0.28, -0.12, 0.12, 0.28, 0.7))
"""And others, of narrower edges, so far."""
_FINE, _COARSE = (0.011, math.radians(1.1)), (0.022, math.radians(2.2))
"""Widest grids, metres and radians, on which interpolation is at the bound, and on which it shows the way."""
_SAME_M, _SAME_RAD = 2e-3, math.radians(0.2)
TOLERANCE_M, TOLERANCE_RAD = 0.03, math.radians(6.0)
"""An accepted answer is right to within these at three standard deviations."""
BEARING_STD_RAD = math.radians(1.5)
"""How well a mount is thought to point at the landmark, unless the matcher is told."""
_SURE_BEARING = 0.05
"""Share of half a column to which a bearing must be known for other bearings to be out of the question."""
_SLIDES = (-8.0, -4.0, -2.0, -1.0, 1.0, 2.0, 4.0, 8.0)
_SLIDES_PRIOR = (-1.0, 1.0)
"""Bearings, in half columns, under which a flat landmark is tried again; the second where a prior holds the bearing."""
_REGISTRATIONS = 2
"""How often a first view is moved to the distance that the frame shows."""
_PRIOR_SIGMA = 3.0
"""Widest bearing that is searched, in standard deviations of the prior."""
_TOLERATED_SIGMA = 3.0
_LARGEST_SCALE = 2.0
"""Largest ratio of residuals to their stated noise among unknown things."""
_STRANGE_SIGMA = 5.0
"""A return farther from the model than this sees something else."""
_FEWEST_EXPLAINED = 6
"""Returns that each free parameter takes where unknown things stand in view."""
_PIXELS_AMONG_UNKNOWN = 4
"""Unexplained pixels that must stand against a far view where unknown things stand in view."""
_AMBIGUITY = 1e-3
"""Largest probability that an accepted answer leaves to other classes."""
LIKELY = 100.0
"""An explanation whose cost is larger by this has no probability worth telling."""
_MARGIN = 500.0
"""A rough fit whose cost is larger by this does not become the best one: a column of pixels on the wrong side of an
edge costs half as much."""
_MOST_REFINED = 3
_WALLS_BEYOND_M = (0.5, 1.0, 2.0, 4.0)
"""How far behind the landmark a wall is tried that no pixel sees alone."""
_MOST_EQUALS = 12
"""Sides of one landmark that look the same and are all told."""
_OTHER_ANGLES = 12
"""Angles that a frame before an estimated background is tried from, where nothing else fits."""
_LONG_STEP = 1.0
"""The same where a scout did not know the bearing."""
_BACKGROUND_ROUNDS = 4
"""How often background and views are fitted in turn."""
_SHORT_STEP = 0.1
"""Longest step after a scout, in natural units: it comes within about so much."""
_FRAMES_AT_ONCE = 256
_TRIMMINGS, _ODD, _ODD_SIGMA = 3, 3.0, 5.0
"""How often a robust search starts again without the returns that fit worst, and which: by the median, and in σ."""


def check_free(free: Sequence[str]) -> tuple[str, ...]:
    """Return names of free parameters in the order of the view.

    Raises
    ------
    UsageError
        A name is unknown or repeated, or distance is not among them.
    """
    names = tuple(free)
    for name in names:
        if name not in VIEW:
            raise UsageError(f"'free' must be among {', '.join(VIEW)}, got {name!r}")
    if len(set(names)) < len(names) or "distance_m" not in names or "delta_rad" not in names:
        raise UsageError(f"'free' must name distance_m and delta_rad, and others once each, got {names!r}")
    return tuple(name for name in VIEW if name in names)


class MaximumLikelihood:
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
        bearing_std_rad: float = BEARING_STD_RAD,
        systematic: Sequence[Systematic] = (),
        tolerance_m: float = TOLERANCE_M,
        tolerance_rad: float = TOLERANCE_RAD,
        workers: int | None = None,
    ) -> None:
        if on not in ("ranges", "phasors"):
            raise UsageError(f"'on' must be ranges or phasors, got {on!r}")
        if pixels not in ("all", "lower"):
            raise UsageError(f"'pixels' must be all or lower, got {pixels!r}")
        if bank.plan.model != "ray":
            raise UsageError(
                f"the bank's model is '{bank.plan.model}', which knows no mixed pixels: refine needs 'ray'"
            )
        self.bank = bank
        self.free = check_free((*VIEW[:2], "bearing_rad") if free is None else free)
        self._prior_std = (math.inf, math.inf, bearing_std_rad) if free is None else ()
        self.on: ResidualKind = on
        self.false_alarm = false_alarm
        self._systematic = systematic
        self._workers = workers or _usual_workers()
        self._tolerance = {name: tolerance_m if name.endswith("_m") else tolerance_rad for name in VIEW}
        self.auto = background == "auto"
        self.unknown = background == "unknown"
        if self.unknown and on != "ranges":
            raise UsageError('background="unknown" takes on="ranges": the brightness of unknown things tells nothing')
        self.background = background if isinstance(background, Background) else None
        self._used = pixel_mask(pixels, bank.sensor).ravel()
        self._huber = ROBUST_FROM if robust or self.unknown else None
        self._behind = None if self.background is None else _behind(bank, self.background)
        fixed, near = self.free == VIEW[:2], bool(self._prior_std)
        exact = fixed and on == "ranges" and self.background is None and BankModel.fits(bank, *_FINE)
        scouts = (fixed or near) and BankModel.fits(bank, *_COARSE)
        self._bank_model = BankModel(bank) if exact else None
        self._scout = BankModel(bank, self._behind, smooth_only=True) if scouts else None
        self._rendered: RenderedModel | None = None
        if self.auto or not exact:
            self._rendered = RenderedModel(bank, self.background, self._workers)
            nearest = self._rendered.limits()[0]
            if bank.distance_m[-1] < nearest:
                raise UsageError(
                    f"the bank ends at {bank.distance_m[-1]:g} m, and views nearer than {nearest:.3g} m, half the"
                    " landmark's width, are not rendered: build it in steps of at most"
                    f" {_FINE[0]:g} m and {math.degrees(_FINE[1]):.2g}°, and free"
                    " distance_m and delta_rad alone without a background"
                )
        aside = "bearing_rad" in self.free
        fine = (1, 1) if self.background is not None and not aside else (2, 3)
        along, around = (
            max(1, min(step, (len(grid) - 1) // 4))
            for step, grid in zip(fine, (bank.distance_m, bank.delta_rad), strict=True)
        )
        self._stride = (along, around)
        self._widest = _PRIOR_SIGMA * bearing_std_rad if near else math.inf
        self._search = self._new_search(self._behind, 0.0 if near else self._widest)
        self._wide_search = self._new_search(self._behind, self._widest) if near else self._search
        meshes = [bank.mesh(name) for name in bank.classes]
        self._symmetry = [int(mesh.metadata["symmetry"]) for mesh in meshes]
        # a mesh that is said to have no symmetry may look the same from several sides all the same
        self._own_symmetry = [
            mesh_symmetry(mesh) if n == 1 else n for mesh, n in zip(meshes, self._symmetry, strict=True)
        ]
        self._middle = np.array([mesh.centroid for mesh in meshes])

    def _new_search(self, behind: PhasorImages | None, widest_rad: float) -> Search:
        """Return a search before some background, over bearings up to a widest where they are free."""
        widest = widest_rad if "bearing_rad" in self.free else 0.0
        return Search(self.bank, behind, self._stride, widest, capped=self.unknown)

    def match(self, frames: FilteredFrames) -> list[Match]:
        """Match filtered frames."""
        answers: list[Match] = []
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            some = frames[start : start + _FRAMES_AT_ONCE]
            answers.extend(self._match_auto(some) if self.auto else self._match_some(some))
        return self._with_motion(frames, answers)

    def _match_some(self, frames: FilteredFrames) -> list[Match]:
        evidence = Evidence.from_frames(frames, self.on)
        bare = bare_cost(evidence.seen, self._behind)
        models = _Models(self._bank_model or self._rendered, None if self._bank_model else self._scout)
        fits = self._searched(models, evidence, evidence.seen, bare, self.background, self._behind)
        if self.unknown:
            fits = self._without_borders(models, evidence, fits)
        return self._answers(frames, evidence, fits, bare, self.background)

    def _match_auto(self, frames: FilteredFrames) -> list[Match]:
        """Match frames one by one, each before what stands behind it."""
        answers: list[Match] = []
        for k in range(len(frames)):
            one = frames[k : k + 1]
            evidence = Evidence.from_frames(one, self.on)
            around = estimate_surroundings(one, bearing_known="bearing_rad" not in self.free or bool(self._prior_std))
            background = around.background
            bare = np.minimum(bare_cost(evidence.seen, None), self._bare_wall_cost(one, evidence))
            assert self._rendered is not None
            models = _Models(self._bank_model or self._rendered, None if self._bank_model else self._scout)
            behind = None
            seen = evidence.seen
            if background is not None:
                behind = _behind(self.bank, background)
                scout = None if self._scout is None else self._scout.before(behind)
                models = _Models(self._rendered.with_background(background), scout)
                seen = without_background(seen, around)
            fits = self._searched(models, evidence, seen, bare, background, behind)
            if self._is_doubtful(fits):
                background, fits = self._with_better_background(background, evidence, fits)
            if background is not None and self._is_doubtful(fits):
                # what was taken for background, or lies beside it, may be landmark: search with both in the images
                behind = _behind(self.bank, background)
                models = _Models(self._rendered.with_background(background), models.scout)
                search = self._new_search(behind, self._widest)
                again = self._searched(models, evidence, evidence.seen, bare, background, behind, search)
                fits = Fits.joined([fits, again])
                if self._is_doubtful(fits):
                    background, fits = self._with_better_background(background, evidence, fits)
            if background is not None and self._is_doubtful(fits):
                fits = Fits.joined([fits, self._other_angles(background, evidence, fits)])
                background, fits = self._with_better_background(background, evidence, fits)
            answers.extend(self._answers(one, evidence, fits, bare, background))
        return answers

    def _with_better_background(
        self, background: Background | None, evidence: Evidence, fits: Fits
    ) -> tuple[Background | None, Fits]:
        """Fit the background behind the best view of one frame, then the views before it, in turn while that helps.

        Where no pixel sees a background alone, walls at some distances behind the landmark are tried.
        """
        if background is not None:
            return self._background_and_views(background, evidence, fits)
        best = fits.view[fits.cost.argmin()]
        found: tuple[Background | None, Fits] = (None, fits)
        for beyond in _WALLS_BEYOND_M:
            there = self._background_and_views(Background(wall_m=float(best[0]) + beyond), evidence, fits)
            if there[1].cost.min() < found[1].cost.min():
                found = there
            if not self._is_doubtful(found[1]):
                break
        return found

    def _other_angles(self, background: Background, evidence: Evidence, fits: Fits) -> Fits:
        """Fit one frame from its best view turned to other angles; distance and bearing are found more easily."""
        assert self._rendered is not None
        if not np.isfinite(fits.cost).any():
            return fits[:0]
        best = int(fits.cost.argmin())
        period = delta_period_rad(self._symmetry[fits.class_index[best]])
        angles = np.arange(1, _OTHER_ANGLES) * period / _OTHER_ANGLES
        view = np.tile(fits.view[best], (len(angles), 1))
        view[:, 1] += angles
        frame, class_index = (np.full(len(angles), values[best]) for values in (fits.frame, fits.class_index))
        settings = self._settings(_behind(self.bank, background))
        return refine(self._rendered.with_background(background), evidence, frame, class_index, view, settings)

    def _background_and_views(self, background: Background, evidence: Evidence, fits: Fits) -> tuple[Background, Fits]:
        """Fit a background behind the best view of one frame, then the views before it, in turn while that helps."""
        assert self._rendered is not None
        for _ in range(_BACKGROUND_ROUNDS):
            finite = np.flatnonzero(np.isfinite(fits.cost))
            if not finite.size:
                break
            best = finite[np.argsort(fits.cost[finite], kind="stable")][:_MOST_REFINED]
            found, view = fit_background(
                self._rendered,
                evidence,
                int(fits.class_index[best[0]]),
                fits.view[best[0]],
                self.free,
                background,
            )
            if found == background:
                break
            behind = _behind(self.bank, found)
            model = self._rendered.with_background(found)
            settings = replace(self._settings(behind), look_beside_rad=_CLOSE_BY_RAD)
            some = fits[best]
            some.view[0] = view
            again = refine(model, evidence, some.frame, some.class_index, some.view, settings)
            others = self._other_classes(model, evidence, again, settings)
            again = Fits.joined([again, others, self._look_alikes(model, evidence, again, behind)])
            if not again.cost.min() < fits.cost[best[0]]:
                break
            settled = again.cost.min() > fits.cost[best[0]] - 1
            background, fits = found, again
            if settled:
                break
        return background, fits

    def _searched(
        self,
        models: _Models,
        evidence: Evidence,
        seen: Observation,
        bare: NDArray[np.float64],
        background: Background | None,
        behind: PhasorImages | None,
        search: Search | None = None,
    ) -> Fits:
        """Search and fit; where nothing fits, search again from many more places."""
        search, wide = (search, search) if search else (self._search, self._wide_search)
        enough = self._worth_a_search(evidence, bare)
        side_peaks = evidence.on == "phasors" or background is not None
        n_modes = _MODES if background is None else _MODES_BEFORE_BACKGROUND
        all_classes = evidence.on == "phasors"

        def doubtful(fits: Fits, *, hopeless: bool = False) -> NDArray[np.int64]:
            """Return the frames whose best fit is worse than good ones are, but not beyond hope.

            On ranges, that is where it costs more than returns that nothing explains; before a known background every
            fit may be a side peak.
            """
            best = _best_of_frame(fits)
            limit = special.chdtri(np.maximum(fits.dof[best], 1), _DOUBTFUL if side_peaks else _HOPELESS)
            cost, frame = fits.tested[best], fits.frame[best]
            certain = evidence.on == "phasors" or self.background is not None or hopeless
            hope = True if certain else cost < bare[frame]
            return np.asarray(frame[(cost > limit) & hope])

        starts = search.starts(_some(seen, enough), n_modes, all_classes=all_classes)
        sides = () if background is None else (-_BESIDE_RAD, _BESIDE_RAD)
        fits = [self._fit(models, evidence, enough, starts, sides, behind)]
        poor = doubtful(fits[0])
        if poor.size and self._prior_std:
            # a scout knows no bearing: turn its best views, heading kept, and look at shifted images
            direct = _Models(models.final, None)
            fits.append(self._turned(direct, evidence, poor, Fits.joined(fits), behind))
            poor = doubtful(Fits.joined(fits))
        if poor.size and self._prior_std:
            starts = wide.starts(_some(seen, poor), n_modes, all_classes=all_classes)
            fits.append(self._fit(direct, evidence, poor, starts, (-_BESIDE_RAD, _BESIDE_RAD), behind))
        elif poor.size:
            starts = wide.starts(_some(seen, poor), _MODES_AGAIN, all_classes=all_classes)
            fits.append(self._fit(models, evidence, poor, starts, _BESIDE_AGAIN_RAD, behind, patient=True))
            poor = doubtful(fits[-1])
        if poor.size and models.scout is not None and not self._prior_std:
            # too little may be smooth for the scout to see the way
            starts = wide.starts(_some(seen, poor), n_modes, all_classes=all_classes)
            direct = _Models(models.final, None)
            fits.append(self._fit(direct, evidence, poor, starts, (-_BESIDE_RAD, _BESIDE_RAD), behind))
        if self._huber is not None and not self.unknown:
            for _ in range(_TRIMMINGS):
                poor = doubtful(Fits.joined(fits), hopeless=True)
                if not poor.size:
                    break
                assert models.final is not None
                kept = self._trimmed(models.final, evidence, Fits.joined(fits), poor, seen)
                starts = search.starts(kept, n_modes, all_classes=all_classes)
                fits.append(self._fit(models, evidence, poor, starts, sides, behind))
        if models.final is not None:
            fits.append(self._look_alikes(models.final, evidence, Fits.joined(fits), behind))
        return Fits.joined(fits)

    def _turned(
        self, models: _Models, evidence: Evidence, which: NDArray[np.int64], fits: Fits, behind: PhasorImages | None
    ) -> Fits:
        """Fit some frames from their best views seen under several bearings, as far apart as their prior is wide.

        A frame tells the heading δ − b before it tells δ and b: a view fitted without a bearing has the right heading.
        """
        best = _best_of_frame(fits)
        best = best[np.isin(fits.frame[best], which)]
        turns = np.array([-2.0, -1.0, 1.0, 2.0]) * min(self._widest / 2, self._search.column_rad / 2)
        view = np.tile(fits.view[best], (len(turns), 1))
        view[:, 1] += np.repeat(turns, len(best))
        view[:, 2] += np.repeat(turns, len(best))
        assert models.final is not None
        order = np.argsort(np.tile(fits.frame[best], len(turns)), kind="stable")
        frame, class_index = np.tile(fits.frame[best], len(turns)), np.tile(fits.class_index[best], len(turns))
        settings = self._settings(behind)
        found = self._modes(models.final, evidence, frame[order], class_index[order], view[order], settings, _MARGIN)
        return Fits.joined([found, self._other_classes(models.final, evidence, found, settings)])

    def _look_alikes(self, model: ImageModel, evidence: Evidence, fits: Fits, behind: PhasorImages | None) -> Fits:
        """Let views that look like the best one explain each frame: what no slope leads to from there.

        A mesh with a symmetry that its bank does not have looks the same from several sides. A thin landmark looks
        nearly the same from the front and from the back, its middle seen at the same place.
        A flat one looks nearly the same under every bearing, its heading kept.
        """
        best = _best_of_frame(fits)
        best = best[np.isfinite(fits.cost[best])]
        half = self._search.column_rad / 2
        candidates = []
        for k in range(1, min(_MOST_EQUALS, max(self._own_symmetry))):
            n = np.array([self._own_symmetry[c] // self._symmetry[c] for c in fits.class_index[best]])
            equal = best[k < n]
            views = fits.view[equal].copy()
            views[:, 1] += 2 * math.pi * k / n[k < n]
            candidates.append((equal, views))
        aside = "bearing_rad" in self.free
        slides = _SLIDES_PRIOR if self._prior_std else _SLIDES
        odd = best[np.array([self._symmetry[c] % 2 for c in fits.class_index[best]], np.bool_)]
        flipped = self._from_behind(fits, odd)
        for side in (0.0, *slides) if aside else (0.0,):
            candidates.append((odd, flipped + np.array([0.0, side * half, side * half, 0.0])))
        if aside:
            # a flat landmark tells the heading δ − b, and little of its two parts
            flat = best[fits.std_without_one[best, self.free.index("bearing_rad")] > _SURE_BEARING * half]
            for side in slides:
                candidates.append((flat, fits.view[flat] + np.array([0.0, side * half, side * half, 0.0])))
        source = np.concatenate([which for which, _ in candidates])
        frame, class_index = fits.frame[source], fits.class_index[source]
        view = np.concatenate([views for _, views in candidates])
        return refine(
            model,
            evidence,
            frame,
            class_index,
            _at_measured_distance(model, evidence, frame, class_index, view),
            self._settings(behind),
            fits.cost[source] + LIKELY,
            # zones of a direct sensor do not mix light: the cost of a view says little of that of its neighbours
            at_first_sight=len(self.free) == 2 or bool(self._prior_std) or evidence.sensor.kind == "phase",
        )

    def _from_behind(self, fits: Fits, which: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return views of some fits from the other side, the landmark's middle at the same place; (k, 4)."""
        view = fits.view[which].copy()
        view[:, 1] += math.pi
        middle = self._middle[fits.class_index[which]]
        here, there = (_rotated(middle, delta) for delta in (fits.view[which, 1], view[:, 1]))
        view[:, 0] += here[:, 0] - there[:, 0]
        if "bearing_rad" in self.free:
            view[:, 2] += np.arctan2(here[:, 1], fits.view[which, 0] + here[:, 0])
            view[:, 2] -= np.arctan2(there[:, 1], view[:, 0] + there[:, 0])
        return view

    def _without_borders(self, models: _Models, evidence: Evidence, fits: Fits) -> Fits:
        """Fit the best views again without the pixels beside one that sees something else.

        They may see a little of it too, at the sides of the landmark, where a wrong range turns the view most. Views
        of one frame are compared on the same pixels: those that are beside something else in none of them. How pixels
        scatter among unknown things is known less well than otherwise: covariances grow with the χ² found.
        """
        model = models.final
        assert model is not None
        least = _least_of_frame(fits, len(evidence.weight))
        needed = _FEWEST_EXPLAINED * len(self.free)
        close = np.isfinite(fits.cost) & (fits.cost < least[fits.frame] + _MARGIN) & (fits.explained >= needed)
        modes = self._distinct_of_frames(fits, np.flatnonzero(close))
        some = fits[modes]
        kept = np.ones_like(evidence.seen.returned)
        inside = self._inside(model, evidence, some, needed)
        np.logical_and.at(kept, some.frame, inside)
        inside_evidence = replace(evidence, weight=evidence.weight * kept)
        again = refine(model, inside_evidence, some.frame, some.class_index, some.view, self._settings(None))
        again = again.with_scale(self._scatter_of_columns(model, inside_evidence, again))
        others = fits[np.setdiff1d(np.arange(len(fits)), modes)]
        less = np.zeros(len(evidence.weight))  # what the pixels left out cost the best no longer
        refitted = np.unique(some.frame)
        less[refitted] = _least_of_frame(again, len(less))[refitted] - least[refitted]
        others.cost[:] += less[others.frame]
        return Fits.joined([again, others])

    def _inside(self, model: ImageModel, evidence: Evidence, fits: Fits, needed: int) -> NDArray[np.bool_]:
        """Return which pixels are not beside one that sees something else than some views, (m, pixels)."""
        frame = fits.frame
        phasor = model.images(fits.class_index, np.ascontiguousarray(fits.view), ()).phasor
        size = np.sqrt(evidence.weight[frame]) * np.abs(
            evidence.sensor.metres_per_radian * np.angle(evidence.value[frame] * phasor.conj())
        )
        returned = evidence.seen.returned[frame]
        other = returned & ((phasor == 0) | (size > _STRANGE_SIGMA))
        shape = (-1, evidence.sensor.rows, evidence.sensor.cols)
        kept = np.ones(other.shape, np.bool_)
        for strange in (other, other | ~returned):  # beside pixels without a return too, where enough are left
            inside = ~_beside(strange.reshape(shape)).reshape(other.shape) | other
            enough = (inside & returned & ~other).sum(axis=1) >= needed
            kept[enough] = inside[enough]
        return kept

    def _scatter_of_columns(self, model: ImageModel, evidence: Evidence, fits: Fits) -> NDArray[np.float64]:
        """Return by how much covariances of views are too small, (m,): from χ², and from leaving out columns of pixels.

        Errors at the sides of a landmark are common to a column of pixels. The view changes by δθ_c without column c;
        the jackknife's covariance (C − 1) / C · Σ δθ_c δθ_cᵀ over C columns is compared with that of independent noise.
        """
        rows, cols = evidence.sensor.rows, evidence.sensor.cols
        m, p = len(fits), len(self.free)
        image = model.images(fits.class_index, np.ascontiguousarray(fits.view), self.free)
        turn = np.divide(1.0, image.phasor, out=np.zeros_like(image.phasor), where=image.phasor != 0)
        slope = evidence.sensor.metres_per_radian * (image.slope * turn[:, None]).imag
        residual = evidence.sensor.metres_per_radian * np.angle(evidence.value[fits.frame] * image.phasor.conj())
        weight = np.where(image.phasor != 0, evidence.weight[fits.frame], 0.0)
        weight = np.where(weight * residual**2 > _STRANGE_SIGMA**2, 0.0, weight)
        by_column = (m, p, rows, cols)
        weighted = (slope * weight[:, None]).reshape(by_column)
        gradient = np.einsum("mprc,mrc->mcp", weighted, residual.reshape(m, rows, cols))
        information = np.einsum("mprc,mqrc->mcpq", weighted, slope.reshape(by_column))
        whole = information.sum(axis=1)
        used = (weight.reshape(m, rows, cols) > 0).any(axis=1)
        shift = np.einsum("mcpq,mcq->mcp", np.linalg.pinv(whole[:, None] - information, hermitian=True), gradient)
        n = np.maximum(used.sum(axis=1), 2)
        jackknife = np.einsum("mcp,mcq,mc->mpq", shift, shift, used) * ((n - 1) / n)[:, None, None]
        by_columns = np.einsum("mpq,mqp->m", whole, jackknife) / p
        by_chi2 = fits.tested / np.maximum(fits.dof, 1)
        return np.asarray(np.maximum(1.0, np.maximum(by_columns, by_chi2)))

    def _trimmed(
        self, model: ImageModel, evidence: Evidence, fits: Fits, which: NDArray[np.int64], seen: Observation
    ) -> Observation:
        """Return some frames without the returns that are farthest from their best fits, and from the bulk of them."""
        best = _best_of_frame(fits)
        best = best[np.searchsorted(fits.frame[best], which)]
        phasor = model.images(fits.class_index[best], np.ascontiguousarray(fits.view[best]), ()).phasor
        few = _some(seen, which)
        size = np.sqrt(few.weight) * np.abs(
            wrap_difference_m(few.range_m - phasor_to_range_m(phasor, evidence.sensor), evidence.sensor)
        )
        compared = few.returned & np.isfinite(size)
        middle = np.nanmedian(np.where(compared, size, np.nan), axis=1, keepdims=True)
        odd = compared & (size > np.maximum(_ODD * middle, _ODD_SIGMA))
        return Observation(few.range_m, np.where(odd, 0.0, few.weight), few.returned & ~odd, few.not_returned & ~odd)

    def _is_doubtful(self, fits: Fits) -> bool:
        """Return whether the best fit of one frame is worse than good ones are."""
        if not np.isfinite(fits.cost).any():
            return False
        best = fits.cost.argmin()
        return bool(fits.tested[best] > special.chdtri(max(int(fits.dof[best]), 1), _DOUBTFUL))

    def _worth_a_search(self, evidence: Evidence, bare: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return which frames have enough returns to place a landmark, and are not explained without one."""
        returned = evidence.seen.returned
        enough = (returned & self._used).sum(axis=1) >= MIN_RETURNS
        explained = bare <= special.chdtri(np.maximum(returned.sum(axis=1), 1), self.false_alarm)
        return np.flatnonzero(enough & ~explained)

    def _fit(
        self,
        models: _Models,
        evidence: Evidence,
        enough: NDArray[np.int64],
        starts: Starts,
        sides: tuple[float, ...],
        behind: PhasorImages | None,
        *,
        patient: bool = False,
    ) -> Fits:
        """Refine the modes of every frame, then let the other classes explain it from the best one's view.

        The best start is tried with δ moved to some sides too.
        A scout, where there is one, does this first; of what it finds only the best is refined again.
        """
        settings = self._settings(behind)
        frame, class_index, view = enough[starts.frame], starts.class_index, starts.view
        if sides:
            first = np.flatnonzero(np.diff(starts.frame, prepend=-1))
            beside = [view[first] + [[0.0, side, 0.0, 0.0]] for side in sides]
            frame = np.concatenate([frame, np.tile(frame[first], len(sides))])
            class_index = np.concatenate([class_index, np.tile(class_index[first], len(sides))])
            view = np.concatenate([view, *beside])
        lead = models.scout or models.final
        assert lead is not None
        leading = settings
        if models.scout is not None and self._prior_std:
            leading = replace(settings, free=VIEW[:2], prior_std=())
        fits = self._modes(lead, evidence, frame, class_index, view, leading, np.inf if patient else _MARGIN)
        fits = Fits.joined([fits, self._other_classes(lead, evidence, fits, leading)])
        if models.scout is None:
            return fits
        assert models.final is not None
        # of what the scout found, the likely ones are refined again; the others keep their distance from the best
        order = np.lexsort((fits.cost, fits.frame))
        least = _least_of_frame(fits, len(evidence.weight))
        likely = [k for k in order if fits.cost[k] < least[fits.frame[k]] + LIKELY]
        chosen: list[int] = []
        for k in likely:
            same = [j for j in chosen if fits.frame[j] == fits.frame[k]]
            if len(same) < _MOST_REFINED and len(self._distinct(fits, np.array([*same, k]))) > len(same):
                chosen.append(int(k))
        again = fits[np.array(chosen, np.int64)]
        if patient:
            again = _spread(again)
        side_peaks = evidence.on == "phasors" or behind is not None
        step = _LONG_STEP if self._prior_std else _SHORT_STEP
        close = replace(settings, longest_step=step, look_beside_rad=_CLOSE_BY_RAD if side_peaks else ())
        final = refine(models.final, evidence, again.frame, again.class_index, again.view, close)
        rest = np.setdiff1d(order, likely)
        others = fits[rest]
        gap = others.cost - least[others.frame]
        others.cost[:] = _least_of_frame(final, len(evidence.weight))[others.frame] + gap
        return Fits.joined([final, others.with_free(len(self.free))])

    def _settings(self, behind: PhasorImages | None) -> Settings:
        """Return what is estimated, before some background."""
        return Settings(
            self.free,
            self._used,
            self._huber,
            None if behind is None else behind.phasor.reshape(-1),
            prior_std=self._prior_std,
            unknown_around=self.unknown,
            returns_behind=None
            if behind is None
            else counts(behind.phasor, behind.intensity, behind.sensor).reshape(-1),
        )

    def _modes(
        self,
        model: ImageModel,
        evidence: Evidence,
        frame: NDArray[np.int64],
        class_index: NDArray[np.int64],
        view: NDArray[np.float64],
        settings: Settings,
        margin: float,
    ) -> Fits:
        """Refine the best start of every frame, the others while they can still win, and at last what is likely."""
        n = len(evidence.weight)
        first = np.isin(np.arange(len(frame)), np.unique(frame, return_index=True)[1])
        fits = refine(model, evidence, frame[first], class_index[first], view[first], settings, roughly=True)
        limit = _least_of_frame(fits, n)[frame[~first]] + margin
        more = refine(model, evidence, frame[~first], class_index[~first], view[~first], settings, limit, roughly=True)
        fits = Fits.joined([fits, more])
        likely = fits.cost < _least_of_frame(fits, n)[fits.frame] + margin
        better = fits[self._distinct_of_frames(fits, np.flatnonzero(likely))]
        better = refine(model, evidence, better.frame, better.class_index, better.view, settings)
        return Fits.joined([better, fits[~likely]])

    def _other_classes(self, model: ImageModel, evidence: Evidence, fits: Fits, settings: Settings) -> Fits:
        """Let every class but the best explain each frame, from the view of the best."""
        best = _best_of_frame(fits)
        n_class = len(self.bank.classes)
        others = np.array([(k, c) for k in best for c in range(n_class) if c != fits.class_index[k]], np.int64)
        others = others.reshape(-1, 2)
        source = others[:, 0]
        limit = fits.cost[source] + LIKELY
        return refine(
            model, evidence, fits.frame[source], others[:, 1], fits.view[source], settings, limit, at_first_sight=True
        )

    def _bare_wall_cost(self, one: FilteredFrames, evidence: Evidence) -> NDArray[np.float64]:
        """Return how badly a wall at its best distance explains all of one frame, (1,)."""
        seen = evidence.seen
        forward = self.bank.sensor.axis_cosine().ravel() * seen.range_m[0]
        returned = seen.returned[0]
        if returned.sum() < MIN_RETURNS:
            return np.array([np.inf])
        wall_m = float(np.average(forward[returned], weights=seen.weight[0, returned]))
        if wall_m < NEAREST_WALL_M:
            return np.array([np.inf])
        return bare_cost(seen, _behind(self.bank, Background(wall_m=wall_m)))

    def _answers(
        self,
        frames: FilteredFrames,
        evidence: Evidence,
        fits: Fits,
        bare: NDArray[np.float64],
        background: Background | None,
    ) -> list[Match]:
        tolerated = _LARGEST_SCALE**2 if self.unknown else 1.0
        p_values = p_values_of(fits.tested / tolerated, fits.dof, frames, fits.frame)
        order = np.lexsort((fits.cost, fits.frame))
        first = np.searchsorted(fits.frame[order], np.arange(len(frames) + 1))
        doubt = np.asarray(special.chdtri(np.maximum(fits.dof, 1), self.false_alarm), np.float64)
        answers = []
        for k in range(len(frames)):
            own = order[first[k] : first[k + 1]]
            own = own[np.isfinite(fits.cost[own])]
            answers.append(self._answer(fits, own, p_values, doubt, float(bare[k]), background))
        return self._with_systematic(frames.sensor, evidence, answers)

    def _with_systematic(self, sensor: Sensor, evidence: Evidence, answers: list[Match]) -> list[Match]:
        """Add to covariances what all frames of a camera share."""
        parts: list[dict[str, NDArray[np.float64]]] = [{} for _ in answers]
        known = [k for k, match in enumerate(answers) if match.covariance is not None and match.class_name is not None]
        declared = declared_covariance(sensor, self.free)
        if "declared" in self._systematic and declared.any():
            for k in known:
                parts[k]["declared"] = declared
        if "calibration" in self._systematic and calibrated_fields(sensor):
            for c, name in enumerate(self.bank.classes):
                which = [k for k in known if answers[k].class_name == name]
                if which:
                    carried = self._carried(sensor, evidence, c, which, [answers[k] for k in which])
                    for k, part in zip(which, carried, strict=True):
                        parts[k]["calibration"] = part
        return [self._with_parts(match, part) if part else match for match, part in zip(answers, parts, strict=True)]

    def _with_motion(self, frames: FilteredFrames, answers: list[Match]) -> list[Match]:
        """Add to covariances what the jitter of the stamps makes of the motion of the camera.

        What a frame shows is as certain as before, so that no further answer is refused.
        """
        jitter_s = frames.sensor.systematic_time_s
        if "motion" not in self._systematic or jitter_s == 0 or frames.time_s is None:
            return answers
        view, std = (np.full((len(answers), len(self.free)), np.nan) for _ in range(2))
        for k, match in enumerate(answers):
            if match.covariance is not None and match.class_name is not None:
                view[k] = [getattr(match, name) for name in self.free]
                std[k] = np.sqrt(np.diag(match.covariance))
        period = np.array([delta_period_rad(match.symmetry) for match in answers])
        rate = rates_of_views(spread_stamps(frames.time_s), view, std, period, self.free.index("delta_rad"))
        return [
            match if match.covariance is None or not one.any() else _with_part(match, "motion", part)
            for match, one, part in zip(answers, rate, jitter_s**2 * rate[:, :, None] * rate[:, None], strict=True)
        ]

    def _with_parts(self, match: Match, parts: dict[str, NDArray[np.float64]]) -> Match:
        """Return a match whose covariance holds further parts; refused if they leave it undetermined."""
        for name, part in parts.items():
            match = _with_part(match, name, part)
        assert match.covariance is not None
        reason = match.reason
        if not reason and not self._is_determined(np.sqrt(np.diag(match.covariance)), match.symmetry):
            reason = "undetermined"
        return replace(match, reason=reason, accepted=not reason)

    def _carried(
        self, sensor: Sensor, evidence: Evidence, class_index: int, which: list[int], matches: list[Match]
    ) -> NDArray[np.float64]:
        """Return what a calibration leaves of the views of some frames with one class and background, (k, p, p)."""
        background = matches[0].background
        renderer = self._any_rendered().renderer(class_index)
        views = Views(*(np.array([getattr(match, name) for match in matches]) for name in VIEW))
        image = renderer.render_views(views, background=background, workers=self._workers)
        slope = renderer.jacobian(
            *(getattr(views, name) for name in VIEW),
            background=background, parameters=self.free, workers=self._workers,
        )  # fmt: skip
        if self.on == "phasors":  # the albedo, which is fitted too, takes up part of an error
            alone = image if background is None else renderer.render_views(views, workers=self._workers)
            slope = np.concatenate([slope, alone.phasor[:, None]], axis=1)
        by_fields = calibrated_slopes(renderer, sensor, views, image, background, self._workers)
        use = counts(image.phasor, image.intensity, sensor).reshape(len(which), -1) & self._used
        weight = np.where(use, evidence.weight[which], 0.0)
        phasor = image.phasor.reshape(len(which), -1)
        if self.unknown:
            residual = sensor.metres_per_radian * np.angle(evidence.value[which] * phasor.conj())
            weight = np.where(weight * residual**2 > _STRANGE_SIGMA**2, 0.0, weight)

        def whitened(slopes: NDArray[np.complex128]) -> NDArray[np.float64]:
            flat, root = slopes.reshape(*slopes.shape[:2], -1), np.sqrt(weight)[:, None]
            if self.on == "phasors":
                return np.concatenate([flat.real * root, flat.imag * root], axis=2)
            turn = np.divide(1.0, phasor, out=np.zeros_like(phasor), where=phasor != 0)
            return np.asarray(sensor.metres_per_radian * (flat * turn[:, None]).imag * root)

        rows = whitened(slope)
        information = rows @ rows.transpose(0, 2, 1)
        p = len(self.free)
        if self._prior_std:
            information[:, :p, :p] += np.diag(np.array(self._prior_std) ** -2.0)
        inverse = covariance_of(information, weak="none")
        return carried_covariance(inverse, rows, whitened(by_fields), calibrated_covariance(sensor))[:, :p, :p]

    def _any_rendered(self) -> RenderedModel:
        """Return a model that renders the landmarks of the bank, built when it is first needed."""
        if self._rendered is None:
            self._rendered = RenderedModel(self.bank, self.background, self._workers)
        return self._rendered

    def _answer(
        self,
        fits: Fits,
        own: NDArray[np.int64],
        p_values: NDArray[np.float64],
        doubt: NDArray[np.float64],
        bare: float,
        background: Background | None,
    ) -> Match:
        """Turn the fits of one frame, best first, into an answer."""
        names = self.bank.classes
        if not len(own):
            nothing = {**dict.fromkeys(names, 0.0), "none": 1.0}
            return Match(
                class_name=None, accepted=False, free=self.free, class_probability=nothing, reason="no landmark"
            )
        kept = self._distinct(fits, own)
        best = kept[0]
        c = int(fits.class_index[best])
        is_landmark = bool(fits.capped[best] < bare)
        covariance = fits.covariance[best]
        known = bool(np.isfinite(covariance).all())
        left = DISAGREEMENT * float(fits.unexplained[best])
        none_cost = min(bare, float(doubt[best]) + left)
        costs = np.append(fits.cost[kept], none_cost)
        weight = np.exp(-0.5 * np.minimum(costs - costs.min(), 1400.0))
        weight /= weight.sum()
        best_of_class = {names[fits.class_index[k]]: 0.0 for k in kept}
        for k, w in zip(kept, weight, strict=False):
            best_of_class[names[fits.class_index[k]]] += float(w)
        probability = {**dict.fromkeys(names, 0.0), **best_of_class, "none": float(weight[-1])}
        condition, weak = weak_direction(self.free, information=fits.information[best])
        candidates = tuple(
            Candidate(
                names[fits.class_index[k]],
                float(fits.view[k, 0]),
                self._wrapped(fits.view[k, 1], fits.class_index[k]),
                float(fits.cost[k]),
                float(w),
                float(fits.view[k, 2]),
                float(fits.view[k, 3]),
            )
            for k, w in zip(kept, weight, strict=False)
        )
        reason: Reason = ""
        if not is_landmark:
            reason = "no landmark"
        elif p_values[best] < self.false_alarm:
            reason = "poor fit"
        elif self.unknown and fits.agreeing[best] < fits.elsewhere[best]:
            reason = "poor fit"
        elif self.unknown and fits.explained[best] < _FEWEST_EXPLAINED * len(self.free):
            reason = "undetermined"
        elif not self._is_determined(fits.std_without_one[best], self._symmetry[c]):
            reason = "undetermined"
        elif self._is_ambiguous(fits, kept, weight[:-1]):
            reason = "ambiguous"
        return Match(
            class_name=names[c] if is_landmark else None,
            accepted=not reason,
            distance_m=candidates[0].distance_m,
            delta_rad=candidates[0].delta_rad,
            bearing_rad=candidates[0].bearing_rad,
            height_m=candidates[0].height_m,
            free=self.free,
            covariance=covariance.copy() if known else None,
            chi2=float(fits.tested[best]),
            dof=int(fits.dof[best]),
            p_value=float(p_values[best]),
            class_probability=probability,
            alternatives=candidates[1:] if is_landmark else candidates,
            symmetry=self._symmetry[c],
            condition_number=condition,
            weak_direction=weak,
            background=background,
            reason=reason,
        )

    def _is_determined(self, std: NDArray[np.float64], symmetry: int) -> bool:
        """Return whether a frame tells every free parameter to within the tolerance, three standard deviations.

        The error of δ is at most half a period of the landmark, which no tolerance is below for a body of revolution.
        """
        tolerance = np.array([self._tolerance[name] for name in self.free])
        error = _TOLERATED_SIGMA * std
        turn = self.free.index("delta_rad")
        error[turn] = min(error[turn], math.pi / symmetry)
        return bool((error <= tolerance).all())

    def _is_ambiguous(self, fits: Fits, kept: list[int], weight: NDArray[np.float64]) -> bool:
        """Return whether other classes, or views beyond the tolerance, are too probable; `kept` is best first."""
        best = kept[0]
        period = delta_period_rad(self._symmetry[fits.class_index[best]])
        apart = np.abs(fits.view[kept] - fits.view[best])
        apart[:, 1] = np.abs(wrap_delta_difference_rad(apart[:, 1], period))
        own = [VIEW.index(name) for name in self.free]
        std = np.sqrt(np.nan_to_num(np.einsum("kpp->kp", fits.covariance[kept]), posinf=0.0))
        apart[1:, own] += _TOLERATED_SIGMA * std[1:]  # the truth may be on the far side of the other view
        far = (apart > [self._tolerance[name] for name in VIEW]).any(axis=1)
        other = fits.class_index[kept] != fits.class_index[best]
        # where a landmark looks alike from two sides, a single pixel at an edge must not decide between them
        enough = DISAGREEMENT * (_PIXELS_AMONG_UNKNOWN if self.unknown else 1)
        alike = far & ~other & (fits.cost[kept] < fits.cost[best] + enough)
        return bool(weight[other].sum() > _AMBIGUITY * weight.sum() or alike.any())

    def _distinct_of_frames(self, fits: Fits, which: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return those of some fits that came to places of their own, the best at each."""
        which = which[np.lexsort((fits.cost[which], fits.frame[which]))]
        borders = np.flatnonzero(np.diff(fits.frame[which])) + 1
        return np.array([k for own in np.split(which, borders) for k in self._distinct(fits, own)], np.int64)

    def _distinct(self, fits: Fits, own: NDArray[np.int64]) -> list[int]:
        """Return fits, best first, without those that came to the same place."""
        kept: list[int] = []
        for k in own:
            period = delta_period_rad(self._symmetry[fits.class_index[k]])
            for other in kept:
                turned = wrap_delta_difference_rad(fits.view[k, 1] - fits.view[other, 1], period)
                near = abs(fits.view[k, 0] - fits.view[other, 0]) < _SAME_M and abs(turned) < _SAME_RAD
                if near and fits.class_index[k] == fits.class_index[other]:
                    break
            else:
                kept.append(int(k))
        return kept

    def _wrapped(self, delta_rad: float, class_index: int) -> float:
        return float(wrap_delta_rad(delta_rad, delta_period_rad(self._symmetry[class_index])))


@dataclass(frozen=True, eq=False)
class _Models:
    """What the answer is taken from, and what finds the way to it where that is slow."""

    final: ImageModel | None
    scout: ImageModel | None


def _with_part(match: Match, name: str, part: NDArray[np.float64]) -> Match:
    """Return a match whose covariance holds a further part."""
    assert match.covariance is not None
    return replace(match, covariance=match.covariance + part, systematic={**match.systematic, name: part})


def bare_cost(seen: Observation, behind: PhasorImages | None) -> NDArray[np.float64]:
    """Return the whitened squared distance of frames from a scene without a landmark, (n,)."""
    if behind is None:
        return np.asarray(DISAGREEMENT * seen.returned.sum(axis=1), np.float64)
    sensor = behind.sensor
    model = behind.range_m.reshape(-1)
    lit = np.isfinite(model)
    sure = counts(behind.phasor, behind.intensity, sensor).reshape(-1)
    residual = wrap_difference_m(np.where(lit & seen.returned, seen.range_m - np.where(lit, model, 0.0), 0.0), sensor)
    wrong = (seen.returned & ~lit) | (seen.not_returned & sure)
    squared = np.minimum(seen.weight * residual**2, DISAGREEMENT)
    return np.asarray(squared.sum(axis=1) + DISAGREEMENT * wrong.sum(axis=1))


def p_values_of(
    cost: NDArray[np.float64], dof: NDArray[np.int64], frames: FilteredFrames, frame: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the probability of a larger χ² for every fit; 0 where nothing is left to test.

    Where the variances were estimated from the scatter of ν + 1 frames, each squared residual follows F(1, ν); their
    sum is given a scaled χ² of the same mean and variance.
    """
    freedom = np.maximum(dof, 1).astype(np.float64)
    if not frames.std_from_scatter:
        p = special.chdtrc(freedom, cost)
    else:
        n = np.where(frames.n_effective > 0, frames.n_effective, np.nan).reshape(len(frames), -1)
        nu = np.array([np.nanmedian(row) if np.isfinite(row).any() else 0.0 for row in n])[frame] - 1
        nu = np.maximum(nu, 5.0)  # the variance of F(1, ν) exists above 4
        mean = freedom * nu / (nu - 2)
        variance = freedom * 2 * nu**2 * (nu - 1) / ((nu - 2) ** 2 * (nu - 4))
        p = special.chdtrc(2 * mean**2 / variance, cost * 2 * mean / variance)
    return np.where(dof > 0, p, 0.0)


def _beside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which pixels have a neighbour in a mask, left, right, above or below; (n, rows, cols)."""
    out = np.zeros_like(mask)
    out[:, 1:] |= mask[:, :-1]
    out[:, :-1] |= mask[:, 1:]
    out[:, :, 1:] |= mask[:, :, :-1]
    out[:, :, :-1] |= mask[:, :, 1:]
    return out


def _rotated(point_m: NDArray[np.float64], delta_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return R(δ) p' of PHYSICS section 1, horizontally; (m, 2)."""
    cos, sin = np.cos(delta_rad), np.sin(delta_rad)
    x, y = point_m[:, 0], point_m[:, 1]
    return np.stack([cos * x + sin * y, cos * y - sin * x], axis=1)


def _usual_workers() -> int:
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, 8)


def _behind(bank: Bank, background: Background) -> PhasorImages:
    return Renderer(None, bank.sensor).render(distance_m=1.0, background=background)


def _at_measured_distance(
    model: ImageModel,
    evidence: Evidence,
    frame: NDArray[np.int64],
    class_index: NDArray[np.int64],
    view: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return views moved along their distance by the median residual of the ranges they explain, (m, 4)."""
    view = view.copy()
    for _ in range(_REGISTRATIONS):
        view[:, 0] = np.clip(view[:, 0], *model.limits())
        phasor = model.images(class_index, np.ascontiguousarray(view), ()).phasor
        residual = evidence.sensor.metres_per_radian * np.angle(evidence.value[frame] * phasor.conj())
        compared = (phasor != 0) & (evidence.weight[frame] > 0)
        residual[~compared] = np.nan
        some = compared.any(axis=1)
        view[some, 0] += np.nanmedian(residual[some], axis=1)
    return view


def _some(seen: Observation, index: NDArray[np.int64]) -> Observation:
    return Observation(seen.range_m[index], seen.weight[index], seen.returned[index], seen.not_returned[index])


def _spread(fits: Fits) -> Fits:
    """Surround fits by others, two and four standard deviations away along the axes of their covariance.

    Where an edge has just left a pixel, its slope is none, and nothing leads back.
    """
    p = fits.covariance.shape[1]
    columns = np.arange(p)
    values, vectors = np.linalg.eigh(np.where(np.isfinite(fits.covariance), fits.covariance, 0.0))
    axes = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    parts = [fits]
    for k in range(p):
        for size in (-4.0, -2.0, 2.0, 4.0):
            view = fits.view.copy()
            view[:, columns] += size * axes[:, :, k]
            parts.append(replace(fits, view=view))
    return Fits.joined(parts)


def _least_of_frame(fits: Fits, n: int) -> NDArray[np.float64]:
    """Return the lowest cost of every frame, (n,)."""
    least = np.full(n, np.inf)
    np.minimum.at(least, fits.frame, fits.cost)
    return least


def _best_of_frame(fits: Fits) -> NDArray[np.int64]:
    """Return the index of the best fit of every frame that has one."""
    order = np.lexsort((fits.cost, fits.frame))
    first = np.r_[True, np.diff(fits.frame[order]) > 0] if len(order) else np.empty(0, np.bool_)
    return order[first]
