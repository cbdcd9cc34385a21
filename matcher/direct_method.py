"""Matching of histograms and targets of a direct sensor, and the options of a matcher that go with them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from phasemark import UsageError
from phasemark.data import Bank
from phasemark.matcher.estimate.acceptance import Rules, with_parts
from phasemark.matcher.histograms.direct_matcher import check_histogram_sensor, refuse_other_sensor
from phasemark.matcher.histograms.histogram_matcher import HistogramMatcher
from phasemark.matcher.histograms.target_matcher import TargetMatcher
from phasemark.matcher.likelihood.images import VIEW
from phasemark.matcher.likelihood.likelihood_matcher import usual_workers
from phasemark.matcher.likelihood.setup import check_free
from phasemark.matcher.likelihood.shared_errors import with_motion
from phasemark.matcher.likelihood.systematic import Systematic, declared_covariance
from phasemark.matcher.match import Match
from phasemark.render import Background, Sensor
from phasemark.render.direct.histogram_frames import HistogramFrames
from phasemark.render.direct.targets import Targets

Measured = Literal["ranges", "reported", "phasors", "histograms", "targets"]
"""What is matched on."""
DIRECT_KINDS = ("histograms", "targets")
"""What of it a direct sensor alone measures."""


def refuse_direct_options(
    method: str, on: str, background: Background | Literal["auto", "unknown", "any"] | None, pixels: str, robust: bool,
    systematic: Collection[str], policy: bool,
) -> None:  # fmt: skip
    """Refuse options that do not go with histograms and targets.

    `systematic` was asked for, `policy` says whether one was.

    Raises
    ------
    UsageError
        Naming the option.
    """
    wrong = {
        "'method' must be refine": method != "refine",
        "'background' must be a Background, 'auto' or None": background in ("unknown", "any"),
        "'background' must be a Background or None, for targets do not tell it": on == "targets"
        and background == "auto",
        "'pixels' must be all": pixels != "all",
        "'robust' must be False": robust,
        **{
            f"'systematic' must be without '{term}', which is carried into ranges and phasors alone": term in systematic
            for term in ("calibration", "recording")
        },
        "'policy' must be None, for it steers the search in ranges and phasors alone": policy,
    }
    for problem, is_wrong in wrong.items():
        if is_wrong:
            raise UsageError(f'on="{on}": {problem}')


def direct_method(
    bank: Bank,
    on: str,
    *,
    background: Background | Literal["auto"] | None,
    free: Sequence[str] | None,
    known: Mapping[str, float],
    false_alarm: float,
    tolerance_m: float,
    tolerance_rad: float,
    workers: int | None,
) -> HistogramMatcher | TargetMatcher:
    """Return a matcher of histograms or targets with a bank.

    Parameters
    ----------
    bank : Bank
    on : {"histograms", "targets"}
    background : Background, "auto" or None
        What stands behind the landmark.
    free : sequence of str, optional
        None: distance, δ and the bearing.
    known : mapping of str to float
        Standard deviations of parameters before a frame is seen; nothing is known of the others.
    false_alarm, tolerance_m, tolerance_rad, workers
        As for :class:`~phasemark.matcher.Matcher`.

    Raises
    ------
    UsageError
        The bank's sensor has no histograms, or `free` is wrong.
    """
    check_histogram_sensor(bank)
    names = check_free(VIEW[:3] if free is None else free)
    rules = Rules.of_bank(bank, names, false_alarm, tolerance_m, tolerance_rad)
    prior_std = [known.get(name, math.inf) for name in names]
    common: dict[str, Any] = {
        "prior_std": prior_std, "rules": rules, "background": background, "workers": workers or usual_workers(),
    }  # fmt: skip
    return HistogramMatcher(bank, **common) if on == "histograms" else TargetMatcher(bank, **common)


def direct_frames(bank: Bank, on: str, frames: object) -> HistogramFrames | Targets:
    """Return frames as a method takes them.

    Raises
    ------
    UsageError
        They are not what is matched on.
    """
    if isinstance(frames, HistogramFrames):
        refuse_other_sensor(bank.camera, frames.sensor)
        return frames.targets if on == "targets" else frames
    if on == "targets" and isinstance(frames, Targets):
        return frames
    takes = "HistogramFrames" if on == "histograms" else "Targets, or HistogramFrames"
    raise UsageError(f'on="{on}" takes {takes}, got {type(frames).__name__}')


def with_direct_errors(
    rules: Rules,
    systematic: Collection[Systematic],
    sensor: Sensor,
    time_s: NDArray[np.float64] | None,
    answers: list[Match],
) -> list[Match]:
    """Return answers whose covariances hold what the sensor declares and what the jitter of stamps makes of motion.

    Parameters
    ----------
    rules : Rules
    systematic : collection of {"calibration", "recording", "declared", "multipath", "motion"}
    sensor : Sensor
        Of the frames.
    time_s : (n, frames) float64, optional
        Stamps of the positions' frames.
    answers : list of Match
        One for each position; refused as "undetermined" where they no longer are within the tolerance.
    """
    declared = declared_covariance(sensor, rules.free)
    if "declared" in systematic and declared.any():
        answers = [with_parts(rules, match, {"declared": declared}) for match in answers]
    if "motion" not in systematic or time_s is None:
        return answers
    return with_motion(rules.free, sensor.systematic_time_s, time_s.mean(axis=1), answers)
