"""Setup of a likelihood matcher: free parameters with their priors, evidence and rules, as a user's options ask."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules
from phasemark.matcher.frequencies import layers_of, pixels_of
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.residuals import ResidualKind
from phasemark.matcher.likelihood.search_policy import DEFAULT_POLICY, SearchPolicy
from phasemark.matcher.match import TOLERANCE_M, TOLERANCE_RAD
from phasemark.matcher.pixel_agreement import DISAGREEMENT
from phasemark.render import Background
from phasemark.render.background import UNSTATED_ALBEDO_STD

__all__ = ["BEARING_STD_RAD", "ROBUST_FROM", "TILT_STD_RAD", "Pixels", "Setup", "check_free", "setup_of"]

Pixels = Literal["all", "lower"]
ROBUST_FROM = 3.0
"""Residual, in σ, from which Huber's loss is linear: far enough out to cost an honest frame nothing."""
BEARING_STD_RAD, ZONE_BEARING_STD_RAD, TILT_STD_RAD = math.radians(1.5), math.radians(3.0), math.radians(3.0)
"""Standard deviations of the bearing, and of pitch and roll, before a frame is seen, unless the matcher is told."""
_FEWEST_PER_PARAMETER, _FURTHER_ZONES = 6, 3
"""Returns that each free parameter takes among unknown things or outliers; zones of a chip, which are few but show one
surface each, that an answer explains beyond its number of free parameters."""
_AGAINST_FAR_VIEW = 4
"""Unexplained pixels that must stand against a far view of the same landmark among unknown things; of zones, one."""


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
    background : Background or {"auto", "unknown"}, optional
        What stands behind landmarks; None: nothing.
    prior_std : tuple of float
        Standard deviation of each before the frame is seen, infinite where nothing is known; empty without a prior.
    bearing_has_prior : bool
        Whether the bearing is estimated with what is known of it.
    on : {"ranges", "phasors"}
    albedo_std : float
        How well the logarithm of the landmark's albedo is known beside that of what stands behind it, on ranges; 0: as
        it is stated.
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
    background: Background | Literal["auto", "unknown"] | None
    prior_std: tuple[float, ...]
    bearing_has_prior: bool
    on: ResidualKind
    albedo_std: float
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
    def stated(self) -> Background | None:
        """The background that was stated."""
        return self.background if isinstance(self.background, Background) else None

    @property
    def auto(self) -> bool:
        """Whether the background of each frame is estimated from it."""
        return self.background == "auto"

    @property
    def unknown(self) -> bool:
        """Whether unknown things may stand in view."""
        return self.background == "unknown"

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

    def without_prior(self) -> Setup:
        """Return the setup with nothing known of the bearing."""
        stds = zip(self.free, self.prior_std, strict=True)
        prior_std = tuple(math.inf if name == "bearing_rad" else std for name, std in stds)
        return replace(self, prior_std=prior_std, bearing_has_prior=False, widest_rad=math.inf)


def setup_of(
    bank: Bank,
    *,
    free: Sequence[str] | None = None,
    background: Background | Literal["auto", "unknown"] | None = None,
    false_alarm: float = 0.01,
    on: ResidualKind | Literal["reported"] = "ranges",
    pixels: Pixels = "all",
    robust: bool = False,
    bearing_std_rad: float | None = None,
    height_std_m: float = math.inf,
    pitch_std_rad: float = TILT_STD_RAD,
    roll_std_rad: float = TILT_STD_RAD,
    tolerance_m: float = TOLERANCE_M,
    tolerance_rad: float = TOLERANCE_RAD,
    policy: SearchPolicy = DEFAULT_POLICY,
) -> Setup:
    """Return the setup that options ask for; see :class:`~phasemark.matcher.Matcher` for them.

    Raises
    ------
    UsageError
        Options do not go together.
    """
    has_prior = free is None  # the default frees the bearing, with a prior
    reported = on == "reported"
    kind: ResidualKind = "ranges" if on == "reported" else on
    if reported:
        background = "unknown"  # what stands behind the landmark changes no zone that reports the landmark
    usual = (*VIEW[:3], "pitch_rad", "roll_rad") if reported else VIEW[:3]
    names = check_free(usual if free is None else free)
    _check_choices(bank, background, kind)
    if bearing_std_rad is None:
        bearing_std_rad = ZONE_BEARING_STD_RAD if reported else BEARING_STD_RAD
    known = {"height_m": height_std_m, "pitch_rad": pitch_std_rad, "roll_rad": roll_std_rad}
    if has_prior:
        known["bearing_rad"] = bearing_std_rad
    prior_std = tuple(known.get(name, math.inf) for name in names)
    unknown = background == "unknown"
    huber = ROBUST_FROM if robust or unknown else None
    fewest = len(names) + _FURTHER_ZONES if reported else _FEWEST_PER_PARAMETER * len(names)
    rules = Rules.of_bank(bank, names, false_alarm, tolerance_m, tolerance_rad)
    if reported and has_prior:  # pitch and roll are free because no mounting is level, and not to be found
        rules = replace(rules, tolerance={**rules.tolerance, **dict.fromkeys(VIEW[4:], math.inf)})
    return Setup(
        bank=bank,
        rules=replace(
            rules,
            among_unknown=unknown,
            rival_cost=DISAGREEMENT * (_AGAINST_FAR_VIEW if unknown and not reported else 1),
            fewest_explained=0 if huber is None else fewest,
        ),
        background=background,
        prior_std=prior_std if has_prior or min(prior_std) < math.inf else (),
        bearing_has_prior=has_prior,
        on=kind,
        albedo_std=_albedo_std(background) if on == "ranges" else 0.0,
        reports_one_surface=reported,
        used=pixels_of(bank, pixels).ravel(),
        huber=huber,
        widest_rad=policy.prior_sigma * bearing_std_rad if has_prior else math.inf,
        policy=policy,
    )


def _albedo_std(background: Background | str | None) -> float:
    """Return how well the logarithm of the landmark's albedo is known beside that of wall and floor."""
    if background == "auto":
        return UNSTATED_ALBEDO_STD
    if not isinstance(background, Background) or background.estimates_floor_albedo:  # for a landmark as stated
        return 0.0
    return background.albedo_ratio_std


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
