"""Setup of a likelihood matcher: free parameters, evidence and background, fixed while frames are matched."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules
from phasemark.matcher.likelihood.images import VIEW, ImageModel
from phasemark.matcher.likelihood.problem import DescentSettings
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.likelihood.search_policy import SearchPolicy
from phasemark.matcher.likelihood.strip_images import StripModel
from phasemark.matcher.nearest.bank_minima import Search
from phasemark.matcher.pixel_agreement import counts
from phasemark.render import PhasorImages

__all__ = ["Scene", "Setup", "check_free"]


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


@dataclass(frozen=True, eq=False)
class Setup:
    """Free parameters of a matcher, and the rules of its search.

    Parameters
    ----------
    bank : Bank
    rules : Rules
        When an answer is accepted.
    prior_std : tuple of float
        Standard deviation of each before the frame is seen, infinite where nothing is known; empty without a prior.
    bearing_has_prior : bool
        Whether the bearing is estimated with what is known of it.
    on : {"ranges", "phasors"}
    albedo_std : float
        How well the logarithm of the landmark's albedo is known beside that of what stands behind it, on ranges; 0: as
        it is stated.
    unknown : bool
        Whether unknown things may stand in view.
    reports_one_surface : bool
        Whether ranges are compared with those that a chip reports, of one surface each, and never between two.
    used : (pixels,) bool
        Which pixels give the view.
    huber : float, optional
        Residual, in σ, beyond which the loss is linear.
    widest_rad : float
        Widest bearing that is searched.
    policy : SearchPolicy
    """

    bank: Bank
    rules: Rules
    prior_std: tuple[float, ...]
    bearing_has_prior: bool
    on: ResidualKind
    albedo_std: float
    unknown: bool
    reports_one_surface: bool
    used: NDArray[np.bool_]
    huber: float | None
    widest_rad: float
    policy: SearchPolicy

    @property
    def free(self) -> tuple[str, ...]:
        """Parameters of the view."""
        return self.rules.free

    @property
    def bearing_is_free(self) -> bool:
        """Whether the bearing is estimated."""
        return "bearing_rad" in self.free

    @cached_property
    def boards(self) -> tuple[bool, ...]:
        """Whether each class is flat, thinner than a fifth of its width and of its height."""
        thickest = 0.2
        found = []
        for name in self.rules.names:
            vertices = np.asarray(self.bank.mesh(name).vertices)
            axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
            thickness, width, _ = np.sort(np.ptp(vertices @ axes.T, axis=0))
            found.append(bool(thickness < thickest * width))
        return tuple(found)

    @property
    def height_and_tilt_are_known(self) -> bool:
        """Whether height, pitch and roll are those that were stated: none of them is estimated."""
        return not set(self.free) & set(VIEW[3:])

    def prior_std_of(self, name: str) -> float:
        """Return the standard deviation of a parameter before a frame is seen; 0 of one that is not estimated."""
        if name not in self.free:
            return 0.0
        return self.prior_std[self.free.index(name)] if self.prior_std else math.inf


@dataclass(frozen=True, eq=False)
class Scene:
    """Background of a matcher with the image models and searches that include it.

    Parameters
    ----------
    setup : Setup
    behind : PhasorImages, optional
        Image of the background without a landmark, one for all frames, or one for each; None: nothing is there.
    final : ImageModel
        What the answer is taken from.
    scout : ImageModel, optional
        What finds the way to it where that is slow.
    search : Search
        Minima of the bank.
    closed_search : callable, optional
        Returns the search of one frame, by its number, before what stands behind the landmark there, where that of all
        leaves it open, in some rows of cells at least, (class, D); None where it does not.
    """

    setup: Setup
    behind: PhasorImages | None
    final: ImageModel
    scout: ImageModel | None
    search: Search
    closed_search: Callable[[int, NDArray[np.bool_]], Search] | None = None

    @property
    def strips(self) -> StripModel | None:
        """The scout, if it is made of strips."""
        return self.scout if isinstance(self.scout, StripModel) else None

    def settings(self) -> DescentSettings:
        """Return how a descent runs before these backgrounds."""
        setup, phasor, returns = self.setup, None, None
        if (behind := self.behind) is not None:
            shape = len(behind.phasor), -1
            phasor = behind.phasor.reshape(shape)
            returns = counts(behind.phasor, behind.intensity, behind.sensor).reshape(shape)
        return DescentSettings(
            setup.free,
            setup.used,
            setup.huber,
            phasor,
            prior_std=setup.prior_std,
            unknown_around=setup.unknown,
            boards=setup.boards if setup.unknown else (),
            returns_behind=returns,
            around=self.strips,
            albedo_std=0.0 if behind is None else setup.albedo_std,
            policy=setup.policy,
        )
