"""Frames before walls and floors that are estimated from the frames themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phasemark.matcher.filters.filtered_frames import FilteredFrames
from phasemark.matcher.likelihood.background_estimate import (
    Surroundings,
    estimate_surroundings,
    fit_background,
    without_background,
)
from phasemark.matcher.likelihood.candidates import fit_other_classes
from phasemark.matcher.likelihood.fits import Fits
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.look_alikes import fit_look_alikes
from phasemark.matcher.likelihood.refine import refine
from phasemark.matcher.likelihood.rendered_images import RenderedModel
from phasemark.matcher.likelihood.residuals import Evidence
from phasemark.matcher.likelihood.search import is_doubtful, search_views
from phasemark.matcher.likelihood.setup import Scene, Setup
from phasemark.render import Background
from phasemark.render.view import delta_period_rad

__all__ = ["AutoBackground"]


class AutoBackground:
    """Searches frames, each before the background that it shows.

    All frames are searched at the same time before what their far pixels show; those that this leaves in doubt are
    searched further one by one.

    Parameters
    ----------
    setup : Setup
    rendered : RenderedModel
        Renders the landmarks before any background.
    scene : callable
        Returns the scene of the backgrounds of some frames, or of one for all (empty: none). The second argument says
        whether background and landmark are searched together, over all bearings, since what was taken for background
        may be landmark; there is one background then.
    """

    def __init__(
        self, setup: Setup, rendered: RenderedModel, scene: Callable[[Sequence[Background], bool], Scene]
    ) -> None:
        self._setup, self._rendered, self._scene = setup, rendered, scene

    def search(
        self, frames: FilteredFrames, evidence: Evidence, bare: NDArray[np.float64]
    ) -> tuple[list[Background | None], Fits]:
        """Return the background of each frame, and what explains the frames before them.

        Parameters
        ----------
        frames : FilteredFrames
            n frames.
        evidence : Evidence
            Of them.
        bare : (n,) float64
            Cost of a scene without a landmark.
        """
        around = [self._surroundings(frames, k) for k in range(len(frames))]
        backgrounds = [own.background for own in around]
        stands = np.array([background is not None for background in backgrounds])
        groups = [which for which in (np.flatnonzero(~stands), np.flatnonzero(stands)) if which.size]
        first = Fits.joined([self._first_fits(evidence, bare, which, [around[k] for k in which]) for which in groups])
        found = []
        for k, background in enumerate(backgrounds):
            own, one = first[np.flatnonzero(first.frame == k)], slice(k, k + 1)
            backgrounds[k], fits = self._further(background, evidence[one], bare[one], _as_frame(own, 0))
            found.append(_as_frame(fits, k))
        return backgrounds, Fits.joined(found)

    def _surroundings(self, frames: FilteredFrames, k: int) -> Surroundings:
        """Return what one frame shows behind the landmark; nothing where that leaves no room for one."""
        setup = self._setup
        known = not setup.bearing_is_free or setup.bearing_has_prior
        around = estimate_surroundings(frames, k, bearing_known=known, tilt_known=not self._tilted)
        if around.background is not None and not self._leaves_room(around.background):
            return replace(around, background=None)
        return around

    @property
    def _tilted(self) -> bool:
        """Whether pitch or roll is estimated."""
        return bool(set(self._setup.free) & set(VIEW[4:]))

    def _first_fits(
        self, evidence: Evidence, bare: NDArray[np.float64], which: NDArray[np.int64], around: Sequence[Surroundings]
    ) -> Fits:
        """Return what explains some frames, all before a background of their own or all before none."""
        some = evidence[which]
        seen, backgrounds = some.seen, [own.background for own in around if own.background is not None]
        if backgrounds:
            seen = without_background(seen, around)
        fits = search_views(self._setup, self._scene(backgrounds, False), some, seen, bare[which])
        return replace(fits, frame=which[fits.frame])

    def _further(
        self, background: Background | None, evidence: Evidence, bare: NDArray[np.float64], fits: Fits
    ) -> tuple[Background | None, Fits]:
        """Fit background and views of one frame further where its first fits leave a doubt."""
        setup = self._setup
        # the height of a floor, and tilts, are told by pixels that see some of the landmark too
        entangled = background is not None and (background.floor_m is not None or self._tilted)
        if entangled or is_doubtful(setup, fits):
            background, fits = self._with_better_background(background, evidence, fits)
        if background is not None and is_doubtful(setup, fits):
            again = search_views(setup, self._scene([background], True), evidence, evidence.seen, bare)
            fits = Fits.joined([fits, again])
            if is_doubtful(setup, fits):
                background, fits = self._with_better_background(background, evidence, fits)
        if background is not None and is_doubtful(setup, fits):
            fits = Fits.joined([fits, self._other_angles(background, evidence, fits)])
            background, fits = self._with_better_background(background, evidence, fits)
        return background, fits

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
        for beyond in self._setup.policy.walls_beyond_m:
            there = self._background_and_views(Background(wall_m=float(best[0]) + beyond), evidence, fits)
            if there[1].cost.min() < found[1].cost.min():
                found = there
            if not is_doubtful(self._setup, found[1]):
                break
        return found

    def _leaves_room(self, background: Background) -> bool:
        """Return True if a landmark has a place between the lens and a wall."""
        nearest, farthest = self._rendered.with_background(background).limits()
        return nearest < farthest

    def _other_angles(self, background: Background, evidence: Evidence, fits: Fits) -> Fits:
        """Fit one frame from its best view turned to other angles; distance and bearing are found more easily."""
        if not np.isfinite(fits.cost).any():
            return fits[:0]
        best = int(fits.cost.argmin())
        n = self._setup.policy.other_angles
        period = delta_period_rad(self._setup.shapes.symmetry[fits.class_index[best]])
        angles = np.arange(1, n) * period / n
        view = np.tile(fits.view[best], (len(angles), 1))
        view[:, 1] += angles
        frame, class_index = (np.full(len(angles), values[best]) for values in (fits.frame, fits.class_index))
        scene = self._scene([background], False)
        return refine(scene.final, evidence, frame, class_index, view, scene.settings(self._setup))

    def _background_and_views(self, background: Background, evidence: Evidence, fits: Fits) -> tuple[Background, Fits]:
        """Fit a background behind the best view of one frame, then the views before it, in turn while that helps."""
        setup, policy = self._setup, self._setup.policy
        for _ in range(policy.background_rounds):
            finite = np.flatnonzero(np.isfinite(fits.cost))
            if not finite.size:
                break
            best = finite[np.argsort(fits.cost[finite], kind="stable")][: policy.most_refined]
            found, view = fit_background(
                self._rendered,
                evidence,
                int(fits.class_index[best[0]]),
                fits.view[best[0]],
                setup.free,
                background,
            )
            if found == background or not self._leaves_room(found):
                break
            scene = self._scene([found], False)
            settings = replace(scene.settings(setup), look_beside_rad=policy.close_by_rad)
            some = fits[best]
            some.view[0] = view
            again = refine(scene.final, evidence, some.frame, some.class_index, some.view, settings)
            others = fit_other_classes(setup, scene.final, evidence, again, settings)
            again = Fits.joined([again, others, fit_look_alikes(setup, scene, evidence, again)])
            if not again.cost.min() < fits.cost[best[0]]:
                break
            settled = again.cost.min() > fits.cost[best[0]] - 1
            background, fits = found, again
            if settled:
                break
        return background, fits


def _as_frame(fits: Fits, k: int) -> Fits:
    """Return fits of one frame as those of frame k."""
    return replace(fits, frame=np.full(len(fits), k, np.int64))
