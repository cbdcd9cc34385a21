"""Frames before walls and floors that are estimated from the frames themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.estimate.fits import BETTER_COST, MOST_REFINED, Fits, best_of_frame, least_of_frame
from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.background_estimate import (
    Surroundings,
    estimate_surroundings,
    fit_background,
    without_background,
)
from phasemark.matcher.likelihood.descent import CLOSE_BY_RAD
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.profiles import with_profiles
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.scenes import Scenes
from phasemark.matcher.likelihood.search import are_doubtful, fit_views, search_views
from phasemark.matcher.likelihood.setup import Setup
from phasemark.matcher.likelihood.valleys import with_valleys
from phasemark.render import Background
from phasemark.render.view import delta_period_rad

__all__ = ["AutoBackground"]

_WALLS_BEYOND_M = 0.5, 1.0, 2.0, 4.0
"""Distances behind the landmark at which a wall is tried where no pixel sees the background alone."""


_Standing = tuple[list[Background | None], Fits]
"""What stands behind the landmark in each of n frames, and their fits before it."""


@dataclass(frozen=True, eq=False, repr=False)
class AutoBackground:
    """Searches n frames, each before the background that it shows; many at the same time.

    Parameters
    ----------
    frames : FilteredFrames
    evidence : Evidence
        Of them.
    bare : (n,) float64
        Cost of a scene without a landmark.
    setup : Setup
    scenes : Scenes
        Before any background.
    """

    frames: FilteredFrames
    evidence: Evidence
    bare: NDArray[np.float64]
    setup: Setup
    scenes: Scenes

    def search(self) -> _Standing:
        """Return the background of each frame, and what explains the frames before them."""
        # 1  take what is far for the background, and search without the pixels that see it
        backgrounds, fits = self._first()
        # 2  fit both in turn, where a fit is doubtful, and where pixels that see some of the landmark tell the
        #    height of a floor, or tilts
        entangled = [own is not None and (own.floor_m is not None or self._tilted) for own in backgrounds]
        which = np.flatnonzero(np.array(entangled) | are_doubtful(self.setup, fits, len(self.frames)))
        backgrounds, fits = self._with_better_backgrounds(which, backgrounds, fits)
        # 3  search all pixels where that leaves a doubt: what was taken for background may be landmark
        which = self._doubtful(backgrounds, fits)
        # frames whose backgrounds are in images of the bank at the same time: these take some megabytes each
        together = 8
        few = [which[start : start + together] for start in range(0, len(which), together)]
        fits = Fits.joined([fits, *(self._searched_together(some, backgrounds) for some in few)])
        which = self._doubtful(backgrounds, fits)
        backgrounds, fits = self._with_better_backgrounds(which, backgrounds, fits)
        # 4  try other angles of the landmark
        which = self._doubtful(backgrounds, fits)
        fits = Fits.joined([fits, self._other_angles(which, backgrounds, fits)])
        backgrounds, fits = self._with_better_backgrounds(which, backgrounds, fits)
        # 5  look how far the answers may be off
        parts = []
        for which in _without_and_with(backgrounds):
            scene, some = self.scenes.before(_standing(backgrounds, which)), self.evidence[which]
            own = with_valleys(scene, some, _of_frames(fits, which))
            parts.append(_numbered(with_profiles(scene, some, own), which))
        return backgrounds, Fits.joined(parts)

    @property
    def _tilted(self) -> bool:
        """Whether pitch or roll is estimated."""
        return bool(set(self.setup.free) & set(VIEW[4:]))

    def _doubtful(self, backgrounds: list[Background | None], fits: Fits) -> NDArray[np.int64]:
        """Return the frames before a background whose fits are doubtful."""
        stands = np.array([own is not None for own in backgrounds])
        return np.flatnonzero(stands & are_doubtful(self.setup, fits, len(self.frames)))

    def _first(self) -> _Standing:
        """Return what the far pixels of each frame show, and fits to its other pixels."""
        around = [self._surroundings(k) for k in range(len(self.frames))]
        backgrounds = [own.background for own in around]
        parts = []
        for which in _without_and_with(backgrounds):
            some = self.evidence[which]
            seen, behind = some.seen, _standing(backgrounds, which)
            if behind:
                seen = without_background(seen, [around[k] for k in which])
            fits = search_views(self.scenes.before(behind), some, seen, self.bare[which])
            parts.append(_numbered(fits, which))
            doubtful = np.flatnonzero(are_doubtful(self.setup, fits, len(which)))
            if not behind and doubtful.size:  # each pixel at an edge may see a background that none sees alone
                few, again = some[doubtful], which[doubtful]
                fits = search_views(self.scenes.open(), few, few.seen, self.bare[again])
                parts.append(_numbered(fits, again))
        return backgrounds, Fits.joined(parts)

    def _surroundings(self, k: int) -> Surroundings:
        """Return what one frame shows behind the landmark; nothing where that leaves no room for one."""
        setup = self.setup
        known = not setup.bearing_is_free or setup.bearing_has_prior
        around = estimate_surroundings(self.frames, k, bearing_known=known, tilt_known=not self._tilted)
        if around.background is not None and not self._leaves_room(around.background):
            return replace(around, background=None)
        return around

    def _leaves_room(self, background: Background) -> bool:
        """Return True if a landmark has a place between the lens and a wall."""
        nearest, farthest = self.scenes.rendered.with_background(background).limits(self.setup.bank.delta_rad)
        return bool((nearest < farthest).all())

    def _searched_together(self, which: NDArray[np.int64], backgrounds: list[Background | None]) -> Fits:
        """Search frames with their backgrounds in the images of the bank."""
        some, scene = self.evidence[which], self.scenes.whole_before(_standing(backgrounds, which))
        return _numbered(search_views(scene, some, some.seen, self.bare[which]), which)

    def _other_angles(self, which: NDArray[np.int64], backgrounds: list[Background | None], fits: Fits) -> Fits:
        """Fit frames from their best views turned to other angles; distance and bearing are found more easily."""
        if not which.size:
            return fits[:0]
        own = _of_frames(fits, which)
        best = best_of_frame(own)
        n = 12  # angles that a frame before an estimated background is tried from where nothing else fits
        source = np.repeat(best, n - 1)
        period = np.array([delta_period_rad(self.setup.rules.symmetry[c]) for c in own.class_index[source]])
        view = own.view[source]
        view[:, 1] += np.tile(np.arange(1, n), len(best)) * period / n
        scene, some = self.scenes.before(_standing(backgrounds, which)), self.evidence[which]
        return _numbered(fit_views(scene, some, replace(own[source], view=view)), which)

    def _with_better_backgrounds(
        self, which: NDArray[np.int64], backgrounds: list[Background | None], fits: Fits
    ) -> _Standing:
        """Fit the backgrounds of some frames and the views before them in turn while that helps.

        Where no pixel sees a background alone, walls at some distances behind the landmark are tried.
        """
        stands = np.array([own is not None for own in backgrounds])
        found = self._in_turn(which[stands[which]], backgrounds, fits)
        without = which[~stands[which]]
        best = best_of_frame(fits)
        nearest_m = np.zeros(len(self.frames))
        nearest_m[fits.frame[best]] = fits.view[best, 0]
        for beyond_m in _WALLS_BEYOND_M:
            if not without.size:
                break
            tried = list(backgrounds)
            for k in without:
                tried[k] = Background(wall_m=float(nearest_m[k]) + beyond_m)
            there = self._in_turn(without, tried, fits)
            least, news = (least_of_frame(standing[1], len(self.frames))[without] for standing in (found, there))
            found = _taken(found, there, without[news < least])
            without = without[are_doubtful(self.setup, found[1], len(self.frames))[without]]
        return found

    def _in_turn(self, which: NDArray[np.int64], backgrounds: list[Background | None], fits: Fits) -> _Standing:
        """Fit the background of each frame behind its best view, then the views before it, while that helps."""
        found: _Standing = backgrounds, fits
        background_rounds = 4  # how often background and views are fitted in turn
        for _ in range(background_rounds):
            which, moved, starts = self._moved_backgrounds(which, *found)
            if not which.size:
                break
            some, scene = self.evidence[which], self.scenes.before(_standing(moved, which))
            settings = replace(scene.settings(), look_beside_rad=CLOSE_BY_RAD)
            again = refine(scene.final, some, starts, settings)
            before = least_of_frame(found[1], len(self.frames))[which]
            now = least_of_frame(again, len(which))
            found = _taken(found, (moved, _numbered(again, which)), which[now < before])
            which = which[now <= before - BETTER_COST]
        return found

    def _moved_backgrounds(
        self, which: NDArray[np.int64], backgrounds: list[Background | None], fits: Fits
    ) -> tuple[NDArray[np.int64], list[Background | None], Fits]:
        """Fit the backgrounds behind the best views of some frames.

        Returns
        -------
        moved : (k,) int64
            The frames whose backgrounds moved.
        backgrounds : list
            Of all frames.
        starts : Fits
            The best views of the moved frames, numbered by their places among these; the first of each is the one that
            was fitted with the background.
        """
        moved, starts = list(backgrounds), []
        kept: list[int] = []
        for k in which:
            own = np.flatnonzero((fits.frame == k) & np.isfinite(fits.cost))
            background = backgrounds[k]
            if not own.size or background is None:
                continue
            best = fits[own[np.argsort(fits.cost[own], kind="stable")][:MOST_REFINED]]
            one, class_index = self.evidence[k : k + 1], int(best.class_index[0])
            found, view = fit_background(
                self.scenes.rendered, one, class_index, best.view[0], self.setup.free, background
            )
            if found == background or not self._leaves_room(found):
                continue
            best.view[0] = view
            moved[k] = found
            starts.append(_numbered(best, np.full(k + 1, len(kept))))
            kept.append(k)
        return np.array(kept, np.int64), moved, Fits.joined(starts) if starts else fits[:0]


def _without_and_with(backgrounds: list[Background | None]) -> list[NDArray[np.int64]]:
    """Return which frames have no background, and which have one; none that is empty."""
    stands = np.array([own is not None for own in backgrounds])
    return [which for which in (np.flatnonzero(~stands), np.flatnonzero(stands)) if which.size]


def _standing(backgrounds: list[Background | None], which: NDArray[np.int64]) -> list[Background]:
    """Return the backgrounds of those of some frames that have one."""
    return [own for own in (backgrounds[k] for k in which) if own is not None]


def _of_frames(fits: Fits, which: NDArray[np.int64]) -> Fits:
    """Return the fits of some frames, numbered by their places among these."""
    own = fits[np.flatnonzero(np.isin(fits.frame, which))]
    return replace(own, frame=np.searchsorted(which, own.frame))


def _numbered(fits: Fits, which: NDArray[np.int64]) -> Fits:
    """Return fits whose frames k are the frames which[k]."""
    return replace(fits, frame=which[fits.frame])


def _taken(standing: _Standing, other: _Standing, which: NDArray[np.int64]) -> _Standing:
    """Return backgrounds and fits with those of some frames taken from others."""
    backgrounds, fits = standing
    taken = set(which.tolist())
    mixed = [other[0][k] if k in taken else own for k, own in enumerate(backgrounds)]
    of_others = other[1][np.flatnonzero(np.isin(other[1].frame, which))]
    return mixed, Fits.joined([fits[np.flatnonzero(~np.isin(fits.frame, which))], of_others])
